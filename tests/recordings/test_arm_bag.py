"""Messages of an arm in an MCAP bag, read with libraries that are independent of this package."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from collections import defaultdict

import numpy as np
import pytest
from mcap.reader import make_reader
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from recordings import random_recording, six_joint_arm
from rosbags.highlevel import AnyReader

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.locked_joints import lock_joints
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions, tree_selector
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording, Setpoints
from dvrk_drake.recordings.writer_mcap import joint_state_topics

pytestmark = pytest.mark.drake_api

ARMS = {name: load_arm(name) for name in ("mtml", "mtmr", "psm")}
ARMS["three joints"] = lock_joints(ARMS["psm"], {"roll": 0.3, "wrist_pitch": -0.2, "wrist_yaw": 0.1, "jaw": 0.4})


@pytest.fixture(params=ARMS)
def arm(request):
    return ARMS[request.param]


def poses_of(arm, num_rows=5):
    """Returns a recording of random poses within the limits, one second apart."""
    q = arm.sample_poses(num_rows, np.random.default_rng(5))
    return Recording(q=q, tau=0.1 * q, t=np.arange(float(num_rows)))


def decoded(path):
    """Returns all messages of a bag by topic. The types come from the schemas."""
    messages = defaultdict(list)
    with AnyReader([path]) as bag:
        for connection, _, data in bag.messages():
            messages[connection.topic].append(bag.deserialize(data, connection.msgtype))
    return messages


def pose(transform):
    p, r = transform.translation, transform.rotation
    return RigidTransform(Quaternion([r.w, r.x, r.y, r.z]), [p.x, p.y, p.z])


def poses_in_world(static, moving):
    """Returns the pose of each frame in the frame "world". Each parent must precede its children."""
    X_WF = {"world": RigidTransform()}
    pending = [*static.transforms, *moving.transforms]
    while pending:
        ready = [one for one in pending if one.header.frame_id in X_WF]
        assert ready, "the frames are not a tree with the root world"
        for one in ready:
            assert one.child_frame_id not in X_WF, "a frame has two parents"
            X_WF[one.child_frame_id] = X_WF[one.header.frame_id] @ pose(one.transform)
            pending.remove(one)
    return X_WF


def assert_equal_poses(first, second):
    np.testing.assert_allclose(first.GetAsMatrix4(), second.GetAsMatrix4(), rtol=0, atol=1e-9)


def test_transforms_equal_forward_kinematics_of_drake(tmp_path, arm):
    recording = poses_of(arm)
    write_recording(recording, tmp_path / "a.mcap", arm)
    messages = decoded(tmp_path / "a.mcap")
    (static,) = messages["/tf_static"]
    assert len(messages["/tf"]) == len(recording)
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    for q, moving, state in zip(recording.q, messages["/tf"], messages[f"/{arm.name}/measured_js"], strict=True):
        set_arm_positions(plant, context, arm, q)
        X_WF = poses_in_world(static, moving)
        bodies = plant.GetBodyIndices(plant.GetBodyByName("base_link").model_instance())
        links = [plant.get_body(index) for index in bodies]
        assert {f"{arm.name}/{link.name()}" for link in links} < X_WF.keys()
        for name, X in X_WF.items():
            frame = plant.GetFrameByName(name.removeprefix(f"{arm.name}/"))
            assert_equal_poses(X, frame.CalcPoseInWorld(context))
        assert {one.header.stamp.sec for one in moving.transforms} == {state.header.stamp.sec}


def test_urdf_has_the_frames_of_the_transforms(tmp_path, arm):
    recording = poses_of(arm)
    write_recording(recording, tmp_path / "a.mcap", arm)
    messages = decoded(tmp_path / "a.mcap")
    (description,) = messages[f"/{arm.name}/robot_description"]
    assert "<visual" in description.data
    assert "<mesh" not in description.data, "a viewer cannot open the meshes of this package"
    plant = MultibodyPlant(0.001)
    (instance,) = Parser(plant).AddModelsFromString(description.data, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(f"{arm.name}/base_link"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    tree = arm.linkage.position(recording.q)
    for row, moving in enumerate(messages["/tf"]):
        q = np.zeros(plant.num_positions())
        q[tree_selector(plant, arm)] = tree[row]
        plant.SetPositions(context, q)
        X_WF = poses_in_world(messages["/tf_static"][0], moving)
        for index in plant.GetBodyIndices(instance):
            link = plant.get_body(index)
            assert_equal_poses(X_WF[link.name()], link.EvalPoseInWorld(context))


def test_other_decoders_accept_all_messages(tmp_path, arm):
    """`mcap-ros2-support-fast` compiles decoders from the schemas, independently of rosbags."""
    factory = pytest.importorskip("mcap_ros2_support_fast").DecoderFactory
    write_recording(poses_of(arm), tmp_path / "a.mcap", arm, Setpoints(poses_of(arm).q))
    with (tmp_path / "a.mcap").open("rb") as file:
        messages = list(make_reader(file, decoder_factories=[factory()]).iter_decoded_messages())
    expected = decoded(tmp_path / "a.mcap")
    assert len(messages) == sum(map(len, expected.values()))
    last = {channel.topic: message for _, channel, _, message in messages}
    assert last.keys() == expected.keys()
    child = last["/tf"].transforms[-1]
    assert child.child_frame_id == expected["/tf"][-1].transforms[-1].child_frame_id
    assert child.transform.translation.x == expected["/tf"][-1].transforms[-1].transform.translation.x
    names = list(arm.joint_names)
    assert list(last[f"/{arm.name}/setpoint_js"].name) == [name for name in names if name != arm.separate_joint]


@pytest.mark.parametrize(("rate", "expected"), [(1000, 50), (100, 50), (50, 50), (10, 10)])
def test_rate_of_transforms_is_limited(tmp_path, rate, expected):
    arm = ARMS["mtml"]
    write_recording(random_recording(2 * rate, t=np.arange(2 * rate) / rate), tmp_path / "a.mcap", arm)
    stamps = [one.transforms[0].header.stamp for one in decoded(tmp_path / "a.mcap")["/tf"]]
    assert len(stamps) == 2 * expected
    assert (stamps[0].sec, stamps[0].nanosec) == (1, 0), "the transforms begin with the first measurement"


def test_setpoints_are_on_their_topics_and_not_read(tmp_path):
    arm, recording = ARMS["psm"], random_recording()
    setpoints = Setpoints(recording.q + 1, recording.tau - 1)
    write_recording(recording, tmp_path / "a.mcap", arm, setpoints)
    messages = decoded(tmp_path / "a.mcap")
    for topic, columns in (("/PSM/setpoint_js", slice(0, 6)), ("/PSM/jaw/setpoint_js", slice(6, 7))):
        np.testing.assert_array_equal([one.position for one in messages[topic]], setpoints.q[:, columns])
        np.testing.assert_array_equal([one.effort for one in messages[topic]], setpoints.tau[:, columns])
        assert all(len(one.velocity) == 0 for one in messages[topic])
    again = read_recording(tmp_path / "a.mcap", arm)
    for name in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recording, name))


def test_unknown_positions_have_no_transforms(tmp_path):
    recording = random_recording(3, t=np.arange(3.0))
    recording.q[1, 2] = np.nan
    write_recording(recording, tmp_path / "a.mcap", ARMS["mtml"])
    messages = decoded(tmp_path / "a.mcap")
    assert len(messages["/MTML/measured_js"]) == 3
    assert [one.transforms[0].header.stamp.sec for one in messages["/tf"]] == [1, 3]


def test_unsupported_urdf_is_omitted(tmp_path):
    arm = ARMS["mtml"]
    model = compose_sdf(arm.sdf)
    dynamics = ElementTree.SubElement(next(model.iter("axis")), "dynamics")
    ElementTree.SubElement(dynamics, "spring_stiffness").text = "0.1"
    (tmp_path / "arm.sdf").write_text(ElementTree.tostring(model, encoding="unicode"))
    springy = dataclasses.replace(arm, sdf=(str(tmp_path / "arm.sdf"),))
    write_recording(poses_of(arm), tmp_path / "a.mcap", springy)
    messages = decoded(tmp_path / "a.mcap")
    assert "/MTML/robot_description" not in messages
    assert len(messages["/tf"]) == 5


def test_arm_without_the_separate_joint_has_one_topic():
    (topic,) = joint_state_topics(six_joint_arm(), "/davinci/PSM3")
    assert topic.name == "/davinci/PSM3/measured_js"
    assert topic.columns == list(range(6))
