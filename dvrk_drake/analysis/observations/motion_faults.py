"""Finds faults that make all results of a motion meaningless: exchanged quantities, two sources, jumps, wrong times."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.true_time import MAX_ROWS, velocity_agreement
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.csv_files import listed
from dvrk_drake.recordings.recording import (
    GAP,
    MAX_PERIOD,
    MIN_RANGE,
    MIN_RATE,
    MIN_ROWS,
    REST_SPEED,
    SAME_POSE,
    Recording,
)

#: Smallest share of rows in which a signal jumps and returns, for the signals of two sources. If the rows of two
#: sources follow in random order, the share is 25 %. Noise rarely returns in more than half of the channels at once.
MIN_RETURNS = 0.15
#: A channel returns if the distance of the rows before and after is at most the first share of both jumps. Jumps are
#: larger than the second share of the range of the channel, so that quantisation does not count. Half or twice these
#: values changes no finding on the public recordings.
SAME_SOURCE, MIN_JUMP = 0.2, 0.02
#: Largest difference of a jump of a wrapped angle from a multiple of 2 pi [rad], and smallest speed of the jump
#: [rad/s], which no arm reaches. Smallest ratio of the jump to the median step, because angles in degrees have large
#: steps. Half or twice the first or the last value changes no finding on the public recordings.
WRAP_TOLERANCE, WRAP_SPEED, ISOLATED = 0.5, 50.0, 10.0
#: Smallest ratio of a jump to the largest other step within NEARBY [s]. Lost rows that are no gap give a ratio of `GAP`
#: at most, and public motions of eight arms give up to 3.0. Half or twice NEARBY changes no finding on them.
JUMP_RATIO, NEARBY = 2 * GAP, 0.25
#: Units of times in which recorders write, with their size [s].
TIME_UNITS = {
    "milliseconds": 1e-3,
    "microseconds": 1e-6,
    "nanoseconds": 1e-9,
    "minutes": 60.0,
    "hours": 3600.0,
    "days": 86400.0,
}
#: Largest plausible RMS speed of a joint over a whole motion [rad/s], [m/s], and largest plausible rate [Hz].
#: Industrial arms reach 10 rad/s only for moments, and arms publish at up to 3 kHz.
MAX_SPEED, MAX_RATE = (10.0, 1.0), 10_000.0
#: Largest deviation of the gain from 1 and largest mismatch at which columns are the time derivative of other columns.
#: Efforts in place of velocities have gains of 6 to 100 (UR10e). Velocities of this robot with jittered times have
#: deviations below 0.05 and mismatches below 0.2.
MAX_GAIN_ERROR, MAX_MISMATCH = 0.2, 0.5


def source_fault(recording: Recording, arm: Arm) -> Finding | None:
    """Returns a fault of a motion with exchanged quantities, rows of two sources or wrapped angles, or None.

    Raises:
        RecordingError: The number of joints is wrong.
    """
    joints = recording.in_joint_coordinates(arm)
    return _exchanged_quantities(recording) or _two_sources(recording, arm) or _wrapped_angle(recording, joints, arm)


def _exchanged_quantities(recording: Recording) -> Finding | None:
    """Returns a fault if the columns of two quantities are exchanged: velocities are the derivatives of positions."""
    if not (recording.is_motion and recording.has_increasing_times):
        return None
    t, blocks = np.asarray(recording.t)[:MAX_ROWS], {"q": recording.q, "qd": recording.qd, "tau": recording.tau}
    given = {name: block[:MAX_ROWS] for name, block in blocks.items() if block is not None}

    def share(position: str, velocity: str) -> float:
        """Returns the share of the moving joints whose velocities are the derivatives of their positions."""
        found = velocity_agreement(given[position], given[velocity], (len(t) - 1) / (t[-1] - t[0]))
        fits = (np.abs(found.gain - 1) < MAX_GAIN_ERROR) & (found.mismatch < MAX_MISMATCH)
        return float(np.mean(fits[np.isfinite(found.gain)])) if np.any(np.isfinite(found.gain)) else 0.0

    if len(given) < len(blocks) or share("q", "qd") > 0:
        return None
    for position, velocity, effort in permutations(blocks):
        if share(position, velocity) > 0.5:
            what = (
                f"the columns {velocity} are the time derivatives of the columns {position}, but the columns qd are "
                f"not those of q. Positions are in {position}, velocities in {velocity}, efforts in {effort}"
            )
            advice = "Correct the names of the columns and check the file again."
            return Finding("refusal", "exchanged quantities", "columns", what, advice)
    return None


def _two_sources(recording: Recording, arm: Arm) -> Finding | None:
    """Returns a fault if rows of two sources alternate, so that most channels of a signal jump and return."""
    if not recording.is_motion:
        return None
    moves = np.ptp(recording.q, axis=0) > arm.per_joint(*MIN_RANGE)
    for name, block in (("q", recording.q), ("qd", recording.qd), ("tau", recording.tau)):
        if block is None or not np.any(moves):
            continue
        returns = _returns(block[:, moves])
        if (share := float(np.mean(returns))) > MIN_RETURNS:
            row = int(np.argmax(returns)) + 1
            what = (
                f"in {100 * share:.0f} % of the rows, {name} jumps and returns in the next row, first at "
                f"{recording.where(row)}, as if the rows came from two sources"
            )
            advice = (
                "Usual cause: two publishers on one topic. List them with ros2 topic info -v TOPIC, stop one of them, "
                "and record again."
            )
            return Finding("refusal", "two sources", name, what, advice)
    return None


def _returns(x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns a mask (m - 2,) of the rows at which more than half of the channels x (m, k) jump and return."""
    steps = np.diff(x, axis=0)
    jump = np.minimum(np.abs(steps[1:]), np.abs(steps[:-1]))
    returned = np.abs(x[2:] - x[:-2]) <= SAME_SOURCE * jump
    changes = np.ptp(x, axis=0) > 0
    returns = returned & (jump > MIN_JUMP * np.ptp(x, axis=0))
    return np.asarray(2 * np.sum(returns, axis=1) > max(int(np.sum(changes)), 1))


