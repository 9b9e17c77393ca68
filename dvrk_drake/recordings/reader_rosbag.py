"""Reads the joint states of an arm from a ROS bag: ROS 1 `.bag`, ROS 2 `sqlite3`, or MCAP.

A dVRK publishes `sensor_msgs/JointState` on `<namespace>/<ARM>/measured_js`, and the jaw of a PSM on
`<namespace>/<ARM>/jaw/measured_js` (https://dvrk.readthedocs.io, CRTK names).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.joint_states import (
    JointState,
    JointStates,
    arm_joint_names,
    collect_joint_states,
    joint_recording,
)
from dvrk_drake.recordings.reader_options import FileOptions, choose_topic, instrument_notes, sha256_of
from dvrk_drake.recordings.recording import Recording

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

JOINT_STATE, STRING = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
#: Topic, in the namespace of the arm, on which a dVRK publishes its instrument, e.g. "LARGE_NEEDLE_DRIVER:400006".
TOOL_TYPE = "tool_type"
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
    arm, progress = options.required_arm(path), options.progress
    # Numbers near the largest floating-point number overflow in sums.
    with closing(_Bag(path)) as bag, np.errstate(over="ignore"):
        counts = {name: sum(connection.msgcount for connection in bag.topics[name]) for name in sorted(bag.topics)}
        name = choose_topic(path, arm, options.topic, {name: f"{name} ({count})" for name, count in counts.items()})
        jaw = f"{name.rpartition('/')[0]}/{arm.separate_joint}/measured_js"
        total = max(1, counts[name] + counts.get(jaw, 0))
        states = bag.read(name, options.skip_invalid, lambda done: progress(done / total))
        jaw_states, instrument = None, bag.instrument(name.rpartition("/")[0])
        known, _ = arm_joint_names(f"{path}: {name}", states.names, arm, options.joints)
        if jaw in counts and [joint for joint in arm.joint_names if joint not in known] == [arm.separate_joint]:
            jaw_states = bag.read(jaw, options.skip_invalid, lambda done: progress((counts[name] + done) / total))
    progress(1.0)
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    recording = joint_recording(path, states, options, sha256_of(*files), jaw_states)
    if instrument:
        recorded = f"{arm.name}+{instrument}"
        notes = (*recording.notes, *instrument_notes(recorded, arm))
        recording = replace(recording, arm_name=recorded, notes=notes)
    if len(bag.parts) > 1:
        merged = f"no metadata.yaml: {', '.join(part.name for part in bag.parts)} were read as parts of one bag"
        recording = replace(recording, notes=(merged, *recording.notes))
    return recording


class _Bag:
    """Bag that is open for reading. Raises the errors of the rosbags library as RecordingError.

    Attributes:
        parts: Files of the bag, or its folder.
        topics: Mapping from the topics with JointState messages to their connections. Each publisher, and each run of
            a publisher, has its own connection.
    """

    def __init__(self, path: Path) -> None:
        # The import takes 0.2 s, and most commands read no bag.
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        self._path, self._opened = path, ExitStack()
        if not path.is_dir():
            with path.open("rb") as file:
                start = file.read(16)
            suffix = next(suffix for magic, suffix in _MAGIC.items() if start.startswith(magic))
            if path.suffix != suffix:
                # The library reads only files with the usual suffix.
                path = Path(self._opened.enter_context(TemporaryDirectory()), f"bag{suffix}")
                path.symlink_to(self._path.resolve())
        self.parts = _parts(path) if path.is_dir() and not (path / _METADATA).exists() else [path]
        self.topics: dict[str, list[Connection]] = {}
        try:
            reader = AnyReader(self.parts, default_typestore=get_typestore(Stores.ROS2_JAZZY))
            self._reader = self._opened.enter_context(reader)
        except Exception as error:
            # For a damaged bag the library raises errors of many types: struct.error, KeyError, apsw.Error, ...
            raise self._error(error) from error
        for connection in reader.connections:
            if connection.msgtype == JOINT_STATE:
                self.topics.setdefault(connection.topic, []).append(connection)

    def read(self, topic: str, skip_invalid: bool, progress: Callable[[int], object]) -> JointStates:
        """Reads the messages of a topic. `progress` receives the number of messages that were read."""

        def messages() -> Iterator[JointState]:
            try:
                for number, (_, _, data) in enumerate(self._reader.messages(self.topics[topic]), 1):
                    if number % _REPORT == 0:
                        progress(number)
                    message: Any = self._reader.deserialize(data, JOINT_STATE)
                    stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                    yield JointState(number, stamp, message.name, message.position, message.velocity, message.effort)
            except Exception as error:
                raise self._error(error) from error

        return collect_joint_states(self._path, topic, messages(), skip_invalid=skip_invalid)

    def instrument(self, namespace: str) -> str:
        """Returns the first instrument on the topic `TOOL_TYPE` of an arm, or "" if there is none."""
        topic = f"{namespace}/{TOOL_TYPE}"
        own = [each for each in self._reader.connections if (each.topic, each.msgtype) == (topic, STRING)]
        if not own:
            return ""
        try:
            for _, _, data in self._reader.messages(own):
                message: Any = self._reader.deserialize(data, STRING)
                return str(message.data).replace(":", "_")
        except Exception as error:
            raise self._error(error) from error
        return ""

    def close(self) -> None:
        """Closes the bag."""
        self._opened.close()

    def _error(self, error: Exception) -> RecordingError:
        # Errors of these types have texts about the program instead of the bag.
        is_internal = isinstance(error, (TypeError, KeyError, IndexError, AssertionError, AttributeError, struct.error))
        text = "damaged" if is_internal else " ".join(str(error).split()) or "damaged"
        text = text.replace(str(self.parts[0]), str(self._path))
        repair = {".bag": "rosbag reindex", ".mcap": "mcap recover"}.get(self.parts[0].suffix, "ros2 bag reindex")
        self.close()
        return RecordingError(
            f"{self._path}: the bag cannot be read ({text}). It may be incomplete; `{repair}` can repair it."
        )
