"""Kinds of effects in the drive, and schema of `effects:` in an arm's YAML files, e.g. friction and sensors."""

# This file has no postponed annotations, because yaml_load_typed reads the types at run time.
import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ArmError
from dvrk_drake.models.immutable import Shared
from dvrk_drake.models.ranges import number_fault, within

#: What an effect is: friction that is independent of speed, friction that is proportional to speed, a function of
#: position, or a constant. The last two also act at rest, where their effort is unique, unlike that of friction.
Role = Literal["dry", "viscous", "position", "offset"]


@dataclass(frozen=True)
class EffectKind:
    """Kind of an effect.

    Attributes:
        unit: Unit of the coefficient for a revolute coordinate. For a prismatic coordinate, N replaces N m and m
            replaces rad.
        code: Code of the kind in `dvrk_drake.dynamics.actuator_effects.effect_step`.
        role: What the effect is.
        scale: Meaning of `ActuatorEffect.scale` for this kind, or "" if the kind has no scale.
        dissipative: True if the effect dissipates energy in all motions. The coefficient of such an effect must not be
            negative.
        revolute: True if the kind is allowed for revolute coordinates only.
        loaded: True if the shape is multiplied by the load, which is the magnitude of the effort that the drive
            transmits along the coordinate [N m, N], see `dvrk_drake.dynamics.dynamic_model.DynamicModel`.
        position_power: Exponent k of the factor |x|^k by which the shape is multiplied.
    """

    unit: str
    code: int
    role: Role
    scale: str = ""
    dissipative: bool = False
    revolute: bool = False
    loaded: bool = False
    position_power: int = 0

    @property
    def prior_share(self) -> float:
        """Prior standard deviation of the torque of an effect, as a share of the RMS effort. The prior mean is 0.

        Friction is a sum of several effects, so each of them is small.
        """
        return 0.1 if self.dissipative else 0.3

    @property
    def bounded(self) -> bool:
        """True for dry friction whose largest effort is its coefficient."""
        return self.role == "dry" and not self.loaded and not self.position_power

    @property
    def symmetric(self) -> bool:
        """True for dry friction whose effort is at most its coefficient and equal in both directions at all speeds."""
        return self.bounded and self.dissipative


_WIDTH = "speed at which the smoothed sign is 0.76 [rad/s, m/s]"
_TRAVEL = "travel before sliding [rad, m]"
_PERIODS = "number of periods per revolution"
#: Name -> kind of effect.
EFFECT_KINDS: dict[str, EffectKind] = {
    # Cable preload or offset of the motor current.
    "offset": EffectKind("N m", 0, "offset"),
    "viscous": EffectKind("N m s/rad", 1, "viscous", dissipative=True),
    "coulomb": EffectKind("N m", 2, "dry", _WIDTH, dissipative=True),
    "coulomb forward": EffectKind("N m", 3, "dry", _WIDTH),
    "stribeck": EffectKind("N m", 4, "dry", _WIDTH),
    "presliding": EffectKind("N m", 5, "dry", _TRAVEL, dissipative=True),
    "presliding forward": EffectKind("N m", 6, "dry", _TRAVEL),
    # Friction of gears and cables, which increases with the load.
    "load coulomb": EffectKind("1", 2, "dry", _WIDTH, dissipative=True, loaded=True),
    # Friction of cable pulleys, whose angle of wrap changes with the position.
    "position coulomb": EffectKind("N m/rad", 2, "dry", _WIDTH, dissipative=True, position_power=1),
    "position^2 coulomb": EffectKind("N m/rad^2", 2, "dry", _WIDTH, dissipative=True, position_power=2),
    "spring": EffectKind("N m/rad", 7, "position", "largest |x| of the linear range [rad, m]"),
    # A spring or cable that is attached off the axis causes one period per revolution. An eccentric pulley or the
    # strands of a cable cause more periods.
    "cable sine": EffectKind("N m", 8, "position", _PERIODS, revolute=True),
    "cable cosine": EffectKind("N m", 9, "position", _PERIODS, revolute=True),
}
#: Kinds of effects that depend on position only.
POSITION_KINDS = tuple(name for name, kind in EFFECT_KINDS.items() if kind.role in ("position", "offset"))


def kind_fault(kind: str, scale: float, coefficient: float, kinds: Collection[str] = EFFECT_KINDS) -> str:
    """Returns why an effect with these numbers is not valid, including the allowed values, or "" if it is valid.

    Args:
        kind: Kind of the effect.
        scale: Number with the meaning `EffectKind.scale`.
        coefficient: Coefficient of the effect; 0 if it is unknown.
        kinds: Allowed kinds.
    """
    if kind not in kinds:
        return f'kind is "{kind}"; allowed: {", ".join(kinds)}'
    meaning = EFFECT_KINDS[kind].scale
    if not (0 < scale < math.inf if meaning else scale == 0):
        allowed = f"a positive number, the {meaning}" if meaning else "0"
        return f"scale is {scale:g}; allowed for kind {kind}: {allowed}"
    if not -math.inf < coefficient < math.inf or (EFFECT_KINDS[kind].dissipative and coefficient < 0):
        allowed = "0 or more, since it is friction" if EFFECT_KINDS[kind].dissipative else "a finite number"
        return f"coefficient is {coefficient:g}; allowed for kind {kind}: {allowed}"
    return ""


