"""Writes the messages of an arm to MCAP bags for ROS 2 tools, Foxglove and Rerun, completely or while they arrive.

The format is described at https://mcap.dev/spec and https://mcap.dev/spec/registry (profile ros2). The schema of each
topic is the definition of its message, so that a reader needs no ROS installation.

| topic | message | content |
|---|---|---|
| `/<ARM>/measured_js`, `/<ARM>/<separate joint>/measured_js` | `sensor_msgs/JointState` | measurements |
| `/<ARM>/setpoint_js`, `/<ARM>/<separate joint>/setpoint_js` | `sensor_msgs/JointState` | commands |
| `/tf`, at most `TRANSFORM_RATE` | `tf2_msgs/TFMessage` | transforms of the moving links |
| `/tf_static`, once | `tf2_msgs/TFMessage` | constant transforms |
| `/<ARM>/robot_description`, once | `std_msgs/String` | URDF |
| `/<ARM>/tool_type`, once | `std_msgs/String` | instrument, if it is not that of the arm file |

`read_ros_bag` reads the topics `measured_js` and `tool_type`, and ignores the others.
"""

from __future__ import annotations

import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame, WeldJoint

from dvrk_drake.errors import ModelError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import GrowingFile, atomic_write
from dvrk_drake.models.plant import dh_frames, set_arm_positions, shared_plant
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.models.urdf import to_urdf
from dvrk_drake.recordings.reader_rosbag import JOINT_STATE, STRING, TOOL_TYPE
from dvrk_drake.recordings.recording import Recording, Setpoints

#: Largest rate of the messages on /tf [Hz].
TRANSFORM_RATE = 50
_TF, _TF_STATIC = "/tf", "/tf_static"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
#: Header stamp of the first row of a recording [ns]. A stamp of 0 would mark invalid data.
_FIRST_STAMP = 1_000_000_000
#: Interval between the header stamps of poses without times [s]. A recording with such intervals is not a motion.
_POSE_INTERVAL = 1.0
#: Largest header stamp [ns]: the seconds are a signed 32-bit integer.
_LAST_STAMP = (2**31 - 1) * 1_000_000_000
#: Time after which the messages of a running recording are written to the file [ns]. It limits the loss if the process
#: is terminated. Shorter chunks are compressed less, and need a larger index.
CHUNK_TIME = 100_000_000


class Topic(NamedTuple):
    """Topic with messages of one type, e.g. "sensor_msgs/msg/JointState"."""

    name: str
    message_type: str


class McapWriter:
    """Writes ROS 2 messages to an MCAP stream, encoded as CDR (Common Data Representation)."""

    def __init__(self, stream: Any, topics: Iterable[Topic]) -> None:
        """Begins a bag with these topics. `stream` is a binary stream that is open for writing."""
        # These imports take 0.2 s, and most commands write no bag.
        from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
        from mcap.writer import IndexType, Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        self._serialize, self._message_types = store.serialize_cdr, store.types
        # By default, the library writes pointers to indexes of attachments and metadata, although the bag has neither.
        self._writer = Writer(stream, index_types=IndexType.CHUNK | IndexType.MESSAGE)
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

    def make(self, message_type: str, *fields: Any) -> Any:
        """Returns a message with all its fields, in the order of its definition."""
        return self._message_types[message_type](*fields)

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
    """Bag of a running recording. The messages are written to the file in chunks of `CHUNK_TIME`.

    If the process is terminated, the last chunk and the end of the bag are missing. `mcap recover` then restores all
    complete chunks.
    """

    def __init__(self, path: str | Path, topics: Iterable[Topic]) -> None:
        """Creates the file.

        Raises:
            RecordingError: The file exists or cannot be written.
        """
        self._file, self._flushed = GrowingFile(path), 0
        self._chunks = _Chunks(self._file)
        super().__init__(self._chunks, topics)

    def write_encoded(self, topic: str, data: bytes, publish_time: int, log_time: int) -> None:
        """Writes a message as `McapWriter` does.

        Raises:
            RecordingError: The messages cannot be written; the file ends with its last complete chunk.
        """
        super().write_encoded(topic, data, publish_time, log_time)
        if abs(log_time - self._flushed) >= CHUNK_TIME:
            self._flushed = log_time
            self._writer.flush()

    def close(self) -> None:
        """Writes the last chunk, the index and the end of the bag.

        Raises:
            RecordingError: They cannot be written; the file ends with its last complete chunk.
        """
        try:
            self.finish()
            self._chunks.flush()
        finally:
            self._file.close()


