"""Joints of a simulated dVRK arm that share a control mode."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

#: "none": the motors have no power. "free": effort mode with zero effort.
ControlMode = Literal["none", "position", "effort", "free"]

#: Time in which `move_jp` may move a joint over its full range [s].
_TRAVERSE_TIME = 3.0
#: Time in which `servo_jp` may move a joint over its full range [s].
_SERVO_TRAVERSE_TIME = 0.1


class JointGroup:
    """Control mode, set-point and commanded effort of some joints of an arm.

    Vectors have k elements, one per joint of the group [rad, rad/s, N m; m, m/s, N]. Arrays are replaced and not
    modified in place, because copies of a group share them.

    Attributes:
        joints: Indices (k,) of the joints in the arm.
        mode: Control mode.
        q, v: Positions and velocities of the set-point. In the modes "none", "effort" and "free", they are the measured
            positions and zero.
        effort: Commanded efforts inside the effort limits.
    """

    def __init__(self, arm: Arm, joints: Sequence[int]) -> None:
        """Creates a group in control mode "none".

        Args:
            arm: Arm of the group.
            joints: Indices (k,) of the joints in the arm.
        """
        self.joints = np.array(joints, int)
        self._names = [arm.joint_names[i] for i in joints]
        self._lower, self._upper = arm.position_lower[self.joints], arm.position_upper[self.joints]
        self._effort_limits = arm.effort_limits[self.joints]
        self._speed = (self._upper - self._lower) / _TRAVERSE_TIME
        self.mode: ControlMode = "none"
        self.q, self.v = np.clip(0.0, self._lower, self._upper), np.zeros(len(joints))
        self.effort = np.zeros(len(joints))
        self._trajectory: CubicTrajectory | None = None
        self._start = 0.0

    def __deepcopy__(self, memo: object) -> JointGroup:
        return copy.copy(self)

    @property
    def is_moving(self) -> bool:
        """True while the set-point follows a trajectory."""
        return self._trajectory is not None

    @property
    def is_effort_controlled(self) -> bool:
        """True if the commanded effort acts."""
        return self.mode in ("effort", "free")

    def fault(self, values: Sequence[float], quantity: str) -> str:
        """Returns the reason why commanded numbers are not accepted, or "" if they are accepted.

        Args:
            values: Commanded numbers. Accepted are k finite numbers.
            quantity: Name of the numbers for the message, e.g. "positions".
        """
        if len(values) != len(self._names):
            return f"{len(values)} {quantity}, allowed: {len(self._names)} for {', '.join(self._names)}"
        for name, value in zip(self._names, values, strict=True):
            if not abs(value) < IMPLAUSIBLE:  # also true for NaN
                return f"{name} is {value}; allowed: finite numbers with a magnitude below {IMPLAUSIBLE:g}"
        return ""

    def release(self) -> None:
        """Ends control."""
        self._change("none")

    def servo_jp(self, q: Sequence[float], v: Sequence[float] = ()) -> None:
        """Sets the set-point q (k,), v (k,), clipped to the position limits. Without velocities, they are zero."""
        self._change("position")
        self.q = np.clip(q, self._lower, self._upper)
        # A set-point at a limit does not move beyond the limit. The speed limit prevents extreme efforts of damping.
        largest = (self._upper - self._lower) / _SERVO_TRAVERSE_TIME
        self.v = np.where(self.q == q, np.clip(v, -largest, largest), 0.0) if len(v) else np.zeros(len(self.q))

    def servo_jf(self, effort: Sequence[float]) -> None:
        """Sets the effort (k,), clipped to the effort limits."""
        self._change("effort")
        self.effort = np.clip(effort, -self._effort_limits, self._effort_limits)

    def free(self) -> None:
        """Sets the effort to zero."""
        self._change("free")

    def hold(self) -> None:
        """Stops at the set-point. Outside position control, the set-point is the measured pose."""
        self.servo_jp(self.q)

    def move_jp(self, goal: Sequence[float] | None, time: float) -> None:
        """Moves the set-point to a goal (k,), clipped to the position limits, on a cubic trajectory.

        Args:
            goal: Positions at the end, at rest. None: the home pose, which is zero or the nearest position limit.
            time: Present time [s].
        """
        q, v = self.q, self.v
        self._change("position")
        q_end = np.clip(np.zeros(len(self._names)) if goal is None else goal, self._lower, self._upper)
        duration = CubicTrajectory.rest_to_rest(q, q_end, self._speed).duration
        self.q, self.v = q, v
        self._trajectory, self._start = CubicTrajectory(q, v, q_end, duration), time

    def step(self, time: float, q: NDArray[np.float64]) -> None:
        """Advances the set-point to `time` [s]. q (k,) is the measured pose."""
        if self.is_effort_controlled or self.mode == "none":
            self.q, self.v = q, np.zeros(len(q))
        elif self._trajectory is not None:
            elapsed = time - self._start
            position, self.v = np.split(self._trajectory.state(elapsed), 2)
            # A trajectory that replaces another one begins in motion and may exceed the limits.
            self.q = np.clip(position, self._lower, self._upper)
            if elapsed >= self._trajectory.duration:
                self._trajectory, self.v = None, np.zeros(len(q))

    def _change(self, mode: ControlMode) -> None:
        self.mode, self._trajectory = mode, None
        self.effort = np.zeros(len(self._names))
