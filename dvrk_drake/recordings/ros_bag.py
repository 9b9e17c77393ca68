"""Reads the joint states of an arm from a ROS bag: ROS 1 `.bag`, ROS 2 `sqlite3`, or MCAP.

A dVRK publishes `sensor_msgs/JointState` on `<namespace>/<ARM>/measured_js`, and the jaw of a PSM on
`<namespace>/<ARM>/jaw/measured_js` (https://dvrk.readthedocs.io, CRTK names). Positions are in rad (m for a prismatic
joint), velocities in rad/s (m/s) and efforts in N m (N), all in joint coordinates. A header stamp of 0 marks invalid
data.
"""

from __future__ import annotations

import hashlib
import math
import struct
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import open_input
from dvrk_drake.models.locked_joints import check_held, lock_hint
from dvrk_drake.recordings.file_options import FileOptions
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.topic_choice import choose_topic

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

JOINT_STATE = "sensor_msgs/msg/JointState"
#: Beginning of a file of each kind, and the suffix that the rosbags library requires.
_MAGIC = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
_METADATA = "metadata.yaml"

#: Longest distance in time between a message of the arm and the messages of its jaw [s].
MAX_JAW_GAP = 0.05
#: Longest time by which a message may be earlier than the previous one [s]. Such messages are omitted. An earlier
#: message means that the clock was set.
MAX_LATE = 0.1
#: Messages between two reports of progress.
_REPORT = 4096


def is_ros_bag(path: Path) -> bool:
    """Returns whether a path is a ROS bag: a file that begins like one, or a folder with `metadata.yaml`."""
    if path.is_dir():
        return (path / _METADATA).is_file()
    with path.open("rb") as file:
        return file.read(16).startswith(tuple(_MAGIC))


def read_ros_bag(path: Path, options: FileOptions) -> Recording:
    """Reads the measured joint states of an arm from a bag, in joint coordinates.

    Messages with a header stamp of 0, and messages that are not later than the previous one, are omitted and noted.
    The joints may be in any order. If the messages do not contain `Arm.separate_joint`, the jaw, it is read from the
    topic of the jaw and interpolated linearly at the times of the arm.

    Args:
        path: Path of a `.bag`, `.db3` or `.mcap` file, or of the folder of a ROS 2 bag.
        options: Arm (required), topic and `skip_invalid`. The topic is a JointState topic, e.g. "/PSM1/measured_js", or
            its namespace, "/PSM1". Default: the only topic `/<ARM>/measured_js`, in any namespace, where ARM is the
            name of the arm, optionally followed by a number.

    Raises:
        RecordingError: The bag is damaged or empty, no topic or several topics match, the topic is in the namespace of
            another arm, or the messages do not fit the arm.
    """
    arm, skip_invalid, progress = options.required_arm(path), options.skip_invalid, options.progress
    reader = _Bag(path)
    # Numbers near the largest floating-point number overflow in sums.
    with reader, np.errstate(over="ignore"):
        connections = reader.joint_state_topics()
        listed = {name: f"{name} ({connections[name].msgcount})" for name in connections}
        name = choose_topic(path, arm, options.topic, listed)
        jaw = f"{name.rpartition('/')[0]}/{arm.separate_joint}/measured_js"
        has_jaw = jaw in connections
        total = connections[name].msgcount + (connections[jaw].msgcount if has_jaw else 0)
        parts = [_read_topic(reader, connections[name], skip_invalid, lambda done: progress(done / max(total, 1)))]
        first = parts[0]
        missing = [joint for joint in arm.joint_names if joint not in first.names]
        if missing == [arm.separate_joint] and has_jaw:
            before = connections[name].msgcount
            parts.append(
                _read_topic(reader, connections[jaw], skip_invalid, lambda done: progress((before + done) / total))
            )
    progress(1.0)
    notes = [note for part in parts for note in part.notes]
    if len(parts) == 2:
        first, jaw_notes = _with_jaw(path, first, parts[1], arm.separate_joint)
        notes += jaw_notes
    order = _joint_order(path, name, first.names, arm)
    check_held(f"{path}: {name}", first.names, first.q, arm)
    q, qd, tau = (None if part is None else part[:, order] for part in (first.q, first.qd, first.tau))
    assert q is not None
    t = 1e-9 * (first.stamps - first.stamps[0])
    return Recording(q, tau, qd, t, "joint", str(path), first.messages, _sha256(path), tuple(notes), "message")


