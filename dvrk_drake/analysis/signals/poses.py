"""The poses in a recording of any kind: poses already, a motion with rests, or one that has only slow parts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.rests import LEAST_ROWS, LONGEST_PERIOD, rest_poses
from dvrk_drake.analysis.signals.slow_parts import slow_parts
from dvrk_drake.analysis.static.static_identification import LEAST_POSES
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording

#: What must be said where slow parts are used.
SLOW_PARTS_NOTE = (
    "where a joint is slow is taken for a pose of it; friction stays in its torque, and other joints may move: trust "
    "the ten-fold errors, and another day's recording, not the fit"
)


class Poses(NamedTuple):
    """What `find_poses` found.

    Attributes:
        recording: one row a pose, or the recording as it was.
        measured: (m, n) where an effort is a holding torque; None: everywhere.
        note: where the poses are from, or "".
        moves: the arm moves all the time: there are no poses, but a dynamic model can be had.
    """

    recording: Recording
    measured: NDArray[np.bool_] | None
    note: str
    moves: bool = False


def find_poses(recording: Recording, arm: Arm, take_slow_parts: bool = False) -> Poses:
    """The rests of a motion if there are `LEAST_POSES`, else its slow parts if wanted, else the recording as it is.

    Args:
        recording: poses or a motion, in either coordinates.
        arm: which was recorded.
        take_slow_parts: of a motion without enough rests, see `slow_parts`.

    Raises:
        RecordingError: the recording does not fit the arm, has no efforts, or is a motion whose times go back.
        IdentificationError: no slow parts, where they are wanted.
    """
    recording.check_fits(arm)
    _check_times(recording, arm)
    rests = rest_poses(recording, arm)
    if rests is not None and len(rests) >= LEAST_POSES:
        return Poses(rests, None, f"{len(rests)} poses at which the arm rests are taken; {len(recording)} rows")
    if take_slow_parts:
        return Poses(*slow_parts(recording, arm), note=SLOW_PARTS_NOTE)
    return Poses(recording, None, "", moves=rests is not None and bool(recording.motion(arm)))


def _check_times(recording: Recording, arm: Arm) -> None:
    """Refuses a motion whose times do not increase: it would be taken for poses."""
    t = recording.t
    if t is None or len(t) < LEAST_ROWS or np.all(np.diff(t) > 0):
        return
    if np.median(np.abs(np.diff(t))) < LONGEST_PERIOD or recording.motion(arm):
        row = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
        raise RecordingError(
            f"{recording.where(row)}: time t does not increase; rows of a motion must follow in time: sort them, and "
            "write one clock's times [s]"
        )
