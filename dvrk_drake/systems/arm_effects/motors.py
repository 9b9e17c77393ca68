"""From the effort that is commanded to what the motors give."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, per_actuator


class Motors:
    """What the motors make of the efforts that are commanded of the joints.

    On the actuators [N m, N]: the command, clamped to the joints' limits, as efforts of the actuators J^-T tau, in
    whole steps of `effort.command_resolution`, and no more than `saturation`.

    Attributes:
        constants: (3, n) limits of the joints, steps of the command, most of each motor: for `motor_effort_into`.
        to_motors: (n, n) J^-T.
    """

    def __init__(self, arm: Arm, effects: ArmEffects, effort_limits: NDArray[np.float64]) -> None:
        """Of `arm`; `effort_limits` (n,) are those of the joints."""
        names = arm.joint_names
        steps = per_actuator(effects.effort.command_resolution if effects.effort else {}, names, 0.0)
        self.constants = np.array([effort_limits, steps, per_actuator(effects.saturation, names, np.inf)])
        self.to_motors = np.ascontiguousarray(np.linalg.inv(arm.transmission.matrix).T)

    def effort(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) of the actuators, for a command (n,) on the joints."""
        effort = np.empty(len(self.to_motors))
        motor_effort_into(np.ascontiguousarray(command), self.constants, self.to_motors, effort)
        return effort


@numba.njit("float64(float64, float64)", cache=True)
def in_steps(value, step):
    """`value` to the next whole number of steps; exact where the step is 0."""
    return step * np.rint(value / step) if step > 0.0 else value


@numba.njit("void(float64[::1], float64[:, ::1], float64[:, ::1], float64[::1])", cache=True)
def motor_effort_into(command, constants, to_motors, effort):
    """`Motors.effort`, for compiled code."""
    limits, steps, most = constants
    effort[:] = 0.0
    for k in range(len(command)):
        tau = min(max(command[k], -limits[k]), limits[k])
        for i in range(len(effort)):
            effort[i] += to_motors[i, k] * tau
    for i in range(len(effort)):
        effort[i] = min(max(in_steps(effort[i], steps[i]), -most[i]), most[i])
