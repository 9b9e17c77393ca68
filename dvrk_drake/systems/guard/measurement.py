"""What an arm measured last and when, and what can be said against it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.systems.guard.command_stream import is_finite
from dvrk_drake.systems.guard.limits import Vector

#: By a clock that stands still nothing expires; Drake takes two steps at the time at which it starts.
_MOST_STEPS_AT_ONE_TIME = 10


@dataclass
class Measurement:
    """Of an arm with n joints, on its own clock [us].

    Attributes:
        num_joints: n.
        oldest: above this age it is none [us].
        utime: when it was told last; None: not yet.
        q: positions (n,) [rad, m]; None: not known, or not any more.
        v: velocities (n,) [rad/s, m/s].
        effort: what the motors apply (n,) [N m, N].
    """

    num_joints: int
    oldest: int
    utime: int | None = None
    q: Vector | None = None
    v: Vector = field(default_factory=lambda: np.zeros(0))
    effort: Vector = field(default_factory=lambda: np.zeros(0))
    _steps_at_one_time: int = 0

    def advance(self, utime: int) -> tuple[float, str]:
        """Goes on to `utime`: the time that has passed [s], and what is wrong with the clock, in words, or ""."""
        dt = 0.0 if self.utime is None else 1e-6 * (utime - self.utime)
        self._steps_at_one_time = 0 if dt else self._steps_at_one_time + 1
        self.utime = utime
        if dt < 0:
            return dt, f"the arm's clock went back by {-dt:.6f} s"
        return dt, "the arm's clock stands still" if self._steps_at_one_time > _MOST_STEPS_AT_ONE_TIME else ""

    def take(self, age: int, q: ArrayLike, v: ArrayLike, effort: ArrayLike) -> str:
        """Takes what was measured `age` [us] ago; why it is none, in words, or ""."""
        q, v, effort = (np.array(numbers, float) for numbers in (q, v, effort))
        if not 0 <= age <= self.oldest:
            self.q = None
            return f"the measurement is {1e-6 * age:.3f} s old; allowed is 0 to {1e-6 * self.oldest:g} s"
        if not (q.shape == v.shape == effort.shape == (self.num_joints,) and is_finite(q, v, effort)):
            self.q = None
            return f"the measured positions, velocities or efforts are not {self.num_joints} finite numbers each"
        self.q, self.v, self.effort = q, v, effort
        return ""
