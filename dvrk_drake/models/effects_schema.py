"""Schema of `effects:` in an arm's YAML files: what a real arm has beside links, joints and a linkage.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ArmError
from dvrk_drake.models.schema_fault import formerly, number_fault, within

#: Steps and noise of efforts: one bit of a dVRK's wrist motor is 1e-5 N m.
_EFFORT_STEPS = within(1e-9, 100.0, "N m or N")


@dataclass
class DriveEffect:
    """One effect along a coordinate of the drive: what an arm's file states, and what an identification finds.

    Attributes:
        coordinate: "actuator.<name>", "joint.<name>", or one of the arm's `friction_coordinates`.
        kind: see `dvrk_drake.dynamics.actuator_effects.EFFECT_KINDS`.
        scale: of the kind: width of the smoothed sign [rad/s, m/s], travel until it slips [rad, m], periods in a turn.
        coefficient: [N m; N m s/rad, ...; N and m of a coordinate that slides].
        standard_error: of the coefficient, in its unit; 0 where it was not identified.
    """

    coordinate: str = ""
    kind: str = ""
    scale: float = field(default=0.0, metadata=within(1e-6, 1000.0, also=(0.0,)))
    coefficient: float = field(default=0.0, metadata=within(-1e6, 1e6, "N m, N m s/rad or N m/rad") | formerly("value"))
    standard_error: float = field(default=0.0, kw_only=True, metadata=within(0.0, 1e9))

    @property
    def distinguishable(self) -> bool:
        """Whether the size of the coefficient exceeds two standard errors."""
        return abs(self.coefficient) > 2 * self.standard_error


@dataclass
class FrictionEffect(DriveEffect):
    """One effect of friction, see `dvrk_drake.systems.arm_effects.dry_friction.add_friction`.

    Attributes:
        fall_speed: of "presliding": the speed at which it holds 1/e of what it holds at rest, Stribeck's effect
            [rad/s, m/s]; 0: it holds the same at all speeds.
    """

    fall_speed: float = field(default=0.0, metadata=within(1e-6, 100.0, "rad/s or m/s", also=(0.0,)))


@dataclass
class Cable:
    """Between the motor and the joint of an actuator that turns this joint alone: [N m/rad], damping [N m s/rad]."""

    stiffness: float = field(default=0.0, metadata=within(1e-3, 1e6, "N m/rad or N/m"))
    damping: float = field(default=0.0, metadata=within(0.0, 1000.0, "N m s/rad or N s/m"))


@dataclass
class EncoderEffect:
    """`resolution`: actuator -> one count [rad, m]; one that is not named is exact. `velocity_cut_off` [Hz] of the
    first-order low-pass behind the difference of two readings."""

    resolution: dict[str, float] = field(default_factory=dict, metadata=within(1e-9, 0.1, "rad or m"))
    velocity_cut_off: float = field(default=30.0, metadata=within(0.1, 1e4, "Hz"))


@dataclass
class EffortEffect:
    """Of the motor currents, as efforts of the actuators [N m, N]: actuator -> value; one that is not named is exact.

    `command_resolution` is a step of what is commanded, `measured_resolution` of what is measured, `noise` the standard
    deviation of what is measured.
    """

    command_resolution: dict[str, float] = field(default_factory=dict, metadata=_EFFORT_STEPS)
    measured_resolution: dict[str, float] = field(default_factory=dict, metadata=_EFFORT_STEPS)
    noise: dict[str, float] = field(default_factory=dict, metadata=_EFFORT_STEPS)


@dataclass
class DelayEffect:
    """In time steps of the plant: from the arm to what is measured, and from what is commanded to the motors."""

    measurement: int = field(default=0, metadata=within(0, 100, "time steps"))
    command: int = field(default=0, metadata=within(0, 100, "time steps"))


@dataclass
class ArmEffects:
    """Each field is a part that can be switched, and its name the name of the part.

    Attributes:
        friction: as elements of the plant's own solver.
        cables: torques of cables that depend on position.
        springs: the same of springs.
        stops: the arm's coupled limits are hard stops.
        stretch: actuator -> the cable that it pulls, behind which are motor, encoder and the actuator's own friction;
            one that is not named is stiff.
        saturation: actuator -> largest effort of its motor [N m, N]; one that is not named has none.
        encoder: positions are counts, velocities are estimated from them.
        effort: steps and noise of the motor currents.
        delay: of measurement and command.
    """

    friction: list[FrictionEffect] = field(default_factory=list)
    cables: list[DriveEffect] = field(default_factory=list)
    springs: list[DriveEffect] = field(default_factory=list)
    stops: bool = False
    stretch: dict[str, Cable] = field(default_factory=dict)
    saturation: dict[str, float] = field(default_factory=dict, metadata=within(0.001, 2000.0, "N m or N"))
    encoder: EncoderEffect | None = None
    effort: EffortEffect | None = None
    delay: DelayEffect | None = None

    def only(self, names: Sequence[str]) -> "ArmEffects":
        """These parts alone; "all" is every part.

        Raises:
            ArmError: a name that is no part.
        """
        if unknown := sorted(set(names) - {*EFFECT_NAMES, "all"}):
            raise ArmError(f"unknown effect {', '.join(unknown)}; allowed: all, {', '.join(EFFECT_NAMES)}")
        if "all" in names:
            return self
        return ArmEffects(**{name: getattr(self, name) for name in names})

    def without(self, name: str) -> "ArmEffects":
        """All parts but one.

        Raises:
            ArmError: a name that is no part.
        """
        self.only([name])
        return self.only([other for other in EFFECT_NAMES if other != name])

    def joined(self, other: "ArmEffects") -> "ArmEffects":
        """With what `other` (an instrument's) adds to lists and tables; a single number stays this one's."""
        return ArmEffects(**{name: _joined(getattr(self, name), getattr(other, name)) for name in EFFECT_NAMES})

    def check(self, joint_names: Sequence[str]) -> None:
        """Refuses numbers that no arm has, and actuators that this one has not.

        Raises:
            ArmError: names the field, its value, and what is allowed.
        """
        if fault := number_fault(self):
            raise ArmError(fault)
        tables: dict[str, dict[str, Any]] = {"saturation": self.saturation, "stretch": self.stretch}
        if self.encoder is not None:
            tables["encoder.resolution"] = self.encoder.resolution
        if self.effort is not None:
            tables |= {f"effort.{key}": value for key, value in vars(self.effort).items()}
        for table, values in tables.items():
            if unknown := sorted(set(values) - set(joint_names)):
                raise ArmError(f"{table}: unknown actuator {unknown[0]}; actuators: {', '.join(joint_names)}")
        for effect in self.friction:
            where = f"friction: {effect.coordinate} {effect.kind}"
            if effect.kind not in FRICTION_KINDS:
                raise ArmError(f'friction: kind "{effect.kind}"; allowed: {", ".join(FRICTION_KINDS)}')
            if effect.coefficient < 0 and effect.kind != "presliding forward":
                raise ArmError(f"{where} has coefficient {effect.coefficient:g}; it must not be negative")
            if effect.kind != "viscous" and effect.scale == 0:
                raise ArmError(f"{where} has scale 0; it must be positive")
            if effect.fall_speed and effect.kind != "presliding":
                raise ArmError(f"{where} has fall_speed {effect.fall_speed:g}; allowed: 0, others only of presliding")
        for law in [*self.cables, *self.springs]:
            if law.kind not in POSITION_KINDS:
                raise ArmError(f'cables, springs: kind "{law.kind}"; allowed: {", ".join(POSITION_KINDS)}')


#: What `friction` can hold: what a solver can take at the end of a step and what never gives energy.
FRICTION_KINDS = ("presliding", "presliding forward", "coulomb", "viscous")
#: What `cables` and `springs` can hold: each has a potential.
POSITION_KINDS = ("offset", "spring", "cable sine", "cable cosine")
#: The parts that can be switched.
EFFECT_NAMES = tuple(f.name for f in dataclasses.fields(ArmEffects))


def per_actuator(values: dict[str, float], joint_names: Sequence[str], otherwise: float) -> NDArray[np.float64]:
    """(n,) of a table actuator -> value, `otherwise` where it names none."""
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
