"""The slow parts of a motion as poses: where a joint hardly moves or accelerates, its torque is a holding torque."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.signals.rests import LEAST_ROWS, LONGEST_PERIOD, is_motion, smooth_velocity, stationary_runs
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording

#: Slow: below this share of the joint's top speed, and of its top acceleration.
SLOW_SPEED, SLOW_ACCELERATION = 0.1, 0.2
#: Rows closer than this are averaged [s].
LEAST_PERIOD = 0.005
#: Fewest consecutive samples that make a slow part.
LEAST_SAMPLES = 3
#: A slow part ends where any joint is further than this from where it began [rad], [m]; those of one joint whose poses
#: agree this well are repetitions of one.
SAME_PART = 0.05, 0.005


class SlowParts(NamedTuple):
    """Slow parts of a motion, one row each.

    Attributes:
        recording: their mean poses and torques, in joint coordinates, without time.
        measured: (m, n) True at the one joint that was slow: only its torque is a holding torque.
    """

    recording: Recording
    measured: NDArray[np.bool_]


def slow_parts(recording: Recording, arm: Arm) -> SlowParts:
    """Finds them, joint by joint, and averages each with its repetitions.

    While other joints still move, their velocities and accelerations leave a little inertial torque in it; and dry
    friction stays in it, of either sign. Both are errors here: a motion wants dynamic identification, or rests of the
    whole arm (`rest_poses`).

    Raises:
        RecordingError: no efforts, or another arm's.
        IdentificationError: no times or speeds, or nothing in it is slow.
    """
    moving = recording.in_joint_coordinates(arm)
    moving.measured_effort()
    where = recording.source or "recording"
    if moving.qd is None or not is_motion(moving):
        raise IdentificationError(
            f"{where}: slow parts need a motion: qd1..qd{arm.num_joints}, and t that increases by less than "
            f"{LONGEST_PERIOD} s, over {LEAST_ROWS} rows or more"
        )
    moving = _thinned(moving)
    tau, t = moving.measured_effort(), np.asarray(moving.t)
    v = smooth_velocity(moving)
    vd = np.gradient(v, t, axis=0)
    # The 99 % quantile, not the maximum: one spike must not make everything else slow.
    is_slow = np.abs(v) < SLOW_SPEED * np.quantile(np.abs(v), 0.99, axis=0)
    is_slow &= np.diff(t, append=t[-1])[:, None] < LONGEST_PERIOD
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
    return SlowParts(means, measured)


def _thinned(recording: Recording) -> Recording:
    """Means over blocks of rows, such that about 200 a second are left: more say nothing new below the cut-off."""
    t, qd, tau = recording.t, recording.qd, recording.measured_effort()
    if t is None or qd is None:
        return recording
    size = int(LEAST_PERIOD / float(np.median(np.diff(t))) + 1e-6)
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
    for run in _longest_of_each_pass(stationary_runs(is_slow, moving.q, same, LEAST_SAMPLES)):
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
