"""Kinds of effects in the drive: friction, cables, springs and offsets."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

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
