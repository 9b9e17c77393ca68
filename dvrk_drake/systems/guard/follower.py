"""Computes an arm's output in each period from the commands that its guard accepted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.systems.guard.command_stream import is_finite
from dvrk_drake.systems.guard.limits import Flags, GuardLimits, Mask, Vector, clip


@dataclass
class GuardOutput:
    """Output of the guard until the next step, for n joints in the arm's order. Always finite and inside the limits.

    Attributes:
        control_mode: lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        position: Target (n,) of the regulation in HOLD and POSITION; otherwise the measured pose [rad, m].
        velocity: Feedforward velocity (n,) in POSITION; otherwise zero [rad/s, m/s].
        effort: Motor effort (n,) in EFFORT; otherwise zero [N m, N].
        joint_flags: lcmt_dvrk_status.FLAG_* (n,) of the limits that acted.
    """

    control_mode: int
    position: Vector
    velocity: Vector
    effort: Vector
    joint_flags: Flags

    def is_finite(self) -> bool:
        """Returns whether all numbers are finite."""
        return is_finite([*self.position.tolist(), *self.velocity.tolist(), *self.effort.tolist()])


class Follower:
    """Follows commands inside the limits. Each mode starts from the present state of the arm. All arrays are (n,).

    Attributes:
        target: Target of the regulation in HOLD and POSITION [rad, m].
    """

    def __init__(self, limits: GuardLimits) -> None:
        """Creates a follower at rest. No array is changed in place, so copies may share them."""
        self._limits, self._zero = limits, np.zeros(len(limits.effort_limits))
        self.target = self._filtered_target = self._effort = self._start_wall_effort = self._zero

    def off(self, q: Vector) -> GuardOutput:
        """Returns the output without power, at the measured q."""
        return self._output(lcmt_dvrk_command.OFF, q)

    def latch(self, q: Vector, v: Vector) -> None:
        """Makes the measured q the target. The following error allows for the braking distance of an arm at speed v."""
        self.target = q.copy()
        speed = self._limits.speed
        self._filtered_target = q + self._limits.following_time * clip(v, -speed, speed)

    def hold(self, dt: float) -> GuardOutput:
        """Returns the output that holds the target, `dt` seconds after the last one."""
        self._filter_target(dt)
        return self._output(lcmt_dvrk_command.HOLD, self.target)

    def hold_valid_joints(self, q: Vector, v: Vector, valid: Mask, gravity: Vector) -> GuardOutput:
        """Returns efforts that hold the joints with a valid position. The others get their gravity effort.

        Args:
            q, v: Measured positions and velocities (n,) [rad, m, rad/s, m/s].
            valid: Mask (n,) of joints with a valid position. The others get no feedback.
            gravity: Gravity effort (n,) of the pose, with the last valid positions of the other joints [N m, N].
        """
        limits = self._limits
        largest, least = limits.fault_effort, limits.fault_effort / 3
        upper = np.minimum(np.maximum(largest, gravity + least), limits.effort_limits)
        lower = np.maximum(np.minimum(-largest, gravity - least), -limits.effort_limits)
        effort = gravity + np.where(valid, limits.kp * (self.target - q) - limits.kd * v, 0.0)
        effort = clip(effort, lower, upper)
        flags = np.where(valid, 0, lcmt_dvrk_status.FLAG_IMPLAUSIBLE).astype(np.int8)
        return self._output(lcmt_dvrk_command.EFFORT, q, effort=effort, flags=flags)

    def is_near(self, q: Vector) -> bool:
        """Returns whether q is as near to the target as the first position commands must be to the start pose."""
        return bool(np.all(np.abs(self.target - q) <= self._limits.start_position))

    def begin_position(self) -> None:
        """Starts following position commands. The target starts from its present value."""
        self._filtered_target = self.target

    def follow_position(self, position: Vector, velocity: Vector, dt: float) -> GuardOutput:
        """Returns the output `dt` seconds on, towards a position with a feedforward velocity [rad, m, rad/s, m/s]."""
        self.target, flags = self._limits.limit_position(position, self.target, dt)
        self._filter_target(dt)
        velocity = self._limits.limit_velocity(velocity, self.target, flags)
        return self._output(lcmt_dvrk_command.POSITION, self.target, velocity=velocity, flags=flags)

    def _filter_target(self, dt: float) -> None:
        self._filtered_target = self._filtered_target + min(dt / self._limits.following_time, 1.0) * (
            self.target - self._filtered_target
        )

    def following_fault(self, q: Vector) -> str:
        """Describes the joint that is furthest from its target, if this is further than allowed. Empty: none.

        A position controller without feedforward lags by Kd/Kp. The arm may therefore be anywhere between the target
        and the target filtered to first order with the time constant `following_time`, plus the allowed error.
        """
        ahead = q - np.maximum(self.target, self._filtered_target)
        behind = np.minimum(self.target, self._filtered_target) - q
        share = np.maximum(ahead, behind) / self._limits.following_error
        j = int(np.argmax(share))
        if not share[j] > 1.0:
            return ""
        unit = self._limits.unit(j)
        return (
            f"{self._limits.names[j]} is at {q[j]:.4g} {unit} and does not follow its target {self.target[j]:.4g} {unit} "
            f"(allowed difference {self._limits.following_error[j]:.3g} {unit})"
        )

    def begin_effort(self, effort: Vector, q: Vector) -> None:
        """Starts following effort commands, from the measured effort at the pose q [N m, N, rad, m]."""
        limit = self._limits.command_limits
        self._effort = clip(effort, -limit, limit)
        # Initial effort of the walls on an arm at rest. `follow_effort` subtracts a decreasing share of it.
        self._start_wall_effort = self._limits.wall_effort(q, self._zero)[0]

    def follow_effort(self, effort: Vector, q: Vector, v: Vector, dt: float, begun: float) -> GuardOutput:
        """Returns the output `dt` seconds on, towards an effort at q, v. `begun` is the elapsed share of the start."""
        self._effort, flags = self._limits.follow_effort(effort, self._effort, dt)
        left_out = None if begun == 1.0 else (1.0 - begun) * self._start_wall_effort
        applied, walls = self._limits.restrain_effort(self._effort, q, v, left_out)
        return self._output(lcmt_dvrk_command.EFFORT, q, effort=applied, flags=flags | walls)

    def _output(
        self,
        mode: int,
        position: Vector,
        *,
        velocity: Vector | None = None,
        effort: Vector | None = None,
        flags: Flags | None = None,
    ) -> GuardOutput:
        """Returns an output with arrays of its own, which the caller may change."""
        return GuardOutput(
            mode,
            position.copy(),
            self._zero.copy() if velocity is None else velocity,
            self._zero.copy() if effort is None else effort,
            np.zeros(len(position), np.int8) if flags is None else flags,
        )
