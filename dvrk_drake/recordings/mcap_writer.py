"""Writes joint states of an arm to an MCAP bag for ROS 2 tools and Foxglove.

The bag contains `sensor_msgs/JointState` messages on the topics of a dVRK. `read_ros_bag` reads it. The format is
described at https://mcap.dev/spec and https://mcap.dev/spec/registry (profile ros2).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.recordings.csv_rows import GrowingFile
from dvrk_drake.recordings.ros_bag import JOINT_STATE

if TYPE_CHECKING:
    from dvrk_drake.recordings.recording import Recording

#: Header stamp of the first row of a recording [ns]. A stamp of 0 would mark invalid data.
_FIRST_STAMP = 1_000_000_000
#: Interval between the header stamps of poses without times [s]. A recording with such intervals is not a motion.
_POSE_INTERVAL = 1.0
#: Largest header stamp [ns]: the seconds are a signed 32-bit integer.
_LAST_STAMP = (2**31 - 1) * 1_000_000_000
#: Messages between two reports of progress.
_REPORT = 4096


class JointStateTopic(NamedTuple):
    """Topic with the states of some joints of an arm.

    Attributes:
        name: Name of the topic.
        joint_names: Names of the joints.
        columns: Index of each joint among the joints of the arm.
    """

    name: str
    joint_names: tuple[str, ...]
    columns: list[int]


def joint_state_topics(arm: Arm, namespace: str | None = None) -> tuple[JointStateTopic, ...]:
    """Returns the topics on which a dVRK publishes the measured joint states of an arm.

    Args:
        arm: Arm whose joints are published. Its `separate_joint`, e.g. the jaw, has a separate topic.
        namespace: Namespace of the topics. Default: `/<ARM>`, where ARM is the name of the arm.
    """
    namespace = f"/{arm.name}" if namespace is None else namespace
    topics = []
    for suffix, is_separate in (("", False), (f"/{arm.separate_joint}", True)):
        columns = [i for i, joint in enumerate(arm.joint_names) if (joint == arm.separate_joint) == is_separate]
        if columns:
            joints = tuple(arm.joint_names[i] for i in columns)
            topics.append(JointStateTopic(f"{namespace}{suffix}/measured_js", joints, columns))
    return tuple(topics)


class McapWriter:
    """Writes JointState messages to an MCAP stream, in the encoding of ROS 2 (CDR, Common Data Representation)."""

    def __init__(self, stream: Any, topics: Iterable[str], *, chunked: bool = True) -> None:
        """Begins a bag.

        Args:
            stream: Binary stream, or an object with the methods `write` and `tell`.
            topics: Names of the topics.
            chunked: Whether to compress and index the messages in chunks. If False, each message is written at once.
        """
        # These imports take 0.2 s, and most commands write no bag.
        from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        self._serialize = store.serialize_cdr
        self._state, self._header, self._time = (
            store.types[name] for name in (JOINT_STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
        )
        self._writer = _new_writer(stream, chunked=chunked)
        self._writer.start(Profile.ROS2, f"dvrk-drake {version('dvrk-drake')}")
        definition, _ = store.generate_msgdef(JOINT_STATE, ros_version=2)
        schema = self._writer.register_schema(JOINT_STATE, SchemaEncoding.ROS2, definition.encode())
        self._channels = {topic: self._writer.register_channel(topic, MessageEncoding.CDR, schema) for topic in topics}
        self._counts = dict.fromkeys(self._channels, 0)

    def write(
        self,
        topic: JointStateTopic,
        stamp: int,
        q: NDArray[np.float64],
        qd: NDArray[np.float64] | None,
        tau: NDArray[np.float64] | None,
        log_time: int | None = None,
    ) -> None:
        """Writes one message.

        Args:
            topic: Topic of the message.
            stamp: Header stamp, and time of publication [ns].
            q, qd, tau: Positions, velocities and efforts (n,) of all joints of the arm. None: the message does not
                contain the quantity.
            log_time: Time of arrival [ns]. Default: `stamp`.

        Raises:
            RecordingError: The stamp is 0, negative or too large.
        """
        if not 0 < stamp <= _LAST_STAMP:
            raise RecordingError(
                f"the time of a measurement is {stamp / 1e9:g} s; a bag needs times above 0 s, up to "
                f"{_LAST_STAMP / 1e9:.0f} s"
            )
        empty = np.empty(0)
        message = self._state(
            header=self._header(stamp=self._time(*divmod(stamp, 1_000_000_000)), frame_id=""),
            name=list(topic.joint_names),
            position=q[topic.columns],
            velocity=empty if qd is None else qd[topic.columns],
            effort=empty if tau is None else tau[topic.columns],
        )
        data = bytes(self._serialize(message, JOINT_STATE))
        self.write_encoded(topic.name, data, stamp, stamp if log_time is None else log_time)

    def write_encoded(self, topic: str, data: bytes, publish_time: int, log_time: int) -> None:
        """Writes a message that is already encoded (CDR), with its times of publication and arrival [ns]."""
        sequence = self._counts[topic]
        self._counts[topic] += 1
        self._writer.add_message(self._channels[topic], log_time, data, publish_time, sequence)

    def finish(self) -> None:
        """Writes the index and the end of the bag. The stream remains open."""
        self._writer.finish()


class GrowingMcap(McapWriter):
    """Bag of a running recording. Each message is written to the file immediately.

    If the process is terminated, the end of the bag is missing. `mcap recover` then restores all complete messages.
    """

    def __init__(self, path: str | Path, topics: Iterable[str]) -> None:
        """Creates the file.

        Raises:
            RecordingError: The file exists or cannot be written.
        """
        self._path, self._file = path, GrowingFile(path)
        super().__init__(_Records(self._file), topics, chunked=False)

    def close(self, progress: Callable[[float], object] = lambda share: None) -> None:
        """Ends the bag, compresses its messages in chunks, and adds an index. This takes 10 us per message.

        Args:
            progress: Callback that receives the completed fraction (0 to 1).

        Raises:
            RecordingError: The end or the index cannot be written. The file contains all complete messages.
        """
        try:
            self.finish()
        finally:
            self._file.close()
        try:
            _pack(self._path, progress)
        except DvrkDrakeError as error:
            raise RecordingError(f"{self._path} is complete, but has no index: {error}") from error


class _Records:
    """Stream for a `Writer`. Each record is appended to a file by one write."""

    def __init__(self, file: GrowingFile) -> None:
        self._file, self._size = file, 0

    def write(self, data: bytes) -> None:
        if data:
            self._file.append(data)
            self._size += len(data)

    def tell(self) -> int:
        return self._size


def _new_writer(stream: Any, *, chunked: bool = True) -> Any:
    from mcap.writer import IndexType, Writer

    # By default, the library writes pointers to indexes of attachments and metadata, although the bag has neither.
    indexes = IndexType.CHUNK | IndexType.MESSAGE if chunked else IndexType.NONE
    return Writer(stream, use_chunking=chunked, index_types=indexes)


def _pack(path: str | Path, progress: Callable[[float], object]) -> None:
    """Replaces a bag without chunks by a bag with compressed chunks and an index, atomically."""
    from mcap.records import Channel, Header, Message, Schema
    from mcap.stream_reader import StreamReader

    with open(path, "rb") as source, atomic_write(path, "wb") as stream:
        writer, size, count = _new_writer(stream), os.path.getsize(path), 0
        seen: set[tuple[type, int]] = set()
        for record in StreamReader(source).records:
            if isinstance(record, Header):
                writer.start(record.profile, record.library)
            elif isinstance(record, Message):
                writer.add_message(
                    record.channel_id, record.log_time, record.data, record.publish_time, record.sequence
                )
                count += 1
                if count % _REPORT == 0:
                    progress(source.tell() / size)
            # The end of a bag repeats its schemas and channels.
            elif isinstance(record, (Schema, Channel)) and (type(record), record.id) not in seen:
                seen.add((type(record), record.id))
                if isinstance(record, Schema):
                    writer.register_schema(record.name, record.encoding, record.data)
                else:
                    writer.register_channel(record.topic, record.message_encoding, record.schema_id, record.metadata)
        writer.finish()


def write_mcap(recording: Recording, path: str | Path, arm: Arm) -> None:
    """Writes a recording as an MCAP bag, atomically and with full precision, in joint coordinates of the arm.

    The header stamp of the first row is 1 s. The intervals between the rows are those of the recording. Static poses
    without times are 1 s apart, so they are not read as a motion. The log times are the header stamps.

    Args:
        recording: Recording to write.
        path: Path of the bag; an existing file is replaced.
        arm: Arm whose name and joint names the bag contains.

    Raises:
        RecordingError: The number of joints is wrong, there are no rows, or the times do not increase.
        DvrkDrakeError: The folder does not exist or cannot be written.
    """
    joints = recording.in_joint_coordinates(arm)
    stamps = _stamps(joints, path)
    topics = joint_state_topics(arm)
    with atomic_write(path, "wb") as stream:
        writer = McapWriter(stream, [topic.name for topic in topics])
        for row, stamp in enumerate(stamps):
            q, qd, tau = (None if part is None else part[row] for part in (joints.q, joints.qd, joints.tau))
            assert q is not None
            for topic in topics:
                writer.write(topic, stamp, q, qd, tau)
        writer.finish()


def _stamps(recording: Recording, path: str | Path) -> list[int]:
    """Returns the header stamps [ns] of all rows.

    Raises:
        RecordingError: There are no rows, or the stamps do not increase or are too large.
    """
    if not len(recording):
        raise RecordingError(f"{path} was not written: the recording has no rows")
    t = recording.t if recording.t is not None else _POSE_INTERVAL * np.arange(len(recording))
    elapsed = 1e9 * (t - t[0])
    if not np.all(elapsed < _LAST_STAMP - _FIRST_STAMP):  # also false for NaN
        raise RecordingError(f"{path} was not written: allowed in a bag: finite times up to {_LAST_STAMP / 1e9:g} s")
    stamps = _FIRST_STAMP + np.rint(elapsed).astype(np.int64)
    if np.any(late := np.diff(stamps) <= 0):
        row = int(np.argmax(late)) + 1
        raise RecordingError(
            f"{recording.where(row)}: t = {t[row]:.9g} s is not later than the previous row; the times of a bag must "
            "increase by at least 1 ns"
        )
    return stamps.tolist()
