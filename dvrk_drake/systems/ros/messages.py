"""Types of the ROS 2 messages of a dVRK, for Cyclone DDS.

The ROS 2 type `sensor_msgs/msg/JointState` is the DDS type `sensor_msgs::msg::dds_::JointState_`
(https://design.ros2.org/articles/topic_and_service_names.html).
"""

# mypy: disable-error-code=call-arg
# mypy does not find the keyword `typename` of IdlStruct.

import re
import time
from dataclasses import dataclass, field

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Time stamp."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Time stamp and name of a frame. A dVRK marks invalid data with the time stamp 0."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""

    @classmethod
    def now(cls, frame_id: str = "") -> "Header":
        """Returns a header with the current time of day."""
        return cls(Time(*divmod(time.time_ns(), 10**9)), frame_id)

    @property
    def nanoseconds(self) -> int:
        """Time stamp [ns since 1970]."""
        return self.stamp.sec * 10**9 + self.stamp.nanosec


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """Names, positions, velocities and efforts of joints. An absent quantity is an empty list."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """Vector."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """Position [m]."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """Orientation as a unit quaternion."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """Position and orientation."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """Pose with a header."""

    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    """Translational velocity [m/s] and angular velocity [rad/s]."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TwistStamped_"):
    """Velocity with a header."""

    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
class Bool(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):
    """Boolean."""

    data: bool = False


@dataclass
class Empty(IdlStruct, typename="std_msgs::msg::dds_::Empty_"):
    """Message without content. IDL requires one member."""

    structure_needs_at_least_one_member: uint8 = 0


@dataclass
class StringStamped(IdlStruct, typename="crtk_msgs::msg::dds_::StringStamped_"):
    """Text with a header."""

    header: Header = field(default_factory=Header)
    string: str = ""


@dataclass
class OperatingState(IdlStruct, typename="crtk_msgs::msg::dds_::OperatingState_"):
    """Operating state of an arm: DISABLED, ENABLED, PAUSED or FAULT."""

    header: Header = field(default_factory=Header)
    state: str = ""
    is_homed: bool = False
    is_busy: bool = False


#: Type hash (REP 2016) of each type that has topics.
_HASHES: dict[type[IdlStruct], str] = {
    JointState: "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    PoseStamped: "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    TwistStamped: "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    Bool: "feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
    Empty: "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312",
    StringStamped: "83efb802e6596e03f69ac322e3231037329946f2bd13ed48874d97f5b8f5db1d",
    OperatingState: "5cc57eea589b217fe5194bf2735b91d4a7f2dd5ac1245ae657f7ea7590c2c80e",
}


def type_hash(message_type: type[IdlStruct]) -> str:
    """Returns the type hash of a message type as ROS 2 announces it, "RIHS01_" and 64 hexadecimal digits."""
    return f"RIHS01_{_HASHES[message_type]}"


def dds_type_name(message_type: type[IdlStruct]) -> str:
    """Returns the DDS name of a message type, e.g. "std_msgs::msg::dds_::Bool_"."""
    return str(message_type.__idl_typename__)


def ros_type_name(dds_name: str) -> str:
    """Returns the ROS 2 name of a DDS type, e.g. "std_msgs/msg/Bool" for "std_msgs::msg::dds_::Bool_"."""
    return re.sub(r"dds_::(\w+)_$", r"\1", dds_name).replace("::", "/")