def _wrapped_angle(recording: Recording, joints: Recording, arm: Arm) -> Finding | None:
    """Returns a fault if an angle jumps by a multiple of 2 pi between two rows of a motion."""
    if not (recording.is_motion and recording.has_increasing_times):
        return None
    intervals = np.diff(np.asarray(recording.t))
    for one in (recording, joints, recording.in_actuator_coordinates(arm)):
        steps = np.abs(np.diff(one.q, axis=0))
        turns = np.round(steps / (2 * np.pi))
        wraps = (turns > 0) & (np.abs(steps - 2 * np.pi * turns) < WRAP_TOLERANCE) & ~arm.prismatic
        wraps &= (steps > WRAP_SPEED * intervals[:, None]) & (steps > ISOLATED * np.median(steps, axis=0))
        if np.any(wraps):
            joint = int(np.argmax(np.sum(wraps, axis=0)))
            rows = np.flatnonzero(wraps[:, joint]) + 1
            where = f"q{joint + 1}" + (f" in {one.coordinates} coordinates" if one is not recording else "")
            count = f"{len(rows)} row{'s' * (len(rows) != 1)}"
            what = f"{where} jumps by a multiple of 2 pi in {count}, first at {recording.where(int(rows[0]))}"
            advice = "The angle is wrapped. Make it continuous (numpy.unwrap) and within the limits of the joint."
            return Finding("refusal", "wrapped angle", arm.joint_names[joint], what, advice)
    return None


