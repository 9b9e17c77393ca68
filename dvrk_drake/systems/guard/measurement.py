"""Last measurement of an arm, its time, and the checks of its clock and numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.systems.guard.command_stream import is_finite
from dvrk_drake.systems.guard.limits import Vector

#: Largest number of steps at one time. Commands do not expire while the clock stands still. Drake steps twice at start.
_MAX_STEPS_AT_ONE_TIME = 10


@dataclass
class Measurement:
    """Last measurement of an arm with n joints, on the arm's clock [us].

    Attributes:
        num_joints: Number of joints n.
        oldest: Largest age of a valid measurement [us].
        utime: Time of the last step. None: not yet stepped.
        q: Last good positions (n,) [rad, m]. None: no good measurement yet.
        v: Velocities (n,) [rad/s, m/s].
        effort: Applied motor efforts (n,) [N m, N].
        dt: Time between the last two good measurements [s]; 0 for a repeated one, inf for the first one.
        bad: Number of measurements since the last good one.
    """

    num_joints: int
    oldest: int
    utime: int | None = None
    q: Vector | None = None
    v: Vector = field(init=False)
    effort: Vector = field(init=False)
    dt: float = math.inf
    bad: int = 0
    _measured_utime: int | None = None
    _steps_at_one_time: int = 0

    def __post_init__(self) -> None:
        self.v = self.effort = np.zeros(self.num_joints)

    def advance(self, utime: int) -> tuple[float, str]:
        """Advances to `utime`. Returns the elapsed time [s] and the fault of the clock, empty if there is none."""
        dt = 0.0 if self.utime is None else 1e-6 * (utime - self.utime)
        self._steps_at_one_time = 0 if dt else self._steps_at_one_time + 1
        self.utime = utime
        if dt < 0:
            self._measured_utime = None
            return dt, f"the arm's clock went back by {-dt:.6f} s"
        return dt, "the arm's clock stands still" if self._steps_at_one_time > _MAX_STEPS_AT_ONE_TIME else ""

    def time_since(self, measured_utime: int) -> float:
        """Returns the time from the last good measurement to `measured_utime` [us] in s; inf without one."""
        return math.inf if self._measured_utime is None else 1e-6 * (measured_utime - self._measured_utime)

    def store(
        self,
        measured_utime: int,
        q: ArrayLike,
        v: ArrayLike,
        effort: ArrayLike,
        implausible_pose: Callable[[Vector], str] | None = None,
    ) -> str:
        """Stores what was measured at `measured_utime` [us]. Returns the reason if it is invalid, otherwise "".

        `implausible_pose` checks positions that are not compared with earlier ones, and describes their error.
        """
        assert self.utime is not None
        age, dt = self.utime - measured_utime, self.time_since(measured_utime)
        if not 0 <= age <= self.oldest:
            self.bad += 1
            return f"the measurement is {1e-6 * age:.3f} s old; allowed is 0 to {1e-6 * self.oldest:g} s"
        if dt == 0:
            self.dt = 0.0
            return ""
        if dt < 0:
            self.bad += 1
            return f"the measurement is {-dt:.6f} s older than the previous one"
        q, v, effort = (np.array(numbers, float) for numbers in (q, v, effort))
        self.bad += 1
        if not (
            q.shape == v.shape == effort.shape == (self.num_joints,)
            and is_finite([*q.tolist(), *v.tolist(), *effort.tolist()])
        ):
            return f"the measured positions, velocities or efforts are not {self.num_joints} finite numbers each"
        if implausible_pose is not None and (problem := implausible_pose(q)):
            return problem
        self.dt, self.q, self.v, self.effort, self._measured_utime, self.bad = dt, q, v, effort, measured_utime, 0
        return ""
