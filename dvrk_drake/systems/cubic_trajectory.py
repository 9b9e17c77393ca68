"""Trajectories between poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

#: Shortest duration of a trajectory [s]. Shorter trajectories would begin and end with a large acceleration.
MIN_DURATION = 0.3


class CubicTrajectory:
    """Cubic trajectory from a joint state to rest.

    Attributes:
        duration: Duration of the trajectory [s].
    """

    def __init__(
        self, q_start: NDArray[np.float64], v_start: NDArray[np.float64], q_end: NDArray[np.float64], duration: float
    ) -> None:
        """Creates a trajectory.

        Args:
            q_start: Initial positions (n,) [rad, m].
            v_start: Initial velocities (n,) [rad/s, m/s].
            q_end: Final positions (n,) [rad, m], at rest.
            duration: Duration of the trajectory [s].
        """
        self.duration = duration
        velocities = np.column_stack([v_start, np.zeros_like(v_start)])
        self._q = PiecewisePolynomial.CubicHermite([0.0, duration], np.column_stack([q_start, q_end]), velocities)
        self._v = self._q.derivative()

    @classmethod
    def rest_to_rest(
        cls, q_start: NDArray[np.float64], q_end: NDArray[np.float64], speed: NDArray[np.float64]
    ) -> CubicTrajectory:
        """Returns a trajectory from rest to rest on which no joint exceeds `speed` (n,) [rad/s, m/s].

        The path is a straight line in joint space. It is inside all limits if both poses are inside all limits.
        """
        # The peak speed of a cubic from rest to rest is 1.5 times its mean speed.
        duration = max(MIN_DURATION, 1.5 * float(np.max(np.abs(q_end - q_start) / speed)))
        return cls(q_start, np.zeros_like(q_start), q_end, duration)

    @classmethod
    def braking(cls, state: NDArray[np.float64], duration: float) -> CubicTrajectory:
        """Returns a trajectory with constant deceleration from `state` (2n,), i.e. q, v, to rest in `duration` [s]."""
        q, v = np.split(state, 2)
        return cls(q, v, q + 0.5 * duration * v, duration)

    def state(self, time: float) -> NDArray[np.float64]:
        """Returns the state (2n,), q, then v, at `time` [s]. The time is limited to the range from 0 to `duration`."""
        time = min(max(time, 0.0), self.duration)
        return np.concatenate([self._q.value(time).ravel(), self._v.value(time).ravel()])