#: Accepted quantization steps and noise of efforts. One bit of a dVRK wrist motor is 1e-5 N m.
_EFFORT_STEPS = within(1e-9, 100.0, "N m or N")
#: Accepted degrees of freedom of an estimated standard error.
FREEDOMS = within(1e-3, 1e12)


def half_width(standard_error: float, degrees_of_freedom: float | None) -> float:
    """Returns half the width of a 95 % interval, from Student's t distribution.

    Args:
        standard_error: Standard error, itself estimated from residuals.
        degrees_of_freedom: Degrees of freedom of this estimate. None: unknown and assumed to be many.
    """
    from scipy.special import stdtrit  # takes 0.1 s, and most commands form no interval

    return float(stdtrit(np.inf if degrees_of_freedom is None else degrees_of_freedom, 0.975)) * standard_error


@dataclass
class DriveEffect(Shared):
    """One effect along a coordinate of the drive. It is defined in an arm file or identified from a recording.

    Attributes:
        coordinate: "actuator.<name>", "joint.<name>", or one of the arm's `friction_coordinates`.
        kind: Kind of effect, see `dvrk_drake.models.effects_schema.EFFECT_KINDS`.
        scale: Parameter whose meaning depends on the kind: width of the smoothed sign function [rad/s, m/s], travel
            before sliding [rad, m], linear range of a spring [rad, m], or number of periods per revolution.
        coefficient: Coefficient of the effect. The unit depends on the kind: N m, N m s/rad or N m/rad, or N, N s/m or
            N/m for a prismatic coordinate.
        standard_error: Standard error of the coefficient, in the same unit; 0 if the effect was not identified.
        degrees_of_freedom: Degrees of freedom of the standard error, see `half_width`.
    """

    coordinate: str = ""
    kind: str = ""
    scale: float = field(default=0.0, metadata=within(1e-9, 1000.0, also=(0.0,)))
    coefficient: float = field(default=0.0, metadata=within(-1e6, 1e6, "N m, N m s/rad or N m/rad"))
    standard_error: float = field(default=0.0, kw_only=True, metadata=within(0.0, 1e9))
    degrees_of_freedom: float | None = field(default=None, kw_only=True, metadata=FREEDOMS)

    @property
    def distinguishable(self) -> bool:
        """Returns whether the 95 % interval of the coefficient excludes 0."""
        return abs(self.coefficient) > half_width(self.standard_error, self.degrees_of_freedom)


@dataclass
class FrictionEffect(DriveEffect):
    """One friction effect, see `dvrk_drake.systems.arm_effects.dry_friction.add_friction`.

    Attributes:
        fall_speed: Stribeck velocity of the kind "presliding" [rad/s, m/s]. At this speed, the friction is 1/e of its
            static value. If `fall_speed` is 0, friction does not depend on the speed.
    """

    fall_speed: float = field(default=0.0, metadata=within(1e-6, 100.0, "rad/s or m/s", also=(0.0,)))


@dataclass
class EncoderEffect(Shared):
    """Quantization of positions, and low-pass filter of velocities.

    `resolution` maps an actuator to the size of one count [rad, m]. The positions of actuators without an entry are
    exact. `velocity_cut_off` [Hz] is the cut-off frequency of the first-order low-pass filter for velocities, which are
    computed from the difference of two positions.
    """

    resolution: dict[str, float] = field(default_factory=dict, metadata=within(1e-9, 0.1, "rad or m"))
    velocity_cut_off: float = field(default=30.0, metadata=within(0.1, 1e4, "Hz"))


@dataclass
class EffortEffect(Shared):
    """Quantization and noise of the motor currents, as efforts of the actuators [N m, N].

    Each attribute maps an actuator to a value. The efforts of actuators without an entry are exact.
    `command_resolution` is the quantization step of commanded efforts, `measured_resolution` that of measured efforts.
    `noise` is the standard deviation of measured efforts.
    """

    command_resolution: dict[str, float] = field(default_factory=dict, metadata=_EFFORT_STEPS)
    measured_resolution: dict[str, float] = field(default_factory=dict, metadata=_EFFORT_STEPS)
    noise: dict[str, float] = field(default_factory=dict, metadata=_EFFORT_STEPS)


@dataclass
class DelayEffect(Shared):
    """Delays in time steps of the plant: from the arm to the measurement, and from the command to the motors."""

    measurement: int = field(default=0, metadata=within(0, 100, "time steps"))
    command: int = field(default=0, metadata=within(0, 100, "time steps"))


