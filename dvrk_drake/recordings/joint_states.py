"""Makes recordings from messages sensor_msgs/JointState of ROS bags and of tables.

A dVRK publishes positions in rad (m for a prismatic joint), velocities in rad/s (m/s) and efforts in N m (N), all in
joint coordinates (https://dvrk.readthedocs.io, CRTK names). A header stamp of 0 marks invalid data.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.locked_joints import check_held, lock_hint
from dvrk_drake.recordings.reader_options import MEASURED_JS, FileOptions
from dvrk_drake.recordings.recording import Recording

#: Longest distance in time between a message of the arm and the messages of its jaw [s].
MAX_JAW_GAP = 0.05
#: Longest time by which a message may be earlier than an earlier one [s]. Such messages are sorted. If the difference
#: is larger, the clock was set.
MAX_LATE = 0.1
#: Ratio of the number of messages to the expected number, in a time span that is received twice, above which the clock
#: was set back. Messages in another order have a ratio of 1, a clock that was set back has a ratio of 2.
_MAX_DENSITY = 1.5
#: Number of messages by which the number in a short time span may exceed the expected number: one at each end, and one
#: for jitter.
_MAX_EXCESS = 3
#: Beginning of the names of the joints of a PSM of dVRK before 2024, e.g. "outer_yaw" for "yaw".
_OLD_PREFIX = "outer_"
#: Fields of a message with one number per joint.
MESSAGE_BLOCKS = ("position", "velocity", "effort")


class JointState(NamedTuple):
    """Message: number in its file, header stamp [ns], joint names, and numbers of each joint, which may be missing."""

    number: int
    stamp: int
    name: Sequence[str]
    position: ArrayLike
    velocity: ArrayLike
    effort: ArrayLike


class JointStates(NamedTuple):
    """Messages of one topic: joint names, stamps [ns], joint states (m, k), and numbers of the messages.

    `label` is the name of these numbers: "message", "line" or "row".
    """

    topic: str
    names: tuple[str, ...]
    stamps: NDArray[np.int64]
    q: NDArray[np.float64]
    qd: NDArray[np.float64] | None
    tau: NDArray[np.float64] | None
    numbers: NDArray[np.int_]
    notes: tuple[str, ...]
    label: str = "message"


def collect_joint_states(
    path: Path,
    topic: str,
    messages: Iterable[JointState],
    *,
    skip_invalid: bool,
    label: str = "message",
) -> JointStates:
    """Returns the messages of a topic in the order of their header stamps.

    Args:
        path: Path of the file, for messages of errors.
        topic: Name of the topic, for messages of errors and notes.
        messages: Messages in the order of the file.
        skip_invalid: Whether to omit and note messages with a number that is not finite.
        label: Name of the numbers of messages: "message", "line" or "row".

    Raises:
        RecordingError: No message is usable, a message has other joints than the first one, numbers are missing or are
            not finite, or the clock was set.
    """
    names: tuple[str, ...] = ()
    stamps, numbers, values, present, unstamped = array("q"), array("q"), array("d"), array("b"), 0
    for message in messages:
        where = f"{path}: {label} {message.number} of {topic}"
        if message.stamp == 0:
            unstamped += 1
            continue
        names = names or _checked_names(where, message.name)
        if tuple(message.name) != names:
            raise RecordingError(
                f"{where} has the joints {', '.join(message.name)}, but the first one has {', '.join(names)}. Choose a "
                "topic with one publisher."
            )
        stamps.append(message.stamp)
        numbers.append(message.number)
        for block in MESSAGE_BLOCKS:
            row = np.asarray(getattr(message, block), float)
            if not len(row) and block == "position":
                raise RecordingError(f"{where} has no positions")
            if len(row) not in (0, len(names)):
                raise RecordingError(f"{where} has {len(row)} numbers in `{block}`, but {len(names)} joints")
            present.append(len(row) > 0)
            values.frombytes((row if len(row) else np.zeros(len(names))).tobytes())
    shape = len(stamps), len(MESSAGE_BLOCKS)
    table, has = np.frombuffer(values).reshape(*shape, len(names)), np.frombuffer(present, bool).reshape(shape)
    is_valid = np.all(np.isfinite(table), axis=(1, 2))
    if not (skip_invalid or np.all(is_valid)):
        row, block, joint = np.argwhere(~np.isfinite(table))[0]
        raise RecordingError(
            f"{path}: {label} {numbers[row]} of {topic}: the {MESSAGE_BLOCKS[block]} of {names[joint]} is "
            f"{table[row, block, joint]}; only finite numbers are allowed (--skip-invalid omits such messages)"
        )
    reasons = {"header stamp 0, which marks invalid data": unstamped, "not finite": int(np.sum(~is_valid))}
    notes = [f"{count} messages of {topic} omitted: {reason}" for reason, count in reasons.items() if count]
    if not np.any(is_valid):
        raise RecordingError(f"{path}: {topic} has no usable message ({'; '.join(notes) or 'it has no messages'})")
    table, has = table[is_valid], has[is_valid]
    stamp, number = np.frombuffer(stamps, np.int64)[is_valid], np.frombuffer(numbers, np.int64)[is_valid]
    is_partial = np.any(has, axis=0) & ~np.all(has, axis=0)
    if is_partial[1]:
        notes.append(f"velocities of {topic} not used: {np.sum(~has[:, 1])} of {len(has)} messages have none")
    if is_partial[2]:
        without, with_effort = number[np.argmin(has[:, 2])], number[np.argmax(has[:, 2])]
        raise RecordingError(
            f"{path}: {label} {without} of {topic} has no effort, but {label} {with_effort} has. Cut the recording."
        )
    order, time_notes = order_in_time(path, f"messages of {topic}", stamp, number, label)
    q, qd, tau = (table[order, i] if np.all(has[:, i]) else None for i in range(len(MESSAGE_BLOCKS)))
    assert q is not None
    return JointStates(topic, names, stamp[order], q, qd, tau, number[order], (*notes, *time_notes), label)


def joint_recording(
    path: Path, arm_states: JointStates, options: FileOptions, sha256: str, jaw: JointStates | None = None
) -> Recording:
    """Returns the recording of the joints of an arm, in any order of the joints.

    Args:
        path: Path of the file.
        arm_states: Messages of the arm.
        options: Arm (required) and names of its joints in the file.
        sha256: SHA-256 of the file.
        jaw: Messages of its jaw, which is interpolated linearly at the times of the arm, or None.

    Raises:
        RecordingError: Joints of the arm are missing, or a locked joint was moved.
    """
    arm, states, notes = options.required_arm(path), arm_states, list(arm_states.notes)
    if jaw is not None:
        states, jaw_notes = _with_jaw(path, arm_states, jaw, arm.separate_joint)
        notes += [*jaw.notes, *jaw_notes]
    names, name_notes = arm_joint_names(f"{path}: {states.topic}", states.names, arm, options.joints)
    order = _joint_order(path, states.topic, names, arm)
    check_held(f"{path}: {states.topic}", names, states.q, arm)
    q, qd, tau = (None if part is None else part[:, order] for part in (states.q, states.qd, states.tau))
    assert q is not None
    return Recording(
        *(q, tau, qd, 1e-9 * (states.stamps - states.stamps[0]), "joint", str(path), states.numbers, sha256),
        notes=(*notes, *name_notes),
        line_label=arm_states.label,
        times_from="messages",
        file_coordinates="joint",
        arm_name=arm.name,
    )


def arm_joint_names(
    where: str, names: Sequence[str], arm: Arm, joints: Mapping[str, str] | None
) -> tuple[tuple[str, ...], list[str]]:
    """Returns the names of joints in a file, with the arm's names of known joints, and notes.

    Args:
        where: Source of the names, for the message.
        names: Names in the file.
        arm: Arm with these joints.
        joints: Mapping from the arm's name of a joint to its name in the file, see `FileOptions.joints`.

    Raises:
        RecordingError: A name in `joints` is not in the file.
    """
    given = dict(joints or {})
    if unknown := [name for name in given.values() if name not in names]:
        raise RecordingError(f"{where}: has no joint {unknown[0]} of --joints; its joints: {', '.join(names)}")
    old = {
        joint: f"{_OLD_PREFIX}{joint}"
        for joint in arm.joint_names
        if joint not in names and joint not in given and f"{_OLD_PREFIX}{joint}" in names
    }
    if set(arm.joint_names) - set(names) - given.keys() - old.keys() - {arm.separate_joint}:
        old = {}  # joints of another arm
    of_arm = {name: joint for joint, name in (given | old).items()}
    # Another joint in the file may have the name of a joint that is called differently there.
    read = tuple(of_arm.get(name, f"({name})" if name in given else name) for name in names)
    notes = [f"joints {', '.join(old.values())} read as {', '.join(old)} (names of dVRK before 2024)"] if old else []
    return read, notes


def _checked_names(where: str, names: Sequence[str]) -> tuple[str, ...]:
    if not names:
        raise RecordingError(f"{where} names no joints")
    if len(set(names)) < len(names):
        raise RecordingError(f"{where} names a joint twice: {', '.join(names)}")
    return tuple(names)


def order_in_time(
    path: Path,
    what: str,
    stamps: NDArray[np.int64],
    numbers: NDArray[np.int_],
    label: str,
    stamp: str = "header stamp",
) -> tuple[NDArray[np.intp], list[str]]:
    """Returns the order (k,) of measurements in time, without repeated times, and notes.

    Args:
        path: Path of the file, for messages of errors.
        what: Name of the measurements, e.g. "messages of /PSM1/measured_js".
        stamps: Times (m,) in the order of the file [ns].
        numbers: Numbers (m,) of the measurements in the file.
        label: Name of such a number, e.g. "message".
        stamp: Name of a time.

    Raises:
        RecordingError: The clock was set back, or most times are repeated.
    """
    latest = np.concatenate([stamps[:1], np.maximum.accumulate(stamps)[:-1]])
    is_late = stamps < latest
    sorted_stamps = np.sort(stamps)
    first_of_run = np.flatnonzero(is_late & ~np.concatenate([[False], is_late[:-1]]))
    set_back = latest - stamps > MAX_LATE * 1e9
    if len(first_of_run):
        # Each run of late messages repeats a time span.
        begin = np.minimum.reduceat(np.where(is_late, stamps, latest), first_of_run)
        end = latest[first_of_run]
        count = np.searchsorted(sorted_stamps, end, "right") - np.searchsorted(sorted_stamps, begin, "left")
        period = max(float(np.median(np.diff(np.unique(stamps)))), 1.0)
        set_back[first_of_run] |= count > _MAX_DENSITY * (end - begin) / period + _MAX_EXCESS
    if np.any(set_back):
        row = int(np.argmax(set_back))
        before = int(np.argmax(stamps[:row]))
        raise RecordingError(
            f"{path}: the {stamp} of {label} {numbers[row]} is {1e-9 * (latest[row] - stamps[row]):g} s before that of "
            f"{label} {numbers[before]}. Cut the recording where the clock was set, or record again."
        )
    order = np.argsort(stamps, kind="stable")
    order = order[np.concatenate([[True], np.diff(stamps[order]) > 0])]
    repeated, late = len(stamps) - len(order), int(np.sum(is_late[order]))
    if repeated > len(order):
        raise RecordingError(
            f"{path}: the {stamp}s do not increase in {repeated} of {len(stamps)} {what}. Record while the console "
            "publishes measured data."
        )
    notes = [f"{repeated} {what} omitted: same {stamp} as another one"] if repeated else []
    if late:
        notes.append(f"{late} {what} were not in order, and are sorted by their {stamp}s")
    return order, notes


def _with_jaw(path: Path, arm: JointStates, jaw: JointStates, joint: str) -> tuple[JointStates, list[str]]:
    """Returns the joints of the arm and the jaw at the times of the arm, and notes on omitted rows."""
    if len(jaw.names) != 1:
        raise RecordingError(f"{path}: the topic of the jaw has {len(jaw.names)} joints; expected 1")
    after = np.clip(np.searchsorted(jaw.stamps, arm.stamps), 0, len(jaw.stamps) - 1)
    before = np.where(jaw.stamps[after] == arm.stamps, after, np.maximum(after - 1, 0))
    gap = np.maximum(np.abs(jaw.stamps[after] - arm.stamps), np.abs(arm.stamps - jaw.stamps[before]))
    kept = gap <= MAX_JAW_GAP * 1e9
    if not np.any(kept):
        raise RecordingError(f"{path}: the messages of the arm and of its jaw have no common time")

    def joined(block: NDArray[np.float64] | None, column: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        if block is None or column is None:
            return None
        # As floating-point numbers, stamps since 1970 would be rounded to 0.2 us.
        values = np.interp(arm.stamps[kept] - jaw.stamps[0], jaw.stamps - jaw.stamps[0], column[:, 0])
        return np.column_stack([block[kept], values])

    if arm.tau is not None and jaw.tau is None:
        raise RecordingError(f"{path}: the topic of the jaw has no efforts, but the topic of the arm has")
    notes = []
    if arm.qd is not None and jaw.qd is None:
        notes.append(f"velocities of {arm.topic} not used: the topic of the jaw has none")
    if omitted := int(np.sum(~kept)):
        notes.append(f"{omitted} messages of the arm omitted: no message of the jaw within {1e3 * MAX_JAW_GAP:g} ms")
    q, qd, tau = (joined(*pair) for pair in ((arm.q, jaw.q), (arm.qd, jaw.qd), (arm.tau, jaw.tau)))
    assert q is not None
    names, stamps, numbers = (*arm.names, joint), arm.stamps[kept], arm.numbers[kept]
    return arm._replace(names=names, stamps=stamps, q=q, qd=qd, tau=tau, numbers=numbers), notes


def _joint_order(path: Path, topic: str, names: tuple[str, ...], arm: Arm) -> list[int]:
    """Returns the column of each joint of the arm. Joints that are not in the arm are ignored."""
    if missing := [joint for joint in arm.joint_names if joint not in names]:
        count = arm.num_joints - len(missing)
        hint = lock_hint(arm, count) if missing == list(arm.joint_names[count:]) else ""
        advice = "Check --arm and --topic, or name the joints with --joints NAME=NAME_IN_FILE (joints= in Python)."
        if hint:
            advice += f" {hint}"
        if missing == [arm.separate_joint]:
            separate = f"{topic.removesuffix(MEASURED_JS)}{arm.separate_joint}/{MEASURED_JS}"
            advice = f"Record {separate} as well. {hint}".rstrip()
        raise RecordingError(
            f"{path}: {topic} has the joints {', '.join(names)}; {arm.name} also needs {', '.join(missing)}. {advice}"
        )
    return [names.index(joint) for joint in arm.joint_names]
