"""Tests a custom instrument: other links, other joints, files outside the package."""

import numpy as np
import pytest

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions
from dvrk_drake.systems.arm_station import ArmStation

pytestmark = pytest.mark.drake_api

PROBE_SDF = """<?xml version="1.0"?>
<sdf version="1.9">
  <model name="probe">
    <link name="probe_link">
      <pose>0 0 0.0156 0 0 0</pose>
      <inertial>
        <pose>0.02 0 -0.1 0 0 0</pose>
        <mass>0.1</mass>
        <inertia><ixx>1e-4</ixx><iyy>1e-4</iyy><izz>1e-5</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>
      </inertial>
      <collision name="tip"><geometry><sphere><radius>0.01</radius></sphere></geometry></collision>
    </link>
    <joint name="roll" type="revolute">
      <parent>insertion_link</parent>
      <child>probe_link</child>
      <axis><xyz>0 0 -1</xyz><limit><lower>-3</lower><upper>3</upper><effort>0.3</effort></limit></axis>
    </joint>
    <frame name="dh_4" attached_to="probe_link"><pose degrees="true">0 0 0 180 0 -90</pose></frame>
  </model>
</sdf>
"""
PROBE_YAML = """sdf: probe.sdf
joints: [roll]
position_limits: {roll: [-3.0, 3.0]}
gains: {kp: [0.4], kd: [0.01], ki: [1.6]}
"""
LIMITS = "position_limits: {yaw: [-1.588, 1.588], pitch: [-0.925, 0.925], insertion: [0.0, 0.24]}\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "probe.sdf").write_text(PROBE_SDF)
    (tmp_path / "probe.yaml").write_text(PROBE_YAML)
    (tmp_path / "arm.yaml").write_text(f"name: PSM\nmechanism: psm\ninstrument: probe.yaml\n{LIMITS}")
    (tmp_path / "bare.yaml").write_text(f"name: PSM\nmechanism: psm\n{LIMITS}")
    return tmp_path


def test_custom_instrument_is_attached_to_the_arm(folder):
    arm = load_arm(str(folder / "arm.yaml"))
    assert arm.joint_names == ("yaw", "pitch", "insertion", "roll")
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    q = np.array([0.5, 0.3, 0.1, 0.7])
    set_arm_positions(plant, context, arm, q)
    torque = IdentifiedModel.from_arm(arm).holding_torque(q)
    np.testing.assert_allclose(torque, holding_torque(plant, context, arm), atol=1e-12)
    assert abs(torque[3]) > 1e-3  # its centre of mass is off the shaft axis


@pytest.mark.parametrize(("name", "hand"), [("arm.yaml", "probe_link"), ("bare.yaml", "dh_3")])
def test_hand_holds_the_instrument_if_there_is_one(folder, name, hand):
    frames = load_arm(str(folder / name)).frames
    assert (frames.hand, frames.remote_center, frames.shaft) == (hand, "dh_0", "")


@pytest.mark.parametrize("name", ["arm.yaml", "bare.yaml"])
def test_custom_instrument_is_simulated_without_self_collision(folder, name):
    station = ArmStation(load_arm(str(folder / name)), closure="ball")
    context = station.CreateDefaultContext()
    query = station.GetOutputPort("query_object").Eval(context)
    assert not query.inspector().GetCollisionCandidates()


def test_missing_instrument_file_is_named(folder):
    (folder / "bad.yaml").write_text((folder / "arm.yaml").read_text().replace("probe.yaml", "gone.yaml"))
    with pytest.raises(ArmError, match=r"bad\.yaml: instrument .*gone\.yaml does not exist"):
        load_arm(str(folder / "bad.yaml"))