def jump_fault(recording: Recording, arm: Arm) -> Finding | None:
    """Returns a fault if positions jump between two rows of a motion, or None.

    A jump exceeds `SAME_POSE`, `MIN_JUMP` of the range of the joint, and `JUMP_RATIO` times the largest other step
    nearby. A wrong row causes two jumps, so the next and the previous step do not count. A gap of the times is no jump.
    """
    if not (recording.is_motion and recording.has_increasing_times):
        return None
    spans = np.ptp(recording.q, axis=0)
    moves = np.flatnonzero(spans > arm.per_joint(*MIN_RANGE))
    smallest = np.maximum(MIN_JUMP * spans, arm.per_joint(*SAME_POSE))[moves]
    # A window of 2 `half` + 1 steps on each side, from the second step before and after.
    half = max(round(NEARBY / float(np.median(np.diff(np.asarray(recording.t)))) / 2), 1)
    jumps = np.zeros(recording.q.shape)
    for rows in recording.segments():
        steps = np.abs(np.diff(recording.q[rows][:, moves], axis=0))
        count = len(steps)
        if count <= 2 * half + 2 or not np.any(steps > smallest):
            continue
        padded = np.pad(steps, ((2 * half + 2,) * 2, (0, 0)))
        largest = maximum_filter1d(padded, 2 * half + 1, axis=0)
        nearby = np.maximum(largest[half : half + count], largest[3 * half + 4 : 3 * half + 4 + count])
        is_jump = (steps > smallest) & (steps > JUMP_RATIO * nearby)
        jumps[rows.start + 1 : rows.stop, moves] = np.where(is_jump, steps, 0.0)
    found = np.flatnonzero(np.any(jumps, axis=1))
    if not len(found):
        return None
    row = int(found[0])
    joint = int(np.argmax(jumps[row] / arm.per_joint(*SAME_POSE)))
    unit = "m" if arm.prismatic[joint] else "rad"
    what = f"q{joint + 1} jumps by {jumps[row, joint]:.2g} {unit} at {recording.where(row)}"
    if len(found) > 1:
        label, lines = ("row", found + 1) if recording.lines is None else (recording.line_label, recording.lines[found])
        what += f"; positions jump at {len(found)} {label}s: {listed(lines)}"
    advice = (
        "Usual causes: recordings joined into one file, wrong rows, or lost encoder counts. Remove wrong rows. Write "
        "joined recordings to one file each; identify accepts several files."
    )
    return Finding("refusal", "jump", "q", what, advice)


def time_fault(recording: Recording, arm: Arm) -> Finding | None:
    """Returns a fault of the times of rows that are a motion.

    The times are implausible if the joints would move faster than `MAX_SPEED`, or if rows in small steps are too slow
    for a motion, but another unit of t gives a plausible rate and speed. Otherwise, a motion can be sampled too slowly.
    """
    if recording.t is None or not recording.has_increasing_times or len(recording) < 2:
        return None
    joints = recording.in_joint_coordinates(arm)
    interval = float(np.median(np.diff(recording.t)))
    steps = np.abs(np.diff(joints.q, axis=0))
    # Without the largest steps, which can be faults of the positions.
    typical = np.sqrt(np.mean(np.minimum(steps, np.quantile(steps, 0.99, axis=0)) ** 2, axis=0))
    rate, speeds = 1 / interval, typical / interval
    is_motion = rate >= 1 / MAX_PERIOD
    too_fast = bool(np.any(speeds > arm.per_joint(*MAX_SPEED)))

    def fits(unit: float) -> bool:
        moves = np.any(speeds / unit > arm.per_joint(*REST_SPEED))
        fast = np.any(speeds / unit > arm.per_joint(*MAX_SPEED))
        return bool(1 / MAX_PERIOD <= rate / unit <= MAX_RATE and moves and not fast)

    moves, slow = recording.motion(arm), not np.any(speeds > arm.per_joint(*REST_SPEED))
    if (too_fast and is_motion) or (not is_motion and slow and joints.is_path(arm)):
        unit = next((name for name, size in TIME_UNITS.items() if fits(size)), "")
        if too_fast or unit:
            joint = int(np.argmax(speeds / arm.per_joint(*MAX_SPEED)))
            what = f"t increases by {interval:.3g} per row, but the rows are samples of a motion in small steps"
            if too_fast:
                unit_of_speed = "m/s" if arm.prismatic[joint] else "rad/s"
                what = f"t implies an RMS speed of {speeds[joint]:.3g} {unit_of_speed} of joint {joint + 1}"
            what += f" (t may be in {unit}: {rate / TIME_UNITS[unit]:.4g} Hz)" if unit else ""
            advice = f"Use t in s. {recording.rest_advice}"
            return Finding("refusal", "wrong time", "t", what, advice if unit else "Use t in s, and q in rad (m).")
    if not moves or recording.is_motion:
        return None
    if is_motion:
        what = f"the recording has {len(recording)} rows of a motion ({moves}); required: {MIN_ROWS} rows"
        advice = "Static identification requires poses at rest. A dynamic model requires a longer motion."
        return Finding("refusal", "too few rows", "rows", what, advice)
    what = f"the rows are a motion ({moves}), but the rate of {rate:.3g} Hz is too slow"
    advice = f"Record a motion at {MIN_RATE:g} Hz or more, or poses at rest. {recording.rest_advice}"
    return Finding("refusal", "too slow", "t", what, advice)
