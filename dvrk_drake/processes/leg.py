"""The ways between poses: smooth, straight in joint space, no faster than allowed; and when an arm rests at one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

#: Least time of a leg [s]: short ones would begin and end with a jerk.
LEAST_DURATION = 0.3


class Leg:
    """A cubic in time from one joint state to rest.

    Attributes:
        duration: of it [s].
    """

    def __init__(
        self, q_start: NDArray[np.float64], v_start: NDArray[np.float64], q_end: NDArray[np.float64], duration: float
    ) -> None:
        """From q_start, v_start (n,) to rest at q_end (n,) [rad, m, rad/s, m/s] in `duration` [s]."""
        self.duration = duration
        velocities = np.column_stack([v_start, np.zeros_like(v_start)])
        self._q = PiecewisePolynomial.CubicHermite([0.0, duration], np.column_stack([q_start, q_end]), velocities)
        self._v = self._q.derivative()

    @classmethod
    def between(cls, q_start: NDArray[np.float64], q_end: NDArray[np.float64], speed: NDArray[np.float64]) -> Leg:
        """From rest to rest, no joint faster than `speed` (n,) [rad/s, m/s].

        It is straight, so between poses inside linear limits it stays inside of them.
        """
        # A cubic from rest to rest is 1.5 times as fast in its middle as on average.
        duration = max(LEAST_DURATION, 1.5 * float(np.max(np.abs(q_end - q_start) / speed)))
        return cls(q_start, np.zeros_like(q_start), q_end, duration)

    @classmethod
    def braking(cls, state: NDArray[np.float64], duration: float) -> Leg:
        """From a state (2n: q, then v) to rest at constant deceleration."""
        q, v = np.split(state, 2)
        return cls(q, v, q + 0.5 * duration * v, duration)

    def state(self, time: float) -> NDArray[np.float64]:
        """(2n,) q, then v at `time` [s] from 0 to the duration; outside of that, of its ends."""
        time = min(max(time, 0.0), self.duration)
        return np.concatenate([self._q.value(time).ravel(), self._v.value(time).ravel()])


class RestDetector:
    """An arm rests when all its joints have stayed near one pose for a while."""

    def __init__(self, tolerance: NDArray[np.float64], duration: float) -> None:
        """Within `tolerance` (n,) [rad, m] of one pose for `duration` [s]."""
        self._tolerance, self._duration = tolerance, duration
        self._since = 0.0
        self._q: NDArray[np.float64] | None = None

    def rests(self, time: float, q: NDArray[np.float64]) -> bool:
        """Whether it rests at `time` [s] with q (n,) measured; to be asked at every measurement."""
        if self._q is None or not np.all(np.abs(q - self._q) <= self._tolerance):  # also true of NaN
            self._q, self._since = q, time
        return time - self._since >= self._duration
