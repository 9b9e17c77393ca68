"""Computes the output of the guard in each period from the accepted commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.systems.guard.command_stream import is_finite
from dvrk_drake.systems.guard.limits import Flags, GuardLimits, Mask, Vector, clip
from dvrk_drake.systems.guard.part import Part


@dataclass
class GuardOutput:
    """Output of the guard until the next step, for n joints in the arm's order.

    All numbers are finite and inside the limits.

    Attributes:
        control_mode: Mode lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        position: Target (n,) [rad, m] of the position controller in HOLD and POSITION; otherwise the measured pose.
        velocity: Feedforward velocity (n,) [rad/s, m/s] in POSITION; otherwise zero.
        effort: Motor effort (n,) [N m, N] in EFFORT; otherwise zero.
        joint_flags: Flags lcmt_dvrk_status.FLAG_* (n,) of the limits that acted on each joint.
    """

    control_mode: int
    position: Vector
    velocity: Vector
    effort: Vector
    joint_flags: Flags

    def is_finite(self) -> bool:
        """Returns whether all numbers are finite."""
        return is_finite([*self.position.tolist(), *self.velocity.tolist(), *self.effort.tolist()])


class Follower(Part):
    """Computes outputs that follow the commands inside the limits. Each mode starts from the present state of the arm.

    Attributes:
        target: Target (n,) [rad, m] of the position controller in HOLD and POSITION.
        effort: Effort (n,) [N m, N] that follows the commands, without soft walls and speed limit.
    """

    def __init__(self, limits: GuardLimits, safe_gains: tuple[Vector, Vector]) -> None:
        """Creates a follower at rest.

        Args:
            limits: Limits of the arm.
            safe_gains: Stiffness (n,) and damping (n,) of the safe state, see `GuardLimits.safe_gains`.
        """
        self._stiffness, self._damping = safe_gains
        self._limits, self._zero = limits, np.zeros(len(limits.effort_limits))
        self.target = self._filtered_target = self.effort = self._start_wall_effort = self._velocity = self._zero

    def off(self, q: Vector) -> GuardOutput:
        """Returns the output without motor power, at the measured pose q (n,) [rad, m]."""
        return self._output(lcmt_dvrk_command.OFF, q)

    def latch(self, q: Vector, v: Vector) -> None:
        """Sets the target to the measured pose q (n,) [rad, m] of an arm that moves with v (n,) [rad/s, m/s].

        The filtered target (see `following_fault`) starts ahead of q in the direction of v, so that the motion during
        braking causes no fault.
        """
        self.target = q.copy()
        speed = self._limits.speed
        self._filtered_target = q + self._limits.following_time * clip(v, -speed, speed)

    def hold(self, dt: float) -> GuardOutput:
        """Returns the next output, which holds the target. `dt` is the time since the previous output [s]."""
        self._filter_target(dt)
        return self._output(lcmt_dvrk_command.HOLD, self.target)

    def begin_safe_state(self, effort: Vector) -> None:
        """Starts the safe state from the present `effort` (n,) [N m, N]."""
        self.effort = clip(effort, -self._limits.effort_limits, self._limits.effort_limits)

    def hold_valid_joints(self, q: Vector, v: Vector, valid: Mask, gravity: Vector, dt: float) -> GuardOutput:
        """Returns the output of the safe state. It is damped also if the measurement is late.

        Joints with a valid position are regulated with the gains of `GuardLimits.safe_gains`. All other joints get only
        the gravity effort.

        Args:
            q: Measured positions (n,) [rad, m].
            v: Measured velocities (n,) [rad/s, m/s].
            valid: Mask (n,) of joints with a valid position.
            gravity: Gravity effort (n,) [N m, N] of the model at q, in which the last valid position replaces each
                invalid position.
            dt: Time since the previous output [s].
        """
        limits = self._limits
        largest, least = limits.fault_effort, limits.fault_effort / 3
        upper = np.minimum(np.maximum(largest, gravity + least), limits.effort_limits)
        lower = np.maximum(np.minimum(-largest, gravity - least), -limits.effort_limits)
        feedback = self._stiffness * (self.target - q) - self._damping * v
        effort = clip(gravity + np.where(valid, feedback, 0.0), lower, upper)
        self.effort = limits.limit_effort_rate(effort, self.effort, dt)
        flags = np.where(valid, 0, lcmt_dvrk_status.FLAG_IMPLAUSIBLE).astype(np.int8)
        return self._output(lcmt_dvrk_command.EFFORT, q, effort=self.effort.copy(), joint_flags=flags)

    def is_near(self, q: Vector) -> bool:
        """Returns whether q is near the target. The tolerance is that of the start check for position commands."""
        return bool(np.all(np.abs(self.target - q) <= self._limits.start_position))

    def begin_position(self) -> None:
        """Starts following position commands from the present target."""
        self._filtered_target, self._velocity = self.target, self._zero

    def follow_position(self, position: Vector, velocity: Vector, dt: float) -> GuardOutput:
        """Returns the next output for a position command.

        Args:
            position: Commanded position (n,) [rad, m].
            velocity: Commanded feedforward velocity (n,) [rad/s, m/s].
            dt: Time since the previous output [s].
        """
        self.target, flags = self._limits.limit_position(position, self.target, dt)
        self._filter_target(dt)
        self._velocity = self._limits.follow_velocity(velocity, self._velocity, flags, dt)
        velocity = self._limits.limit_velocity(self._velocity, self.target)
        return self._output(lcmt_dvrk_command.POSITION, self.target, velocity=velocity, joint_flags=flags)

    def _filter_target(self, dt: float) -> None:
        self._filtered_target = self._filtered_target + min(dt / self._limits.following_time, 1.0) * (
            self.target - self._filtered_target
        )

    def following_fault(self, q: Vector) -> str:
        """Returns a description of the joint with the largest following error, or "" if all errors are allowed.

        A position controller without feedforward follows a moving target with a delay of Kd/Kp. All positions between
        the target and the filtered target are therefore accepted. The filter is a first-order low-pass filter with time
        constant `following_time`. The accepted range is extended on both sides by the allowed error.
        """
        ahead = q - np.maximum(self.target, self._filtered_target)
        behind = np.minimum(self.target, self._filtered_target) - q
        share = np.maximum(ahead, behind) / self._limits.following_error
        j = int(np.argmax(share))
        if not share[j] > 1.0:
            return ""
        name, unit = self._limits.names[j], self._limits.unit(j)
        return (
            f"{name} is at {q[j]:.4g} {unit} and does not follow its target {self.target[j]:.4g} {unit} "
            f"(allowed difference {self._limits.following_error[j]:.3g} {unit})"
        )

    def begin_effort(self, effort: Vector, q: Vector) -> None:
        """Starts following effort commands from the measured `effort` (n,) [N m, N] at the pose q (n,) [rad, m]."""
        limit = self._limits.command_limits
        self.effort = clip(effort, -limit, limit)
        # Effort of the walls at the start for zero velocity. `follow_effort` subtracts a decreasing fraction of this
        # effort.
        self._start_wall_effort = self._limits.wall_effort(q, self._zero)[0]

    def follow_effort(self, effort: Vector, q: Vector, v: Vector, dt: float, start_share: float) -> GuardOutput:
        """Returns the next output for an effort command.

        Args:
            effort: Commanded effort (n,) [N m, N].
            q: Measured positions (n,) [rad, m].
            v: Measured velocities (n,) [rad/s, m/s].
            dt: Time since the previous output [s].
            start_share: Elapsed fraction (0 to 1) of the time in which the effort of the walls increases.
        """
        self.effort, flags = self._limits.follow_effort(effort, self.effort, dt)
        withheld = None if start_share == 1.0 else (1.0 - start_share) * self._start_wall_effort
        applied, walls = self._limits.restrain_effort(self.effort, q, v, withheld)
        return self._output(lcmt_dvrk_command.EFFORT, q, effort=applied, joint_flags=flags | walls)

    def _output(self, mode: int, position: Vector, **arrays: NDArray[Any]) -> GuardOutput:
        """Returns an output with `arrays`, whose arrays the caller may change. Arrays that are not given are zero."""
        zero, no_flags = self._zero, np.zeros(len(position), np.int8)
        zeros: dict[str, NDArray[Any]] = {"velocity": zero.copy(), "effort": zero.copy(), "joint_flags": no_flags}
        return GuardOutput(mode, position.copy(), **(zeros | arrays))
