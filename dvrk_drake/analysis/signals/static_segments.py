"""Extracts static poses from a recording: rests of a motion, or its low-speed segments."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.low_pass import low_pass
from dvrk_drake.analysis.static.static_identification import MIN_POSES, average_repeated_poses
from dvrk_drake.errors import IdentificationError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import MAX_PERIOD, MIN_ROWS, Recording

#: Cut-off of the zero-phase low-pass filter for speeds [Hz], at most half the rate of a motion, and its order.
CUT_OFF, ORDER = 10.0, 4
#: Rest: largest speed of all joints [rad/s], [m/s], least duration [s], largest distance from its start [rad], [m].
MAX_REST_SPEED, MIN_REST, SAME_REST = (0.02, 0.002), 0.3, (0.01, 0.001)


def static_poses(recording: Recording, arm: Arm) -> Recording | None:
    """Extracts one row per pose at which the arm rests for 0.3 s, averaged over the settled second half.

    Rests at the same pose are averaged. A gap in the times ends a rest, because the motion in the gap is unknown.

    Args:
        recording: Motion. Its speeds are qd, or the derivative of q.
        arm: Arm that was recorded.

    Returns:
        The rests in joint coordinates and without time, possibly with no rows. None if `recording` is not a motion: its
        times do not increase by less than 0.05 s, or it has fewer than 100 rows.

    Raises:
        RecordingError: The recording has no efforts, or is of another arm.
    """
    moving = recording.in_joint_coordinates(arm)
    t = moving.t
    if t is None or not (moving.is_motion and moving.has_increasing_times):
        return None
    tau = moving.measured_effort()
    v = smooth_velocity(moving)
    still = np.all(np.abs(v) < arm.per_joint(*MAX_REST_SPEED), axis=1)
    still &= np.diff(t, append=t[-1]) < MAX_PERIOD
    least = round(MIN_REST / float(np.median(np.diff(t))))
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


def smooth_velocity(recording: Recording) -> NDArray[np.float64]:
    """Returns the velocities (m, n) of a motion, low-pass filtered without delay."""
    t = np.asarray(recording.t)
    qd = np.gradient(recording.q, t, axis=0) if recording.qd is None else recording.qd
    rate = 1 / float(np.median(np.diff(t)))
    return low_pass(qd, rate, CUT_OFF, ORDER)


def stationary_runs(
    still: NDArray[np.bool_], q: NDArray[np.float64], same: NDArray[np.float64], least: int
) -> Iterator[NDArray[np.int_]]:
    """Yields runs of `least` or more rows with `still` (m,) True and q (m, n) within `same` (n,) of its start.

    A run ends where q leaves this range, and the next run begins there.
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


#: Largest speed and acceleration in a low-speed segment, as shares of the joint's largest values.
SLOW_SPEED, SLOW_ACCELERATION = 0.1, 0.2
#: Rows with shorter intervals than this are averaged [s].
MIN_PERIOD = 0.005
#: Fewest consecutive samples of a low-speed segment.
MIN_SAMPLES = 3
#: Largest distance of any joint from the start of a low-speed segment [rad], [m]. Segments of one joint whose poses
#: agree within it are repetitions.
SAME_PART = 0.05, 0.005


class LowSpeedSegments(NamedTuple):
    """Low-speed segments of a motion, one row each.

    Attributes:
        recording: Mean poses and torques of the segments, in joint coordinates, without time.
        measured: (m, n) True at the one joint that is slow. Only its torque is a holding torque.
    """

    recording: Recording
    measured: NDArray[np.bool_]


def low_speed_segments(recording: Recording, arm: Arm) -> LowSpeedSegments:
    """Extracts low-speed segments of a motion as static poses, per joint, averaged with their repetitions.

    The torques contain two errors: inertial torques from the motion of other joints, and dry friction of either sign.
    If possible, use dynamic identification for a motion, or poses at which the whole arm rests (`static_poses`).

    Raises:
        RecordingError: The recording has no efforts, or is of another arm.
        IdentificationError: The recording has no times or speeds, or no low-speed segments.
    """
    moving = recording.in_joint_coordinates(arm)
    moving.measured_effort()
    where = recording.source or "recording"
    if moving.qd is None or not (moving.is_motion and moving.has_increasing_times):
        raise IdentificationError(
            f"{where}: the recording is not a motion, so it has no low-speed segments. Low-speed segments require the "
            f"columns qd1..qd{arm.num_joints}, times t that increase by less than {MAX_PERIOD} s, and at least "
            f"{MIN_ROWS} rows."
        )
    moving = _thinned(moving)
    tau, t = moving.measured_effort(), np.asarray(moving.t)
    v = smooth_velocity(moving)
    vd = np.gradient(v, t, axis=0)
    # Use the 99 % quantile instead of the maximum, so that one spike does not classify all other rows as slow.
    is_slow = np.abs(v) < SLOW_SPEED * np.quantile(np.abs(v), 0.99, axis=0)
    is_slow &= np.diff(t, append=t[-1])[:, None] < MAX_PERIOD
    is_slow &= np.abs(vd) < SLOW_ACCELERATION * np.quantile(np.abs(vd), 0.99, axis=0)
    parts = [
        (joint, rows) for joint in range(arm.num_joints) for rows in _parts_of(is_slow[:, joint], joint, moving, arm)
    ]
    if not parts:
        raise IdentificationError(
            f"{where}: the motion has no low-speed segments (below {100 * SLOW_SPEED:.0f} % of the largest speed and "
            f"{100 * SLOW_ACCELERATION:.0f} % of the largest acceleration of a joint). Record poses at rest."
        )
    measured = np.zeros((len(parts), arm.num_joints), dtype=bool)
    measured[range(len(parts)), [joint for joint, _ in parts]] = True
    means = replace(
        moving,
        q=np.array([moving.q[rows].mean(axis=0) for _, rows in parts]),
        tau=np.array([tau[rows].mean(axis=0) for _, rows in parts]),
        qd=None,
        t=None,
        lines=None if moving.lines is None else moving.lines[[rows[0] for _, rows in parts]],
    )
    return LowSpeedSegments(means, measured)


