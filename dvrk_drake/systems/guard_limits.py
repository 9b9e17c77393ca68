"""Keeps commands inside an arm's limits of effort, rate and position: what a command guard does with good commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.systems.guard_settings import GuardSettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

Vector = NDArray[np.float64]
Flags = NDArray[np.int8]

#: A limit that is approached at this many margins a second is met by all of the wall [1/s].
_WALL_RATE = 20.0

_ROUNDING = 1e-12


class GuardLimits:
    """Limits of one arm, for n joints in its order.

    **Effort commands** meet a soft wall in the margin before each position limit lower <= A q <= upper, the joint box
    and the coupled limits alike: a spring and damper along the limit's own coordinate c = A_k q,

        lambda = F_k clip(2 depth + rate / (20/s margin), 0, 1),  tau -= A_k' lambda,

    depth from 0 at the margin's beginning to 1 at the limit, rate = dc/dt outward, F_k the effort that outweighs every
    motor that can push along c. So at half of the margin no outward command is left, and at the limit all of it is
    directed inward; the arm is never pulled, only pushed back. Without efforts (a falling arm) the wall pushes all the
    same. The result is clamped and limited in rate.

    **Position commands** move a target that is limited in rate and never leaves the limits; a target that starts
    outside moves no further out.
    """

    def __init__(self, arm: Arm, settings: GuardSettings) -> None:
        """Of `arm`."""
        n = arm.num_joints
        self.effort_limits = np.array(arm.effort_limits)
        self.A, self.lower, self.upper = arm.limit_matrix()
        self.names = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
        width = self.upper - self.lower
        self.margin = np.minimum(settings.margin, settings.margin_fraction * width)
        self.start_position = self.margin[:n]
        self.start_effort = settings.start_effort * self.effort_limits
        self.speed = width[:n] / settings.traverse_time
        self._effort_rate = self.effort_limits / settings.effort_rise_time
        self._wall_effort = np.array([max(self.effort_limits[row != 0] / np.abs(row[row != 0])) for row in self.A])
        self._wall_flags = np.full(len(self.A), lcmt_dvrk_status.FLAG_COUPLED_LIMIT, np.int8)
        self._wall_flags[:n] = lcmt_dvrk_status.FLAG_POSITION_LIMIT

    def beyond(self, q: Vector) -> str:
        """The worst position limit that the pose q (n,) is beyond by more than half of its margin, in words; or ""."""
        c = self.A @ q
        excess = np.maximum(c - self.upper, self.lower - c) / self.margin
        k = int(np.argmax(excess))
        if not excess[k] > 0.5:
            return ""
        return f"{self.names[k]} = {c[k]:.4g} is beyond {self.lower[k]:.4g}..{self.upper[k]:.4g}"

    def limit_effort(self, command: Vector, last: Vector, q: Vector, v: Vector, dt: float) -> tuple[Vector, Flags]:
        """Effort (n,) to apply for `command`, `dt` seconds after `last` was applied, and the flags of the joints.

        All are (n,) [N m, N; rad, m; rad/s, m/s] and finite; `last` is inside the effort limits.
        """
        limit = self.effort_limits
        flags = np.where(np.abs(command) > limit, lcmt_dvrk_status.FLAG_EFFORT_CLAMPED, 0).astype(np.int8)
        c, rate = self.A @ q, (self.A @ v) / (_WALL_RATE * self.margin)
        to_upper, to_lower = (self.upper - c) / self.margin, (c - self.lower) / self.margin
        push_in = np.where(to_upper < 1, np.clip(2 * (1 - to_upper) + rate, 0, 1), 0.0)
        push_out = np.where(to_lower < 1, np.clip(2 * (1 - to_lower) - rate, 0, 1), 0.0)
        walls = self._wall_effort * (push_out - push_in)
        effort = np.clip(np.clip(command, -limit, limit) + walls @ self.A, -limit, limit)
        for k in np.flatnonzero(walls):
            flags[self.A[k] != 0] |= self._wall_flags[k]
        step = self._effort_rate * dt
        limited = np.clip(effort, last - step, last + step)
        flags[limited != effort] |= lcmt_dvrk_status.FLAG_RATE_LIMITED
        return np.clip(limited, -limit, limit), flags

    def limit_position(self, command: Vector, last: Vector, dt: float) -> tuple[Vector, Flags]:
        """Target (n,) for `command`, `dt` seconds after the target `last`, and the flags of the joints."""
        n = len(last)
        step = self.speed * dt
        target = np.clip(command, last - step, last + step)
        flags = np.where(target != command, lcmt_dvrk_status.FLAG_RATE_LIMITED, 0).astype(np.int8)
        c = self.A @ last
        lower, upper = np.minimum(self.lower, c), np.maximum(self.upper, c)
        inside = np.clip(target, lower[:n], upper[:n])
        flags[inside != target] |= lcmt_dvrk_status.FLAG_POSITION_LIMIT
        for k in range(n, len(self.A)):
            row = self.A[k]
            change = row @ inside - c[k]
            allowed = np.clip(change, lower[k] - c[k], upper[k] - c[k])
            if allowed != change:
                # The joints of this limit go the same part of their way, so that they stop on it together.
                part = np.where(row != 0, allowed / change, 1.0)
                inside = last + part * (inside - last)
                flags[row != 0] |= lcmt_dvrk_status.FLAG_COUPLED_LIMIT
        c = self.A @ inside
        if np.any((c > upper + _ROUNDING) | (c < lower - _ROUNDING)):
            # Coupled limits that share joints can undo one another's correction: then stay.
            return last.copy(), flags
        return inside, flags

    def limit_velocity(self, command: Vector, flags: Flags) -> Vector:
        """Feed-forward velocity (n,): of the command where its position is followed as it is, else zero."""
        return np.where(flags == 0, np.clip(command, -self.speed, self.speed), 0.0)