class _Topic(NamedTuple):
    """Content of one topic: joint names, header stamps [ns], joint states (m, k), and numbers of the messages."""

    names: tuple[str, ...]
    stamps: NDArray[np.int64]
    q: NDArray[np.float64]
    qd: NDArray[np.float64] | None
    tau: NDArray[np.float64] | None
    messages: NDArray[np.int_]
    notes: tuple[str, ...]


class _Bag:
    """Bag that is open for reading. Raises the errors of the rosbags library as RecordingError."""

    def __init__(self, path: Path) -> None:
        # The import takes 0.2 s, and most commands read no bag.
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        if not path.is_dir():
            with path.open("rb") as file:
                start = file.read(16)
            suffix = next(suffix for magic, suffix in _MAGIC.items() if start.startswith(magic))
            if path.suffix != suffix:
                raise RecordingError(f"{path}: this is a ROS bag whose name must end in {suffix}; rename the file")
        try:
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        except Exception as error:
            raise self._error(error) from error

    def __enter__(self) -> _Bag:
        try:
            self._reader.open()
        except Exception as error:
            # For a damaged bag the library raises errors of many types: struct.error, KeyError, apsw.Error, ...
            raise self._error(error) from error
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._reader.close()

    def joint_state_topics(self) -> dict[str, _Connections]:
        """Returns the connections of each topic with JointState messages, by topic."""
        found: dict[str, list[Connection]] = {}
        for connection in self._reader.connections:
            if connection.msgtype == JOINT_STATE:
                found.setdefault(connection.topic, []).append(connection)
        return {topic: _Connections(topic, tuple(found[topic])) for topic in sorted(found)}

    def messages(self, connections: _Connections) -> Iterator[Any]:
        """Iterates over the messages of a topic in the order of the bag."""
        deserialize, kind = self._reader.deserialize, JOINT_STATE
        try:
            for _, _, data in self._reader.messages(connections.connections):
                yield deserialize(data, kind)
        except RecordingError:
            raise
        except Exception as error:
            raise self._error(error) from error

    def _error(self, error: Exception) -> RecordingError:
        # Errors of these types have texts about the program instead of the bag.
        is_internal = isinstance(error, (TypeError, KeyError, IndexError, AssertionError, AttributeError, struct.error))
        text = "damaged" if is_internal else " ".join(str(error).split()) or "damaged"
        repair = {".bag": "rosbag reindex", ".mcap": "mcap recover"}.get(self.path.suffix, "ros2 bag reindex")
        return RecordingError(
            f"{self.path}: the bag cannot be read ({text}). It may be incomplete; `{repair}` can repair it."
        )


class _Connections(NamedTuple):
    """Connections of one topic. Each publisher, and each run of a publisher, has its own connection."""

    topic: str
    connections: tuple[Connection, ...]

    @property
    def msgcount(self) -> int:
        return sum(connection.msgcount for connection in self.connections)


def _read_topic(bag: _Bag, connections: _Connections, skip_invalid: bool, progress: Callable[[int], object]) -> _Topic:
    names: tuple[str, ...] = ()
    stamps, messages = array("q"), array("q")
    blocks = {name: array("d") for name in ("position", "velocity", "effort")}
    present: list[tuple[str, array]] = []
    unstamped, late, invalid, last = 0, 0, 0, 0
    topic = connections.topic
    for number, message in enumerate(bag.messages(connections), 1):
        if number % _REPORT == 0:
            progress(number)
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if stamp == 0:
            unstamped += 1
            continue
        if not present:
            names = tuple(message.name)
            _check_names(bag.path, topic, number, names)
            present = [(name, block) for name, block in blocks.items() if len(getattr(message, name))]
            if "position" not in dict(present):
                raise RecordingError(f"{bag.path}: message {number} of {topic} has no positions")
        elif tuple(message.name) != names:
            raise RecordingError(
                f"{bag.path}: message {number} of {topic} has the joints {', '.join(message.name)}, but the first one "
                f"has {', '.join(names)}. Choose a topic with one publisher."
            )
        rows = [getattr(message, name) for name, _ in present]
        for (name, _), row in zip(present, rows, strict=True):
            if len(row) != len(names):
                raise RecordingError(
                    f"{bag.path}: message {number} of {topic} has {len(row)} numbers in `{name}`, but {len(names)} "
                    "joints"
                )
        if not math.isfinite(sum(float(row.sum()) for row in rows)):
            if not skip_invalid:
                raise RecordingError(_not_finite(bag.path, topic, number, names, present, rows))
            invalid += 1
            continue
        if stamp <= last:
            if last - stamp > MAX_LATE * 1e9:
                raise RecordingError(
                    f"{bag.path}: the header stamp of message {number} of {topic} is {1e-9 * (last - stamp):g} s "
                    f"before that of message {messages[-1]}. Cut the bag where the clock was set, or record again."
                )
            late += 1
            continue
        last = stamp
        stamps.append(stamp)
        messages.append(number)
        for (_, block), row in zip(present, rows, strict=True):
            block.frombytes(row.astype(float, copy=False).tobytes())
    absent = [name for name in blocks if name not in dict(present)]
    if stamps and (added := [name for name in absent if len(getattr(message, name))]):
        raise RecordingError(
            f"{bag.path}: message {messages[0]} of {topic} has no {added[0]}, but message {number} has. Cut the bag."
        )
    notes = [
        f"{count} messages of {topic} omitted: {reason}"
        for count, reason in (
            (unstamped, "header stamp 0, which marks invalid data"),
            (late, "not later than the previous message"),
            (invalid, "not finite"),
        )
        if count
    ]
    if not stamps:
        reasons = "; ".join(notes) or "it has no messages"
        raise RecordingError(f"{bag.path}: {topic} has no usable message ({reasons})")
    if late > len(stamps):
        raise RecordingError(
            f"{bag.path}: the header stamps of {topic} do not increase in {late} of {late + len(stamps)} messages. "
            "Record while the console publishes measured data."
        )
    q, qd, tau = (np.frombuffer(block).reshape(len(stamps), -1) if block else None for block in blocks.values())
    assert q is not None
    return _Topic(names, np.frombuffer(stamps, np.int64), q, qd, tau, np.frombuffer(messages, np.int64), tuple(notes))


