"""Reads the joint states of an arm from a ROS bag: ROS 1 `.bag`, ROS 2 `sqlite3`, or MCAP.

A dVRK publishes `sensor_msgs/JointState` on `<namespace>/<ARM>/measured_js`, and the jaw of a PSM on
`<namespace>/<ARM>/jaw/measured_js` (https://dvrk.readthedocs.io, CRTK names).
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.files import open_input
from dvrk_drake.recordings.file_options import FileOptions
from dvrk_drake.recordings.joint_states import (
    JointState,
    JointStates,
    arm_joint_names,
    collect_joint_states,
    joint_recording,
)
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.topic_choice import choose_topic

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

JOINT_STATE = "sensor_msgs/msg/JointState"
#: Beginning of a file of each kind, and the suffix that the rosbags library requires.
_MAGIC = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
_METADATA = "metadata.yaml"

#: Messages between two reports of progress.
_REPORT = 4096


def is_ros_bag(path: Path) -> bool:
    """Returns whether a path is a ROS bag: a file that begins like one, or a folder with metadata or such files."""
    if path.is_dir():
        return (path / _METADATA).is_file() or bool(_parts(path))
    with path.open("rb") as file:
        return file.read(16).startswith(tuple(_MAGIC))


def _parts(folder: Path) -> list[Path]:
    """Returns the files of a bag whose `metadata.yaml` is missing, e.g. because the recorder was killed."""
    return sorted(path for path in folder.iterdir() if path.suffix in _MAGIC.values() and path.is_file())


def read_ros_bag(path: Path, options: FileOptions) -> Recording:
    """Reads the measured joint states of an arm from a bag, in joint coordinates.

    Messages with a header stamp of 0, and messages with the stamp of another one, are omitted and noted. Messages that
    are at most `MAX_LATE` late are sorted. The joints may be in any order. If the messages do not contain
    `Arm.separate_joint`, the jaw, it is read from the topic of the jaw and interpolated linearly at the times of the
    arm.

    Args:
        path: Path of a `.bag`, `.db3` or `.mcap` file, or of the folder of a ROS 2 bag. Without `metadata.yaml`, all
            files of the folder are parts of the bag.
        options: Arm (required), topic, names of the joints, and `skip_invalid`. The topic is a JointState topic, e.g.
            "/PSM1/measured_js", or its namespace, "/PSM1". Default: the only topic `/<ARM>/measured_js`, in any
            namespace, where ARM is the name of the arm, optionally followed by a number.

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
        states = _read_topic(reader, connections[name], skip_invalid, lambda done: progress(done / max(total, 1)))
        jaw_states = None
        known, _ = arm_joint_names(f"{path}: {name}", states.names, arm, options.joints)
        if has_jaw and [joint for joint in arm.joint_names if joint not in known] == [arm.separate_joint]:
            before = connections[name].msgcount
            jaw_states = _read_topic(
                reader, connections[jaw], skip_invalid, lambda done: progress((before + done) / total)
            )
    progress(1.0)
    recording = joint_recording(path, states, jaw_states, options, _sha256(path), "message")
    if len(reader.parts) > 1:
        merged = f"no metadata.yaml: {', '.join(part.name for part in reader.parts)} were read as parts of one bag"
        recording = replace(recording, notes=(merged, *recording.notes))
    return recording


class _Bag:
    """Bag that is open for reading. Raises the errors of the rosbags library as RecordingError."""

    def __init__(self, path: Path) -> None:
        # The import takes 0.2 s, and most commands read no bag.
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        self._link_folder: TemporaryDirectory[str] | None = None
        if not path.is_dir():
            with path.open("rb") as file:
                start = file.read(16)
            suffix = next(suffix for magic, suffix in _MAGIC.items() if start.startswith(magic))
            if path.suffix != suffix:
                # The library reads only files with the usual suffix.
                self._link_folder = TemporaryDirectory()
                path = Path(self._link_folder.name) / f"bag{suffix}"
                path.symlink_to(self.path.resolve())
        self.parts = _parts(path) if path.is_dir() and not (path / _METADATA).exists() else [path]
        self._opened = self.parts[0]
        try:
            self._reader = AnyReader(self.parts, default_typestore=get_typestore(Stores.ROS2_JAZZY))
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
        self._remove_link()

    def _remove_link(self) -> None:
        if self._link_folder is not None:
            self._link_folder.cleanup()

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
        text = text.replace(str(self._opened), str(self.path))
        self._remove_link()
        repair = {".bag": "rosbag reindex", ".mcap": "mcap recover"}.get(self._opened.suffix, "ros2 bag reindex")
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


def _read_topic(
    bag: _Bag, connections: _Connections, skip_invalid: bool, progress: Callable[[int], object]
) -> JointStates:
    topic = connections.topic

    def messages() -> Iterator[JointState]:
        for number, message in enumerate(bag.messages(connections), 1):
            if number % _REPORT == 0:
                progress(number)
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            yield JointState(number, stamp, message.name, message.position, message.velocity, message.effort)

    def item(number: int) -> str:
        return f"message {number} of {topic}"

    return collect_joint_states(bag.path, topic, messages(), skip_invalid=skip_invalid, item=item)


def _sha256(path: Path) -> str:
    """Returns the SHA-256 of a bag; for a folder, of its files in the order of their names."""
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        with open_input(file, RecordingError) as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