class _Chunks(io.BytesIO):
    """Stream for a `Writer`, which cannot continue after an error of `write`. `flush` writes all collected chunks."""

    def __init__(self, file: GrowingFile) -> None:
        super().__init__()
        self._file, self._size = file, 0

    def flush(self) -> None:
        self._file.append(self.getvalue())
        self._size += len(self.getvalue())
        self.seek(0)
        self.truncate()

    def tell(self) -> int:
        return self._size + super().tell()


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


def joint_state_topics(
    arm: Arm, namespace: str | None = None, name: str = "measured_js"
) -> tuple[JointStateTopic, ...]:
    """Returns the topics on which a dVRK publishes the joint states of an arm.

    Args:
        arm: Arm whose joints are published. Its `separate_joint`, e.g. the jaw, has a separate topic.
        namespace: Namespace of the topics. Default: `/<ARM>`, where ARM is the name of the arm.
        name: Name of the topics in their namespace.
    """
    namespace, topics = f"/{arm.name}" if namespace is None else namespace, dict[str, list[int]]()
    for i, joint in enumerate(arm.joint_names):
        part = f"/{joint}" if joint == arm.separate_joint else ""
        topics.setdefault(f"{namespace}{part}/{name}", []).append(i)
    return tuple(
        JointStateTopic(topic, tuple(arm.joint_names[i] for i in columns), columns) for topic, columns in topics.items()
    )


class FrameMessages:
    """Messages that describe an arm: transforms of its links, its URDF and its instrument.

    Attributes:
        topics: Topics of the messages.
    """

    def __init__(self, arm: Arm, namespace: str | None = None) -> None:
        """Creates the messages of an arm, whose texts are in a namespace. Default: `/<ARM>`."""
        self._frames = LinkFrames(arm)
        self._slot: int | None = None
        namespace = f"/{arm.name}" if namespace is None else namespace
        texts = {"robot_description": drawable_urdf(arm), TOOL_TYPE: arm.full_name.partition("+")[2]}
        self._texts = {Topic(f"{namespace}/{name}", STRING): text for name, text in texts.items() if text}
        self.topics = [Topic(_TF, _TRANSFORMS), Topic(_TF_STATIC, _TRANSFORMS), *self._texts]

    def write(self, bag: McapWriter, stamp: int, q: NDArray[np.float64], log_time: int | None = None) -> None:
        """Writes the transforms of the links if `TRANSFORM_RATE` permits it and all positions are finite.

        The first call also writes the constant transforms and the texts.

        Args:
            bag: Bag with the topics `topics`.
            stamp: Header stamp, and time of publication [ns].
            q: Positions (n,) of all joints of the arm [rad, m].
            log_time: Time of arrival [ns]. Default: `stamp`.

        Raises:
            RecordingError: The bag cannot be written.
        """
        slot = stamp * TRANSFORM_RATE // 1_000_000_000
        if slot == self._slot or not np.all(np.isfinite(q)):
            return
        if self._slot is None:
            for topic, text in self._texts.items():
                bag.write(topic.name, bag.make(STRING, text), stamp, log_time)
            _write_transforms(bag, _TF_STATIC, stamp, self._frames.static, log_time)
        self._slot = slot
        _write_transforms(bag, _TF, stamp, self._frames.moving(q), log_time)


