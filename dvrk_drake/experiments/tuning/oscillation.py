"""What a joint does after it was let go: whether it swings, how fast, and whether the swings grow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Oscillation:
    """Swings go from one turning point to the next.

    Attributes:
        swings: their number; the first is not judged, it begins with slack cables and an integral at zero.
        growth: the size of a swing over that of the one before, on average; 0 if there are too few to tell.
        period: of two swings [s]; infinite if there are too few to tell.
    """

    swings: int
    growth: float
    period: float

    @property
    def sustained(self) -> bool:
        """Whether it does not die away."""
        return self.growth >= 1.0


#: Swings that are judged after the first: enough for 1 % of growth to show, few enough not to reach the stops.
JUDGED = 8
#: With fewer nothing is said: a joint that sticks after three swings does not oscillate.
FEWEST = 3


def judge_oscillation(t: NDArray[np.float64], x: NDArray[np.float64], threshold: float) -> Oscillation:
    """Of a position x (m,) at times t (m,) after a release at rest; what is below `threshold` [rad, m] is no swing."""
    turns = turning_points(x, threshold)[: JUDGED + 2]
    swings = np.abs(np.diff(x[turns]))
    judged = swings[1:]
    if len(judged) < FEWEST:
        return Oscillation(len(swings), 0.0, np.inf)
    growth = (judged[-1] / judged[0]) ** (1.0 / (len(judged) - 1))
    half = np.diff(t[turns[1:]]).mean()
    return Oscillation(len(swings), float(growth), float(2.0 * half))


def turning_points(x: NDArray[np.float64], threshold: float) -> NDArray[np.int_]:
    """Indices of the first sample and of each extremum from which x (m,) comes back by more than `threshold`."""
    found, extreme, direction = [0], 0, 0.0
    for i, value in enumerate(x):
        way = value - x[extreme]
        if direction == 0.0:
            if abs(way) > threshold:
                direction, extreme = float(np.sign(way)), i
        elif way * direction >= 0:
            extreme = i
        elif -way * direction > threshold:
            found.append(extreme)
            direction, extreme = -direction, i
    return np.array(found)
