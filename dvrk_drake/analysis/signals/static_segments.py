"""Static segments of a recording as poses: rests of a motion, slow parts of one without rests, or poses already."""

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

#: Cut-off of the zero-phase low-pass for speeds [Hz], at most half the rate of a motion, and its order.
CUT_OFF, ORDER = 10.0, 4
#: At rest: all joints slower than this [rad/s], [m/s], for this long [s], and within this of its begin [rad], [m].
MAX_REST_SPEED, MIN_REST, SAME_REST = (0.02, 0.002), 0.3, (0.01, 0.001)


def static_poses(recording: Recording, arm: Arm) -> Recording | None:
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
    """(m, n) velocities of a motion below the cut-off, without delay."""
    t = np.asarray(recording.t)
    qd = np.gradient(recording.q, t, axis=0) if recording.qd is None else recording.qd
    rate = 1 / float(np.median(np.diff(t)))
    return low_pass(qd, rate, CUT_OFF, ORDER)


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


#: Slow: below this share of the joint's top speed, and of its top acceleration.
SLOW_SPEED, SLOW_ACCELERATION = 0.1, 0.2
#: Rows closer than this are averaged [s].
MIN_PERIOD = 0.005
#: Fewest consecutive samples that make a slow part.
MIN_SAMPLES = 3
#: A slow part ends where any joint is further than this from where it began [rad], [m]; those of one joint whose poses
#: agree this well are repetitions of one.
SAME_PART = 0.05, 0.005


class LowSpeedSegments(NamedTuple):
    """Slow parts of a motion, one row each.

    Attributes:
        recording: their mean poses and torques, in joint coordinates, without time.
        measured: (m, n) True at the one joint that was slow: only its torque is a holding torque.
    """

    recording: Recording
    measured: NDArray[np.bool_]


def low_speed_segments(recording: Recording, arm: Arm) -> LowSpeedSegments:
    """Finds them, joint by joint, and averages each with its repetitions.

    While other joints still move, their velocities and accelerations leave a little inertial torque in it; and dry
    friction stays in it, of either sign. Both are errors here: a motion wants dynamic identification, or rests of the
    whole arm (`static_poses`).

    Raises:
        RecordingError: no efforts, or another arm's.
        IdentificationError: no times or speeds, or nothing in it is slow.
    """
    moving = recording.in_joint_coordinates(arm)
    moving.measured_effort()
    where = recording.source or "recording"
    if moving.qd is None or not (moving.is_motion and moving.has_increasing_times):
        raise IdentificationError(
            f"{where}: slow parts need a motion: qd1..qd{arm.num_joints}, and t that increases by less than "
            f"{MAX_PERIOD} s, over {MIN_ROWS} rows or more"
        )
    moving = _thinned(moving)
    tau, t = moving.measured_effort(), np.asarray(moving.t)
    v = smooth_velocity(moving)
    vd = np.gradient(v, t, axis=0)
    # The 99 % quantile, not the maximum: one spike must not make everything else slow.
    is_slow = np.abs(v) < SLOW_SPEED * np.quantile(np.abs(v), 0.99, axis=0)
    is_slow &= np.diff(t, append=t[-1])[:, None] < MAX_PERIOD
    is_slow &= np.abs(vd) < SLOW_ACCELERATION * np.quantile(np.abs(vd), 0.99, axis=0)
    parts = [
        (joint, rows) for joint in range(arm.num_joints) for rows in _parts_of(is_slow[:, joint], joint, moving, arm)
    ]
    if not parts:
        raise IdentificationError(
            f"{where}: no joint is slow (below {SLOW_SPEED:.0%} of its speed and {SLOW_ACCELERATION:.0%} of its "
            "acceleration) anywhere; record poses at rest"
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
    """Means over blocks of rows, such that about 200 a second are left: more say nothing new below the cut-off."""
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
    """One run of those that follow each other without a row between: friction is the same in all of them.

    Left out one at a time they would vouch for each other.
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
    """Rows of each slow part of one joint, repetitions joined; the other joints stay within `SAME_PART` in each."""
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


#: What must be said where slow parts are used.
LOW_SPEED_NOTE = (
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


def find_poses(recording: Recording, arm: Arm, with_low_speed_segments: bool = False) -> Poses:
    """The rests of a motion if there are `MIN_POSES`, else its slow parts if wanted, else the recording as it is.

    Args:
        recording: poses or a motion, in either coordinates.
        arm: which was recorded.
        with_low_speed_segments: of a motion without enough rests, see `low_speed_segments`.

    Raises:
        RecordingError: the recording does not fit the arm, has no efforts, or is a motion whose times go back.
        IdentificationError: no slow parts, where they are wanted.
    """
    recording.check_fits(arm)
    _check_times(recording, arm)
    rests = static_poses(recording, arm)
    if rests is not None and len(rests) >= MIN_POSES:
        return Poses(rests, None, f"{len(rests)} poses at which the arm rests are taken; {len(recording)} rows")
    if with_low_speed_segments:
        return Poses(*low_speed_segments(recording, arm), note=LOW_SPEED_NOTE)
    return Poses(recording, None, "", moves=rests is not None and bool(recording.motion(arm)))


def _check_times(recording: Recording, arm: Arm) -> None:
    """Refuses a motion whose times do not increase: it would be taken for poses."""
    t = recording.t
    if t is None or len(t) < MIN_ROWS or recording.has_increasing_times:
        return
    if recording.is_motion or recording.motion(arm):
        row = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
        raise RecordingError(
            f"{recording.where(row)}: time t does not increase; rows of a motion must follow in time: sort them, and "
            "write one clock's times [s]"
        )
