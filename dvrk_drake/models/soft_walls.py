"""Soft walls of a command guard before the position limits of an arm, see `GuardLimits`."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: Largest gain of a soft wall, divided by the gain of the position controller. Larger gains cause chatter at a period
#: of 1 ms.
_WALL_GAIN = 4.0


class SoftWalls(NamedTuple):
    """Soft walls before the position limits lower <= A q <= upper, see `Arm.limit_matrix`.

    Attributes:
        effort: Effort (k,) along A q that cancels the full motor effort of each joint of the limit.
        look_ahead: Times T (k,) [s]. A wall acts on A q + T A v.
        width: Smallest widths (k,) of the walls in the unit of A q, limited by the gain of the wall.
    """

    effort: NDArray[np.float64]
    look_ahead: NDArray[np.float64]
    width: NDArray[np.float64]

    @classmethod
    def of(cls, arm: Arm) -> SoftWalls:
        """Returns the walls of an arm."""
        A, _, _ = arm.limit_matrix()
        kp, kd = np.array(arm.gains.kp), np.array(arm.gains.kd)
        look_ahead = np.array([max((kd / kp)[row != 0]) for row in A])
        return cls(_wall_effort(arm), look_ahead, (wall_stiffness(arm) / kp).max(axis=1))


def wall_stiffness(arm: Arm) -> NDArray[np.float64]:
    """Returns the widths of the walls (k, n) times the gain kp of each joint, which do not depend on the gains."""
    A, _, _ = arm.limit_matrix()
    return 2 * _wall_effort(arm)[:, None] * A**2 / _WALL_GAIN


def _wall_effort(arm: Arm) -> NDArray[np.float64]:
    A, _, _ = arm.limit_matrix()
    limits = np.array(arm.effort_limits)
    return np.array([max(limits[row != 0] / np.abs(row[row != 0])) for row in A])
