"""Computes the friction torque over speed and the cable torque over position of each drive coordinate of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.models.effect_kinds import POSITION_KINDS
from dvrk_drake.models.effects_schema import DriveEffect


def friction_curve(
    effects: Sequence[DriveEffect], coordinate: str, v: NDArray[np.float64], load: float = 0.0, x: float = 0.0
) -> NDArray[np.float64]:
    """Returns the friction torque (k,) along a coordinate at constant speeds v (k,) [rad/s, m/s].

    The result is the torque after the travel of presliding, when the joint slides. At v = 0, it is 0.

    Args:
        effects: Effects of a model. Those of other coordinates, and effects without friction, are ignored.
        coordinate: Key of `Arm.effect_coordinates`.
        v: Speeds of the coordinate.
        load: Magnitude of the effort along the coordinate, for load-dependent friction [N m, N].
        x: Position of the coordinate, for position-dependent friction [rad, m].
    """
    torque = np.zeros(len(v))
    for e in effects:
        if e.coordinate == coordinate and e.kind not in POSITION_KINDS:
            effect = ActuatorEffect.of(e)
            # After an infinite travel, the deflection of a presliding element has its final value.
            travel = [math.copysign(math.inf, speed) if speed else 0.0 for speed in v]
            shapes = [effect.step(0.0, dx, x, float(s), load)[1] for dx, s in zip(travel, v, strict=True)]
            torque += e.coefficient * np.array(shapes)
    return torque


def position_curve(effects: Sequence[DriveEffect], coordinate: str, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the torque (k,) of offset, cables and springs along a coordinate at positions x (k,) [rad, m].

    Args:
        effects: Effects of a model. Those of other coordinates, and friction, are ignored.
        coordinate: Key of `Arm.effect_coordinates`.
        x: Positions of the coordinate.
    """
    own = [e for e in effects if e.coordinate == coordinate and e.kind in POSITION_KINDS]
    return sum((e.coefficient * ActuatorEffect.of(e).column(x, 0 * x) for e in own), np.zeros(len(x)))