@dataclass
class ArmEffects(Shared):
    """Effects of a real arm. Each field is an effect group that a simulation can include by name.

    Attributes:
        friction: Dry and viscous friction, computed by the solver of the plant.
        cables: Position-dependent torques of cables.
        springs: Position-dependent torques of springs.
        stops: True if the arm's coupled limits are hard stops.
        saturation: Mapping from an actuator to the largest effort of its motor [N m, N]. Actuators without an entry do
            not saturate.
        encoder: Quantization of positions, and estimation of velocities from the quantized positions.
        effort: Quantization and noise of the motor currents.
        delay: Delays of measurement and command.
    """

    friction: list[FrictionEffect] = field(default_factory=list)
    cables: list[DriveEffect] = field(default_factory=list)
    springs: list[DriveEffect] = field(default_factory=list)
    stops: bool = False
    saturation: dict[str, float] = field(default_factory=dict, metadata=within(0.001, 1e6, "N m or N"))
    encoder: EncoderEffect | None = None
    effort: EffortEffect | None = None
    delay: DelayEffect | None = None

    @property
    def position_dependent(self) -> list[DriveEffect]:
        """Cables and springs, whose torques also act at rest."""
        return [*self.cables, *self.springs]

    def only(self, names: Sequence[str]) -> "ArmEffects":
        """Returns these effects with only the named groups. The name "all" selects all groups.

        Raises:
            ArmError: A name is not an effect group.
        """
        if unknown := sorted(set(names) - {*EFFECT_NAMES, "all"}):
            raise ArmError(f"unknown effect {', '.join(unknown)}; allowed: all, {', '.join(EFFECT_NAMES)}")
        if "all" in names:
            return self
        return ArmEffects(**{name: getattr(self, name) for name in names})

    def without(self, name: str) -> "ArmEffects":
        """Returns these effects without the named group.

        Raises:
            ArmError: The name is not an effect group.
        """
        self.only([name])
        return self.only([other for other in EFFECT_NAMES if other != name])

    def joined(self, other: "ArmEffects") -> "ArmEffects":
        """Returns these effects, extended by the effects `other` of an instrument."""
        return ArmEffects(**{name: _joined(getattr(self, name), getattr(other, name)) for name in EFFECT_NAMES})

    def check(self, joint_names: Sequence[str]) -> None:
        """Checks the range of all numbers, the kinds of the effects and the names of the actuators.

        Raises:
            ArmError: A number, a kind or an actuator is not accepted. The message names the field, its value and the
                accepted values.
        """
        if fault := number_fault(self):
            raise ArmError(fault)
        tables: dict[str, dict[str, Any]] = {"saturation": self.saturation}
        if self.encoder is not None:
            tables["encoder.resolution"] = self.encoder.resolution
        if self.effort is not None:
            tables |= {f"effort.{key}": value for key, value in vars(self.effort).items()}
        for table, values in tables.items():
            if unknown := sorted(set(values) - set(joint_names)):
                raise ArmError(f"{table}: unknown actuator {unknown[0]}; allowed: {', '.join(joint_names)}")
        for group, effects, kinds in (
            ("friction", self.friction, FRICTION_KINDS),
            ("cables", self.cables, POSITION_KINDS),
            ("springs", self.springs, POSITION_KINDS),
        ):
            for effect in effects:
                if fault := kind_fault(effect.kind, effect.scale, effect.coefficient, kinds):
                    raise ArmError(f"{group} of {effect.coordinate}: {fault}")
        for effect in self.friction:
            if effect.fall_speed and effect.kind != "presliding":
                where = f"friction of {effect.coordinate}"
                raise ArmError(f"{where}: fall_speed of {effect.kind} is {effect.fall_speed:g}; allowed: 0")


#: Kinds that `friction` accepts: friction that the solver of the plant can compute.
FRICTION_KINDS = ("presliding", "presliding forward", "coulomb", "viscous")
#: Names of all effect groups.
EFFECT_NAMES = tuple(f.name for f in dataclasses.fields(ArmEffects))


def per_actuator(values: dict[str, float], joint_names: Sequence[str], otherwise: float) -> NDArray[np.float64]:
    """Returns an array (n,) with the value of each actuator in `values`, or `otherwise` if it has no entry."""
    return np.array([values.get(name, otherwise) for name in joint_names])


def _joined(one: Any, other: Any) -> Any:
    if one is None or other is None:
        return one if other is None else other
    if isinstance(one, bool):
        return one or other
    if isinstance(one, list) and isinstance(other, list):
        return one + other
    if isinstance(one, dict) and isinstance(other, dict):
        return {**one, **other}
    if dataclasses.is_dataclass(one) and not isinstance(one, type):
        merged = {f.name: _joined(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(one)}
        return dataclasses.replace(one, **merged)
    return one
