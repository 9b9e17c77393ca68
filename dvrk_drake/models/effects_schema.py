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


@dataclass
class DriveEffect:
    """One effect along a coordinate of the drive, as an identification finds it.

    Attributes:
        coordinate: "actuator.<name>", "joint.<name>", or one of the arm's `friction_coordinates`.
        kind: see `dvrk_drake.dynamics.actuator_effects.EFFECT_KINDS`.
        scale: of the kind: width of the smoothed sign [rad/s, m/s], travel until it slips [rad, m], periods in a turn.
        coefficient: [N m; N m s/rad, ...; N and m of a coordinate that slides].
    """

    coordinate: str = ""
    kind: str = ""
    scale: float = 0.0
    coefficient: float = 0.0


@dataclass
class FrictionEffect(DriveEffect):
    """One effect of friction, see `dvrk_drake.systems.real_arm.dry_friction.add_friction`.

    Attributes:
        fall_speed: of "presliding": the speed at which it holds 1/e of what it holds at rest, Stribeck's effect
            [rad/s, m/s]; 0: it holds the same at all speeds.
    """

    fall_speed: float = 0.0


@dataclass
class Cable:
    """Between the motor and the joint of an actuator that turns this joint alone: [N m/rad], damping [N m s/rad]."""

    stiffness: float = 0.0
    damping: float = 0.0


@dataclass
class EncoderEffect:
    """`resolution`: actuator -> one count [rad, m]; one that is not named is exact. `velocity_cut_off` [Hz] of the
    first-order low-pass behind the difference of two readings."""

    resolution: dict[str, float] = field(default_factory=dict)
    velocity_cut_off: float = 30.0


@dataclass
class EffortEffect:
    """Of the motor currents, as efforts of the actuators [N m, N]: actuator -> value; one that is not named is exact.

    `command_resolution` is a step of what is commanded, `measured_resolution` of what is measured, `noise` the standard
    deviation of what is measured.
    """

    command_resolution: dict[str, float] = field(default_factory=dict)
    measured_resolution: dict[str, float] = field(default_factory=dict)
    noise: dict[str, float] = field(default_factory=dict)


@dataclass
class DelayEffect:
    """In time steps of the plant: from the arm to what is measured, and from what is commanded to the motors."""

    measurement: int = 0
    command: int = 0


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
    saturation: dict[str, float] = field(default_factory=dict)
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
        tables = {"saturation": self.saturation}
        if self.encoder is not None:
            tables["encoder.resolution"] = self.encoder.resolution
            if not 0.1 <= self.encoder.velocity_cut_off <= 1e4:
                raise ArmError(f"encoder.velocity_cut_off = {self.encoder.velocity_cut_off:g} Hz; allowed: 0.1..10000")
        if self.effort is not None:
            tables |= {f"effort.{key}": value for key, value in vars(self.effort).items()}
        for table, values in tables.items():
            for actuator, value in values.items():
                if actuator not in joint_names:
                    raise ArmError(f"{table}: unknown actuator {actuator}; actuators: {', '.join(joint_names)}")
                if not (0 < value < 1e3):
                    raise ArmError(f"{table}.{actuator} = {value:g} must be a positive number below 1000")
        for which, ticks in vars(self.delay or DelayEffect()).items():
            if not 0 <= ticks <= 100:
                raise ArmError(f"delay.{which} = {ticks}; allowed: 0..100 time steps")
        for actuator, cable in self.stretch.items():
            if actuator not in joint_names:
                raise ArmError(f"stretch: unknown actuator {actuator}; actuators: {', '.join(joint_names)}")
            if not (0 < cable.stiffness < 1e6 and 0 <= cable.damping < 1e3):
                raise ArmError(f"stretch.{actuator} must have a stiffness in 0..1e6 and a damping in 0..1000")
        for effect in self.friction:
            where = f"friction: {effect.coordinate} {effect.kind}"
            if effect.kind not in FRICTION_KINDS:
                raise ArmError(f'friction: kind "{effect.kind}"; allowed: {", ".join(FRICTION_KINDS)}')
            least = -1e3 if effect.kind == "presliding forward" else 0.0
            if not least <= effect.coefficient < 1e3:
                raise ArmError(f"{where} has coefficient {effect.coefficient:g}; it must not be negative")
            if effect.kind != "viscous" and not 1e-9 < effect.scale < 1e3:
                raise ArmError(f"{where} has scale {effect.scale:g}; it must be positive")
            if not 0 <= effect.fall_speed < 1e3 or (effect.fall_speed and effect.kind != "presliding"):
                raise ArmError(
                    f"{where} has fall_speed {effect.fall_speed:g}; allowed: 0, and up to 1000 of presliding"
                )
        for law in [*self.cables, *self.springs]:
            if law.kind not in POSITION_KINDS:
                raise ArmError(f'cables, springs: kind "{law.kind}"; allowed: {", ".join(POSITION_KINDS)}')
            if not (np.isfinite(law.coefficient) and np.isfinite(law.scale)):
                raise ArmError(f"cables, springs: {law.coordinate} {law.kind} must have finite numbers")


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
