"""Last measurement of an arm, with checks of the arm's clock and of the measured numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.systems.guard.command_stream import is_finite
from dvrk_drake.systems.guard.limits import Vector

#: Largest number of steps without an advance of the arm's clock. While this clock stands still, commands do not expire
#: by it. Several steps are allowed, because Drake updates the guard twice at time zero.
_MAX_STEPS_AT_ONE_TIME = 10


@dataclass
class Measurement:
    """Last measurement of an arm with n joints. All times in us are on the arm's clock.

    Attributes:
        num_joints: Number of joints n.
        max_age: Largest age of a valid measurement [us].
        utime: Time of the last step [us], or None before the first step.
        q: Last valid positions (n,) [rad, m], or None before the first valid measurement.
        v: Velocities (n,) [rad/s, m/s] of the last valid measurement.
        effort: Applied motor efforts (n,) [N m, N] of the last valid measurement.
        dt: Time between the last two valid measurements [s]; 0 for a repeated measurement, inf for the first
            measurement.
        num_invalid: Number of consecutive invalid measurements up to now.
    """

    num_joints: int
    max_age: int
    utime: int | None = None
    q: Vector | None = None
    v: Vector = field(init=False)
    effort: Vector = field(init=False)
    dt: float = math.inf
    num_invalid: int = 0
    _measured_utime: int | None = None
    _steps_at_one_time: int = 0

    def __post_init__(self) -> None:
        self.v = self.effort = np.zeros(self.num_joints)

    def advance(self, utime: int) -> tuple[float, str]:
        """Advances to `utime` [us]. Returns the elapsed time [s] and the description of a clock fault, or ""."""
        dt = 0.0 if self.utime is None else 1e-6 * (utime - self.utime)
        self._steps_at_one_time = 0 if dt else self._steps_at_one_time + 1
        self.utime = utime
        if dt < 0:
            self._measured_utime = None
            return dt, f"the arm's clock went back by {-dt:.6f} s"
        return dt, "the arm's clock stands still" if self._steps_at_one_time > _MAX_STEPS_AT_ONE_TIME else ""

    def time_since(self, measured_utime: int) -> float:
        """Returns the time [s] from the last valid measurement to `measured_utime` [us], or inf without a valid one."""
        return math.inf if self._measured_utime is None else 1e-6 * (measured_utime - self._measured_utime)

    def store(
        self,
        measured_utime: int,
        q: ArrayLike,
        v: ArrayLike,
        effort: ArrayLike,
        implausible_pose: Callable[[Vector], str] | None = None,
    ) -> str:
        """Stores a measurement if it is valid.

        Args:
            measured_utime: Time of the measurement [us].
            q: Positions (n,) [rad, m].
            v: Velocities (n,) [rad/s, m/s].
            effort: Applied motor efforts (n,) [N m, N].
            implausible_pose: Function that returns the reason why a pose is implausible, or "" for a plausible pose.
                The caller passes this function for a measurement that will not be compared with an earlier one. None:
                the pose is not checked.

        Returns:
            Reason why the measurement is invalid, or "" for a valid measurement.
        """
        assert self.utime is not None
        age, dt = self.utime - measured_utime, self.time_since(measured_utime)
        if not 0 <= age <= self.max_age:
            self.num_invalid += 1
            return f"the measurement is {1e-6 * age:.3f} s old; allowed: 0 to {1e-6 * self.max_age:g} s"
        if dt == 0:
            self.dt = 0.0
            return ""
        if dt < 0:
            self.num_invalid += 1
            return f"the measurement is {-dt:.6f} s older than the previous one"
        q, v, effort = (np.array(numbers, float) for numbers in (q, v, effort))
        self.num_invalid += 1
        if not (
            q.shape == v.shape == effort.shape == (self.num_joints,)
            and is_finite([*q.tolist(), *v.tolist(), *effort.tolist()])
        ):
            return f"the measured positions, velocities or efforts are not {self.num_joints} finite numbers each"
        if implausible_pose is not None and (problem := implausible_pose(q)):
            return problem
        self.dt, self.q, self.v, self.effort, self._measured_utime, self.num_invalid = (
            dt,
            q,
            v,
            effort,
            measured_utime,
            0,
        )
        return ""