class ArmMessages:
    """Messages with the joint states of one arm, and those of `FrameMessages`.

    Attributes:
        topics: Topics of the messages.
    """

    def __init__(self, arm: Arm, *, has_setpoints: bool = False) -> None:
        """Creates the messages of an arm. `has_setpoints` states whether the bag contains commands."""
        self._measured = joint_state_topics(arm)
        self._commanded = joint_state_topics(arm, name="setpoint_js") if has_setpoints else ()
        self._frames = FrameMessages(arm)
        joint_states = [Topic(topic.name, JOINT_STATE) for topic in (*self._measured, *self._commanded)]
        self.topics = [*joint_states, *self._frames.topics]

    def write(
        self,
        bag: McapWriter,
        stamp: int,
        measured: Sequence[NDArray[np.float64] | None],
        commanded: Sequence[NDArray[np.float64] | None] = (None, None, None),
        log_time: int | None = None,
    ) -> None:
        """Writes the messages of one measurement.

        Args:
            bag: Bag with the topics `topics`.
            stamp: Header stamp, and time of publication [ns].
            measured: Positions, velocities and efforts (n,) of all joints of the arm. None: the messages do not contain
                the quantity. The positions are required.
            commanded: The same for the commands. If all are None, no command is written.
            log_time: Time of arrival [ns]. Default: `stamp`.

        Raises:
            RecordingError: The stamp is 0, negative or too large, or the bag cannot be written.
        """
        if not 0 < stamp <= _LAST_STAMP:
            raise RecordingError(
                f"the time of a measurement is {stamp / 1e9:g} s; a bag needs times above 0 s, up to "
                f"{_LAST_STAMP / 1e9:.0f} s"
            )
        for topics, state in ((self._measured, measured), (self._commanded, commanded)):
            if any(part is not None for part in state):
                for topic in topics:
                    blocks = [np.empty(0) if part is None else part[topic.columns] for part in state]
                    message = bag.make(JOINT_STATE, _header(bag, stamp), list(topic.joint_names), *blocks)
                    bag.write(topic.name, message, stamp, log_time)
        q = measured[0]
        assert q is not None
        self._frames.write(bag, stamp, q, log_time)


