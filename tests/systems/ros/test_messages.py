"""Messages of a dVRK: bytes, decoding, names and type hashes as those of `rosbags`, an independent implementation."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

messages = pytest.importorskip("dvrk_drake.systems.ros.messages", reason="needs cyclonedds")

#: Definitions of the message types of CRTK, from https://github.com/collaborative-robotics/crtk_msgs.
CRTK_TYPES = {
    "crtk_msgs/msg/StringStamped": "std_msgs/Header header\nstring string\n",
    "crtk_msgs/msg/OperatingState": "std_msgs/Header header\nstring state\nbool is_homed\nbool is_busy\n",
}
#: ROS 2 names of the types that have topics.
NAMES = {
    messages.JointState: "sensor_msgs/msg/JointState",
    messages.PoseStamped: "geometry_msgs/msg/PoseStamped",
    messages.TwistStamped: "geometry_msgs/msg/TwistStamped",
    messages.WrenchStamped: "geometry_msgs/msg/WrenchStamped",
    messages.Float64MultiArray: "std_msgs/msg/Float64MultiArray",
    messages.Bool: "std_msgs/msg/Bool",
    messages.Empty: "std_msgs/msg/Empty",
    messages.String: "std_msgs/msg/String",
    messages.StringStamped: "crtk_msgs/msg/StringStamped",
    messages.OperatingState: "crtk_msgs/msg/OperatingState",
}

# Texts of each length shift the numbers that follow to each alignment. A text of ROS has no null character.
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20) | st.integers(
    100, 3000
).map("ä".__mul__)
NUMBERS = st.floats(allow_nan=True, allow_infinity=True)
LISTS = st.lists(NUMBERS, max_size=9)
HEADERS = st.builds(
    messages.Header, st.builds(messages.Time, st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1)), TEXTS
)
VECTORS = st.builds(messages.Vector3, NUMBERS, NUMBERS, NUMBERS)
POSES = st.builds(
    messages.Pose,
    st.builds(messages.Point, NUMBERS, NUMBERS, NUMBERS),
    st.builds(messages.Quaternion, NUMBERS, NUMBERS, NUMBERS, NUMBERS),
)
SIZES = st.integers(0, 2**32 - 1)
LAYOUTS = st.builds(
    messages.MultiArrayLayout, st.lists(st.builds(messages.MultiArrayDimension, TEXTS, SIZES, SIZES), max_size=3), SIZES
)
CONTENTS = {
    messages.JointState: (HEADERS, st.lists(TEXTS, max_size=9), LISTS, LISTS, LISTS),
    messages.PoseStamped: (HEADERS, POSES),
    messages.TwistStamped: (HEADERS, st.builds(messages.Twist, VECTORS, VECTORS)),
    messages.WrenchStamped: (HEADERS, st.builds(messages.Wrench, VECTORS, VECTORS)),
    messages.Float64MultiArray: (LAYOUTS, LISTS),
    messages.Bool: (st.booleans(),),
    messages.Empty: (),
    messages.String: (TEXTS,),
    messages.StringStamped: (HEADERS, TEXTS),
    messages.OperatingState: (HEADERS, TEXTS, st.booleans(), st.booleans()),
}
each_type = pytest.mark.parametrize("message_type", NAMES, ids=lambda message_type: message_type.__name__)


@pytest.fixture(scope="module")
def rosbags_types():
    """Returns the type store of `rosbags` for ROS 2 Jazzy, with the types of CRTK."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in CRTK_TYPES.items():
        store.register(get_types_from_msg(definition, name))
    return store


def in_rosbags(value, store):
    """Returns a message or one of its members as an object of `rosbags`."""
    if not dataclasses.is_dataclass(value):
        return np.array(value) if isinstance(value, list) and not any(isinstance(v, str) for v in value) else value
    rosbags_type = store.types[messages.ros_type_name(messages.dds_type_name(type(value)))]
    names = [member.name for member in dataclasses.fields(rosbags_type) if member.name != "__msgtype__"]
    return rosbags_type(*(in_rosbags(getattr(value, name), store) for name in names))


@each_type
@settings(deadline=None)
@given(data=st.data())
def test_bytes_and_decoded_messages_equal_those_of_rosbags(message_type, rosbags_types, data):
    message = data.draw(st.builds(message_type, *CONTENTS[message_type]))
    encoded = message.serialize(use_version_2=False)
    assert encoded == bytes(rosbags_types.serialize_cdr(in_rosbags(message, rosbags_types), NAMES[message_type]))
    # Unlike ==, a representation is equal for two NaN, and different for 0.0 and -0.0.
    assert repr(message_type.deserialize(encoded)) == repr(message)
    # On the network, zeros fill the last word. test_domain.py checks these bytes.
    assert repr(message_type.deserialize(encoded + bytes(-len(encoded) % 4))) == repr(message)


@each_type
def test_names_and_type_hashes_equal_those_of_ros(message_type, rosbags_types):
    package, _, name = NAMES[message_type].split("/")
    assert messages.dds_type_name(message_type) == f"{package}::msg::dds_::{name}_"
    assert messages.ros_type_name(messages.dds_type_name(message_type)) == NAMES[message_type]
    assert messages.type_hash(message_type) == rosbags_types.hash_rihs01(NAMES[message_type])


def test_stamp_is_the_time_of_day():
    before, header = messages.time.time_ns(), messages.Header.now("frame")
    assert before <= header.nanoseconds <= messages.time.time_ns()
    assert header.stamp.nanosec < 10**9
    assert messages.Header(messages.Time(-1, 999_999_999)).nanoseconds == -1
