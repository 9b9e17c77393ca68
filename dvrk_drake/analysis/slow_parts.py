"""The slow parts of a motion as poses: where a joint hardly moves or accelerates, its torque is a holding torque."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.recording import Recording

#: Slow: below this share of the joint's top speed, and of its top acceleration.
SLOW_SPEED, SLOW_ACCELERATION = 0.1, 0.2
#: Cut-off of the zero-phase low-pass before speeds are differentiated [Hz], and its order.
CUT_OFF, ORDER = 10.0, 4
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
    friction stays in it, of either sign. Both are errors here: a motion wants dynamic identification.

    Raises:
        RecordingError: no efforts, or another arm's.
        IdentificationError: no times or speeds, or nothing in it is slow.
    """
    moving = recording.in_joint_coordinates(arm)
    tau, qd, t = moving.measured_effort(), moving.qd, moving.t
    where = recording.source or "recording"
    if qd is None or t is None or len(t) < 100 or not np.all(np.diff(t) > 0):
        raise IdentificationError(
            f"{where}: slow parts need a motion: t that increases and qd1..qd{arm.num_joints} over 100 rows or more"
        )
    period = float(np.median(np.diff(t)))
    if not period < 0.5 / CUT_OFF:
        raise IdentificationError(f"{where}: samples {period:.3g} s apart are too far for slow parts; below 0.02 s")
    v = sosfiltfilt(butter(ORDER, CUT_OFF, fs=1 / period, output="sos"), qd, axis=0)
    vd = np.gradient(v, t, axis=0)
    # The 99 % quantile, not the maximum: one spike must not make everything else slow.
    is_slow = np.abs(v) < SLOW_SPEED * np.quantile(np.abs(v), 0.99, axis=0)
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


def _parts_of(is_slow: NDArray[np.bool_], joint: int, moving: Recording, arm: Arm) -> list[NDArray[np.int_]]:
    """Rows of each slow part of one joint, repetitions joined; the other joints stay within `SAME_PART` in each."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_slow, [False]]).astype(int)))
    same = arm.per_joint(*SAME_PART)
    runs = []
    for first, end in edges.reshape(-1, 2):
        start = first
        while end - start >= LEAST_SAMPLES:
            away = np.any(np.abs(moving.q[start:end] - moving.q[start]) > same, axis=1)
            stop = start + int(np.argmax(away)) if np.any(away) else end
            if stop - start >= LEAST_SAMPLES:
                runs.append(np.arange(start, stop))
            start = stop
    parts: list[NDArray[np.int_]] = []
    for run in runs:
        q = moving.q[run].mean(axis=0)
        for i, part in enumerate(parts):
            if np.all(np.abs(moving.q[part].mean(axis=0) - q) < same):
                parts[i] = np.concatenate([part, run])
                break
        else:
            parts.append(run)
    return parts