def _header(bag: McapWriter, stamp: int, frame_id: str = "") -> object:
    time = bag.make("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
    return bag.make("std_msgs/msg/Header", time, frame_id)


def _write_transforms(
    bag: McapWriter, topic: str, stamp: int, transforms: Iterable[FrameTransform], log_time: int | None
) -> None:
    messages = []
    for parent, child, X_PC in transforms:
        w, x, y, z = X_PC.rotation().ToQuaternion().wxyz()
        translation = bag.make("geometry_msgs/msg/Vector3", *X_PC.translation())
        transform = bag.make(
            "geometry_msgs/msg/Transform", translation, bag.make("geometry_msgs/msg/Quaternion", x, y, z, w)
        )
        header = _header(bag, stamp, parent)
        messages.append(bag.make("geometry_msgs/msg/TransformStamped", header, child, transform))
    bag.write(topic, bag.make(_TRANSFORMS, messages), stamp, log_time)


def write_mcap(recording: Recording, path: str | Path, arm: Arm, setpoints: Setpoints | None = None) -> None:
    """Writes a recording as an MCAP bag, atomically and with full precision, in joint coordinates of the arm.

    The header stamp of the first row is 1 s. The intervals between the rows are those of the recording. Static poses
    without times are 1 s apart, so they are not read as a motion. The log times are the header stamps.

    Args:
        recording: Recording to write.
        path: Path of the bag; an existing file is replaced.
        arm: Arm whose name and joint names the bag contains.
        setpoints: Commands of the recording.

    Raises:
        RecordingError: The number of joints is wrong, there are no rows, or the times do not increase.
        DvrkDrakeError: The folder does not exist or cannot be written.
    """
    joints = recording.in_joint_coordinates(arm)
    stamps = _stamps(joints, path)
    messages = ArmMessages(arm, has_setpoints=setpoints is not None)
    commands = (setpoints.q, None, setpoints.tau) if setpoints is not None else (None, None, None)
    with atomic_write(path, "wb") as stream:
        bag = McapWriter(stream, messages.topics)
        for row, stamp in enumerate(stamps):
            measured, commanded = (
                [None if part is None else part[row] for part in parts]
                for parts in ((joints.q, joints.qd, joints.tau), commands)
            )
            messages.write(bag, stamp, measured, commanded)
        bag.finish()


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


#: Frame to which the base of the arm is welded.
WORLD = "world"
#: Elements of a URDF for programs that draw the arm.
_DRAWN = ("link", "joint")
#: Colour of the links (red, green, blue, alpha), which is visible on a white and on a black background.
_COLOR = "0.36 0.45 0.56 1"


class FrameTransform(NamedTuple):
    """Pose X_PC of a child frame in its parent frame. The frames have the names `<ARM>/<link>`, or `WORLD`."""

    parent: str
    child: str
    X_PC: RigidTransform


class LinkFrames:
    """Frames of the links of an arm, including the links of its closed linkage.

    Attributes:
        static: Constant transforms: of the base, of welded links, and of the frames dh_0, dh_1, ... in their links.
    """

    def __init__(self, arm: Arm) -> None:
        """Creates the frames of `arm`. Its locked joints have their stated positions."""
        self._arm = arm
        self._plant = plant = shared_plant(arm)
        self._context = plant.CreateDefaultContext()
        pending = [plant.get_joint(index) for index in plant.GetJointIndices()]
        placed, self._joints, self.static = {WORLD}, [], []
        while pending:
            joint = next(joint for joint in pending if joint.parent_body().name() in placed)
            pending.remove(joint)
            placed.add(joint.child_body().name())
            if isinstance(joint, WeldJoint):
                self.static.append(self._transform(joint.parent_body().body_frame(), joint.child_body().body_frame()))
            else:
                self._joints.append(joint)
        self.static += [self._transform(frame.body().body_frame(), frame) for frame in dh_frames(plant).values()]

    def moving(self, q: ArrayLike) -> list[FrameTransform]:
        """Returns the transforms of all moving links at the pose q (n,) of the independent joints [rad, m].

        Each parent is `base_link`, a welded link, or the child of an earlier transform.
        """
        set_arm_positions(self._plant, self._context, self._arm, q)
        return [
            self._transform(joint.parent_body().body_frame(), joint.child_body().body_frame()) for joint in self._joints
        ]

    def _transform(self, parent: Frame, child: Frame) -> FrameTransform:
        X_PC = self._plant.CalcRelativeTransform(self._context, parent, child)
        return FrameTransform(frame_id(self._arm, parent.name()), frame_id(self._arm, child.name()), X_PC)


def frame_id(arm: Arm, name: str) -> str:
    """Returns the name of a frame in messages: `<ARM>/<name>`, or `WORLD`."""
    return name if name == WORLD else f"{arm.name}/{name}"


def drawable_urdf(arm: Arm) -> str:
    """Returns a URDF that draws the links of an arm in the frames of `LinkFrames`.

    A viewer cannot open the meshes of this package, so each link is drawn with its collision shapes. A link without
    collision shapes is drawn with its visual shapes other than meshes. The names of the links are frame names.

    Returns:
        URDF, or "" if URDF does not support a part of the model.
    """
    root = compose_sdf(arm.sdf)
    for link in root.iter("link"):
        shapes = {kind: link.findall(kind) for kind in ("visual", "collision")}
        drawn = [shape for shape in shapes["collision"] or shapes["visual"] if shape.find("geometry/mesh") is None]
        for shape in [*shapes["visual"], *shapes["collision"]]:
            link.remove(shape)
        for shape in drawn:
            shape.tag = "visual"
            link.append(shape)
    try:
        robot = to_urdf(root)
    except ModelError:
        return ""
    robot.set("name", arm.name)
    for element in list(robot):
        if element.tag not in _DRAWN:
            robot.remove(element)
    for visual in robot.iter("visual"):
        ElementTree.SubElement(ElementTree.SubElement(visual, "material", name="link"), "color", rgba=_COLOR)
    for element, attribute in (
        *((link, "name") for link in robot.iter("link")),
        *((end, "link") for joint in robot.iter("joint") for end in joint if end.tag in ("parent", "child")),
    ):
        element.set(attribute, frame_id(arm, element.get(attribute, "")))
    return ElementTree.tostring(robot, encoding="unicode")
