"""Writes ROS 2 messages to MCAP bags, completely or while they arrive.

The format is described at https://mcap.dev/spec and https://mcap.dev/spec/registry (profile ros2). The schema of each
topic is the definition of its message, so that a reader needs no ROS installation.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.files import atomic_write
from dvrk_drake.recordings.csv_rows import GrowingFile

#: Messages between two reports of progress.
_REPORT = 4096


class Topic(NamedTuple):
    """Topic with messages of one type, e.g. "sensor_msgs/msg/JointState"."""

    name: str
    message_type: str


class McapWriter:
    """Writes ROS 2 messages to an MCAP stream, encoded as CDR (Common Data Representation)."""

    def __init__(self, stream: Any, topics: Iterable[Topic], *, chunked: bool = True) -> None:
        """Begins a bag.

        Args:
            stream: Binary stream, or an object with the methods `write` and `tell`.
            topics: Topics of the bag.
            chunked: Whether to compress and index the messages in chunks. If False, each message is written at once.
        """
        # These imports take 0.2 s, and most commands write no bag.
        from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        self._serialize, self._message_types = store.serialize_cdr, store.types
        self._writer = _new_writer(stream, chunked=chunked)
        self._writer.start(Profile.ROS2, f"dvrk-drake {version('dvrk-drake')}")
        self._types = {topic.name: topic.message_type for topic in topics}
        schemas = {}
        for message_type in dict.fromkeys(self._types.values()):
            definition, _ = store.generate_msgdef(message_type, ros_version=2)
            schemas[message_type] = self._writer.register_schema(message_type, SchemaEncoding.ROS2, definition.encode())
        self._channels = {
            name: self._writer.register_channel(name, MessageEncoding.CDR, schemas[message_type])
            for name, message_type in self._types.items()
        }
        self._counts = dict.fromkeys(self._channels, 0)

    def make(self, message_type: str, **fields: Any) -> Any:
        """Returns a message with all its fields."""
        return self._message_types[message_type](**fields)

    def write(self, topic: str, message: Any, publish_time: int, log_time: int | None = None) -> None:
        """Writes a message.

        Args:
            topic: Name of the topic.
            message: Message, see `make`.
            publish_time: Time of publication [ns].
            log_time: Time of arrival [ns]. Default: `publish_time`.
        """
        data = bytes(self._serialize(message, self._types[topic]))
        self.write_encoded(topic, data, publish_time, publish_time if log_time is None else log_time)

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

    def __init__(self, path: str | Path, topics: Iterable[Topic]) -> None:
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