def _thinned(recording: Recording) -> Recording:
    """Averages blocks of rows to about 200 rows per second, because the low-pass filter removes faster changes."""
    t, qd, tau = recording.t, recording.qd, recording.measured_effort()
    if t is None or qd is None:
        return recording
    size = int(MIN_PERIOD / float(np.median(np.diff(t))) + 1e-6)
    if size < 2:
        return recording
    blocks = len(t) // size

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values[: blocks * size].reshape(blocks, size, *values.shape[1:]).mean(axis=1)

    lines = None if recording.lines is None else recording.lines[: blocks * size : size]
    return replace(recording, q=mean(recording.q), qd=mean(qd), tau=mean(tau), t=mean(t), lines=lines)


def _longest_of_each_pass(runs: Iterable[NDArray[np.int_]]) -> Iterator[NDArray[np.int_]]:
    """Yields the longest of each series of adjacent runs.

    Friction is the same in all runs of a series. They are not independent, so cross-validation requires one of them.
    """
    longest: NDArray[np.int_] | None = None
    last = -2
    for run in runs:
        if longest is not None and run[0] != last + 1:
            yield longest
            longest = None
        if longest is None or len(run) > len(longest):
            longest = run
        last = int(run[-1])
    if longest is not None:
        yield longest


def _parts_of(is_slow: NDArray[np.bool_], joint: int, moving: Recording, arm: Arm) -> list[NDArray[np.int_]]:
    """Returns the rows of each low-speed segment of one joint, with repetitions joined.

    The other joints stay within `SAME_PART` in each segment.
    """
    same = arm.per_joint(*SAME_PART)
    parts: list[NDArray[np.int_]] = []
    means = np.empty((0, arm.num_joints))
    for run in _longest_of_each_pass(stationary_runs(is_slow, moving.q, same, MIN_SAMPLES)):
        q = moving.q[run].mean(axis=0)
        alike = np.flatnonzero(np.all(np.abs(means - q) < same, axis=1))
        if len(alike):
            part = alike[0]
            parts[part] = np.concatenate([parts[part], run])
            means[part] = moving.q[parts[part]].mean(axis=0)
        else:
            parts.append(run)
            means = np.vstack([means, q])
    return parts


#: Note on models that are identified from low-speed segments.
LOW_SPEED_NOTE = (
    "Low-speed segments are treated as static poses. Their torques contain friction, and other joints may move. Use "
    "the cross-validated errors or another recording to evaluate the model, not the errors of the fit."
)


class Poses(NamedTuple):
    """Result of `find_poses`.

    Attributes:
        recording: One row per pose, or the unchanged recording.
        measured: (m, n) True where an effort is a holding torque. None if all are.
        note: Origin of the poses, or "".
        moves: True if the arm moves all the time. There are no poses then, but a dynamic model can be identified.
    """

    recording: Recording
    measured: NDArray[np.bool_] | None
    note: str
    moves: bool = False


def find_poses(recording: Recording, arm: Arm, with_low_speed_segments: bool = False) -> Poses:
    """Returns the rests of a motion if there are `MIN_POSES`, or its low-speed segments, or the unchanged recording.

    Args:
        recording: Poses or a motion, in joint or actuator coordinates.
        arm: Arm that was recorded.
        with_low_speed_segments: Use low-speed segments if a motion has too few rests, see `low_speed_segments`.

    Raises:
        RecordingError: The recording does not fit the arm, has no efforts, or is a motion with decreasing times.
        IdentificationError: Low-speed segments are requested, and there are none.
    """
    recording.check_fits(arm)
    _check_times(recording, arm)
    rests = static_poses(recording, arm)
    if rests is not None and len(rests) >= MIN_POSES:
        return Poses(rests, None, f"Static poses found in the motion: {len(rests)}, in {len(recording)} rows.")
    if with_low_speed_segments:
        return Poses(*low_speed_segments(recording, arm), note=LOW_SPEED_NOTE)
    return Poses(recording, None, "", moves=rests is not None and bool(recording.motion(arm)))


def _check_times(recording: Recording, arm: Arm) -> None:
    """Rejects a motion whose times do not increase, because it would be treated as poses."""
    t = recording.t
    if t is None or len(t) < MIN_ROWS or recording.has_increasing_times:
        return
    if recording.is_motion or recording.motion(arm):
        row = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
        raise RecordingError(
            f"{recording.where(row)}: time t does not increase. Sort the rows by time, and use the times of one clock "
            "[s]."
        )
