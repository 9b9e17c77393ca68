"""The rests of a motion as poses: where no joint moves, every torque is a holding torque."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from dvrk_drake.analysis.static.static_identification import average_repeated_poses
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording

#: Cut-off of the zero-phase low-pass for speeds [Hz], and its order.
CUT_OFF, ORDER = 10.0, 4
#: Samples further apart than this are no motion that can be followed [s].
LONGEST_PERIOD = 0.5 / CUT_OFF
#: Fewest rows of a motion.
LEAST_ROWS = 100
#: At rest: all joints slower than this [rad/s], [m/s], for this long [s], and within this of its begin [rad], [m].
SLOWEST, LEAST_REST, SAME_REST = (0.02, 0.002), 0.3, (0.01, 0.001)


def rest_poses(recording: Recording, arm: Arm) -> Recording | None:
    """One row for each pose at which the arm rests for 0.3 s: means over the later half, when it has settled.

    Rests at one pose are averaged. A gap in the times ends a rest: nobody knows what the arm did meanwhile.

    Args:
        recording: over time; its speeds are qd, or q differentiated.
        arm: which was recorded.

    Returns:
        The rests in joint coordinates and without time; None if `recording` is no motion: no times that increase by
        less than 0.05 s, or fewer than 100 rows. It may have no rows.

    Raises:
        RecordingError: no efforts, or another arm's.
    """
    moving = recording.in_joint_coordinates(arm)
    t = moving.t
    if t is None or not is_motion(moving):
        return None
    tau = moving.measured_effort()
    v = smooth_velocity(moving)
    still = np.all(np.abs(v) < arm.per_joint(*SLOWEST), axis=1)
    still &= np.diff(t, append=t[-1]) < LONGEST_PERIOD
    least = round(LEAST_REST / float(np.median(np.diff(t))))
    runs = list(stationary_runs(still, moving.q, arm.per_joint(*SAME_REST), least))
    later = [run[len(run) // 2 :] for run in runs]
    rests = replace(
        moving,
        q=np.array([moving.q[rows].mean(axis=0) for rows in later]).reshape(-1, arm.num_joints),
        tau=np.array([tau[rows].mean(axis=0) for rows in later]).reshape(-1, arm.num_joints),
        qd=None,
        t=None,
        lines=None if moving.lines is None else moving.lines[[rows[0] for rows in later]],
    )
    return average_repeated_poses(rests, arm)


def is_motion(recording: Recording) -> bool:
    """Whether its rows follow each other closely enough in time to be differentiated."""
    t = recording.t
    if t is None or len(t) < LEAST_ROWS or not np.all(np.diff(t) > 0):
        return False
    return float(np.median(np.diff(t))) < LONGEST_PERIOD


def smooth_velocity(recording: Recording) -> NDArray[np.float64]:
    """(m, n) velocities of a motion below the cut-off, without delay."""
    t = np.asarray(recording.t)
    qd = np.gradient(recording.q, t, axis=0) if recording.qd is None else recording.qd
    rate = 1 / float(np.median(np.diff(t)))
    return sosfiltfilt(butter(ORDER, CUT_OFF, fs=rate, output="sos"), qd, axis=0)


def stationary_runs(
    still: NDArray[np.bool_], q: NDArray[np.float64], same: NDArray[np.float64], least: int
) -> Iterator[NDArray[np.int_]]:
    """Consecutive rows, `least` or more, where `still` (m,) holds and q (m, n) stays within `same` (n,) of the first.

    A run ends where q leaves, and the next one begins there.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    for first, end in edges.reshape(-1, 2):
        start = first
        while end - start >= least:
            away = np.any(np.abs(q[start:end] - q[start]) > same, axis=1)
            stop = start + int(np.argmax(away)) if np.any(away) else end
            if stop - start >= least:
                yield np.arange(start, stop)
            start = stop