def _check_names(path: Path, topic: str, number: int, names: tuple[str, ...]) -> None:
    if not names:
        raise RecordingError(f"{path}: message {number} of {topic} names no joints")
    if len(set(names)) < len(names):
        raise RecordingError(f"{path}: message {number} of {topic} names a joint twice: {', '.join(names)}")


def _not_finite(
    path: Path, topic: str, number: int, names: tuple[str, ...], present: list[tuple[str, array]], rows: list[Any]
) -> str:
    for (name, _), row in zip(present, rows, strict=True):
        for joint, value in zip(names, row, strict=True):
            if not math.isfinite(value):
                return (
                    f"{path}: message {number} of {topic}: the {name} of {joint} is {value}; only finite numbers are "
                    "allowed (--skip-invalid omits such messages)"
                )
    return f"{path}: message {number} of {topic} has numbers that are too large"


def _with_jaw(path: Path, arm: _Topic, jaw: _Topic, joint: str) -> tuple[_Topic, list[str]]:
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

    for block, of_arm, of_jaw in (("velocities", arm.qd, jaw.qd), ("efforts", arm.tau, jaw.tau)):
        if of_arm is not None and of_jaw is None:
            raise RecordingError(f"{path}: the topic of the jaw has no {block}, but the topic of the arm has")
    q = joined(arm.q, jaw.q)
    assert q is not None
    omitted = int(np.sum(~kept))
    notes = [f"{omitted} messages of the arm omitted: no message of the jaw within {1e3 * MAX_JAW_GAP:g} ms"]
    joined_topic = _Topic(
        (*arm.names, joint),
        arm.stamps[kept],
        q,
        joined(arm.qd, jaw.qd),
        joined(arm.tau, jaw.tau),
        arm.messages[kept],
        (),
    )
    return joined_topic, notes if omitted else []


def _joint_order(path: Path, topic: str, names: tuple[str, ...], arm: Arm) -> list[int]:
    """Returns the column of each joint of the arm. Joints that are not in the arm are ignored."""
    if missing := [joint for joint in arm.joint_names if joint not in names]:
        count = arm.num_joints - len(missing)
        hint = lock_hint(arm, count) if missing == list(arm.joint_names[count:]) else ""
        advice = f"Check --arm and --topic.{hint and f' {hint}'}"
        if missing == [arm.separate_joint]:
            separate = f"{topic.rpartition('/')[0]}/{arm.separate_joint}/measured_js"
            advice = f"Record {separate} as well. {hint}".rstrip()
        raise RecordingError(
            f"{path}: {topic} has the joints {', '.join(names)}; {arm.name} also needs {', '.join(missing)}. {advice}"
        )
    return [names.index(joint) for joint in arm.joint_names]


def _sha256(path: Path) -> str:
    """Returns the SHA-256 of a bag; for a folder, of its files in the order of their names."""
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        with open_input(file, RecordingError) as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
