"""What an arm does from period to period with what its command guard has let pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.systems.guard.command_stream import is_finite
from dvrk_drake.systems.guard.limits import Flags, GuardLimits, Mask, Vector, clip


@dataclass
class GuardOutput:
    """What the arm shall do until the next step; n joints in the arm's order, always finite and inside the limits.

    Attributes:
        control_mode: lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        position: (n,) where to regulate to in HOLD and POSITION; else the measured pose [rad, m].
        velocity: (n,) feed-forward in POSITION; else zero [rad/s, m/s].
        effort: (n,) what the motors shall apply in EFFORT; else zero [N m, N].
        joint_flags: (n,) lcmt_dvrk_status.FLAG_* of what was limited.
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
    """Follows commands inside the limits, each kind from what the arm does when it begins. All arrays are (n,).

    Attributes:
        target: where the arm is regulated to in HOLD and POSITION [rad, m].
    """

    def __init__(self, limits: GuardLimits) -> None:
        """At rest; no array is changed in place, so copies may share them."""
        self._limits, self._zero = limits, np.zeros(len(limits.effort_limits))
        self.target = self._laggard = self._effort = self._kick = self._zero

    def off(self, q: Vector) -> GuardOutput:
        """No power, at the measured q."""
        return self._output(lcmt_dvrk_command.OFF, q)

    def latch(self, q: Vector, v: Vector) -> None:
        """Makes the measured q the target; an arm that moves at v may go on until it has been braked."""
        self.target = q.copy()
        speed = self._limits.speed
        self._laggard = q + self._limits.following_time * clip(v, -speed, speed)

    def hold(self, dt: float) -> GuardOutput:
        """At the target, `dt` seconds on."""
        self._follow_late(dt)
        return self._output(lcmt_dvrk_command.HOLD, self.target)

    def hold_valid_joints(self, q: Vector, v: Vector, valid: Mask, gravity: Vector) -> GuardOutput:
        """Efforts that hold the joints with a `valid` (n,) position, and leave the others with their `gravity` effort.

        Args:
            q, v: measured (n,) [rad, m, rad/s, m/s].
            valid: joints with a valid position; the others get no feedback.
            gravity: (n,) effort that the pose needs, with the last valid positions of the other joints [N m, N].
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
        """Whether q is as near to the target as position commands must be to a pose from which they start."""
        return bool(np.all(np.abs(self.target - q) <= self._limits.start_position))

    def begin_position(self) -> None:
        """Position commands act from now on; the target begins where it is."""
        self._laggard = self.target

    def follow_position(self, position: Vector, velocity: Vector, dt: float) -> GuardOutput:
        """`dt` seconds on towards a position, with a feed-forward velocity [rad, m, rad/s, m/s]."""
        self.target, flags = self._limits.limit_position(position, self.target, dt)
        self._follow_late(dt)
        velocity = self._limits.limit_velocity(velocity, self.target, flags)
        return self._output(lcmt_dvrk_command.POSITION, self.target, velocity=velocity, flags=flags)

    def _follow_late(self, dt: float) -> None:
        self._laggard = self._laggard + min(dt / self._limits.following_time, 1.0) * (self.target - self._laggard)

    def astray(self, q: Vector) -> str:
        """The joint that follows its target worst, in words, if it is further from it than allowed; or "".

        A position controller without feed-forward is late by Kd/Kp. So an arm may be anywhere between the target and
        one that follows it late, by first order with the time constant `following_time`, and that much beside it.
        """
        ahead = q - np.maximum(self.target, self._laggard)
        behind = np.minimum(self.target, self._laggard) - q
        share = np.maximum(ahead, behind) / self._limits.following_error
        j = int(np.argmax(share))
        if not share[j] > 1.0:
            return ""
        return (
            f"{self._limits.names[j]} = {q[j]:.4g} does not follow {self.target[j]:.4g}; "
            f"{self._limits.following_error[j]:.3g} away is allowed"
        )

    def begin_effort(self, effort: Vector, q: Vector) -> None:
        """Effort commands act from now on, from the measured effort at the pose q [N m, N, rad, m]."""
        limit = self._limits.command_limits
        self._effort = clip(effort, -limit, limit)
        # What the walls add at once to an arm at rest. `follow_effort` leaves it out, less and less.
        self._kick = self._limits.wall_effort(q, self._zero)[0]

    def follow_effort(self, effort: Vector, q: Vector, v: Vector, dt: float, begun: float) -> GuardOutput:
        """`dt` seconds on towards an effort, at q, v; `begun` says which share of the beginning has passed, 0 to 1."""
        self._effort, flags = self._limits.follow_effort(effort, self._effort, dt)
        left_out = None if begun == 1.0 else (1.0 - begun) * self._kick
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
        """Arrays of its own, which whoever gets them may change."""
        return GuardOutput(
            mode,
            position.copy(),
            self._zero.copy() if velocity is None else velocity,
            self._zero.copy() if effort is None else effort,
            np.zeros(len(position), np.int8) if flags is None else flags,
        )
