"""Tests arms that are loaded from the model file of any robot."""

import numpy as np
import pytest
from pydrake.geometry import Mesh
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from robot_file import URDF, write_robot

from dvrk_drake.errors import ArmError
from dvrk_drake.export.model_writer import write_model
from dvrk_drake.models.arm import SoftWalls
from dvrk_drake.models.arm_files import derived_arm_file, load_arm
from dvrk_drake.models.plant import add_arm, arm_sdf, holding_torques, inverse_dynamics
from dvrk_drake.models.sdf_model import compose_sdf

MJCF = """<mujoco model="lever">
  <compiler angle="radian"/>
  <worldbody>
    <body name="beam" pos="0 0 1">
      <joint name="tilt" type="hinge" axis="0 1 0" pos="0.1 0 0" range="-1 1" armature="0.02" damping="0.3"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.5 0 0" mass="2"/>
      <body name="bob" pos="0.5 0 0">
        <joint name="slide" type="slide" axis="1 0 0" range="0 0.2"/>
        <geom type="sphere" size="0.05" mass="0.7"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="tilt" forcerange="-30 30" forcelimited="true"/>
    <motor joint="slide" forcerange="-9 9" forcelimited="true"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    return write_robot(tmp_path_factory.mktemp("crane"))


def original_plant(path, text):
    """Plant as Drake reads it, without shapes."""
    plant = MultibodyPlant(1e-3)
    Parser(plant).AddModelsFromString(text, path.suffix.strip("."))
    plant.Finalize()
    return plant


def test_urdf_defines_joints_limits_and_gains(crane):
    arm = load_arm(crane)
    assert arm.name == "crane"
    assert arm.joint_names == ("turn", "lift", "swing")
    assert arm.tree_joint_names == ("turn", "lift", "swing", "level")
    np.testing.assert_array_equal(arm.linkage.matrix[3], [0, 0, -0.8])
    np.testing.assert_array_equal(arm.prismatic, [False, True, False])
    np.testing.assert_array_equal(arm.position_upper, [2 * np.pi, 0.3, 2.0])
    np.testing.assert_array_equal(arm.effort_limits, [80, 120, 20])
    # Critical damping: kd^2 = 4 kp M, and kp = w^2 M, so that kd = 2 kp / w. The wall of the lift needs a larger kp.
    np.testing.assert_allclose((np.array(arm.gains.kd) / arm.gains.kp)[[0, 2]], 0.1, atol=1e-9)
    walls = SoftWalls.of(arm).width / (arm.position_upper - arm.position_lower)
    np.testing.assert_allclose(walls[1], 0.1, atol=1e-9)
    assert walls[0] < 0.1 and walls[2] < 0.1
    assert load_arm(str(crane)) is arm


def test_dynamics_are_those_of_the_file(crane):
    arm, plant = load_arm(crane), original_plant(crane, URDF)
    generator = np.random.default_rng(1)
    poses = arm.sample_poses(5, generator)
    v, vd = generator.normal(size=(2, *poses.shape))
    efforts = inverse_dynamics(arm, poses, v, vd)
    context = plant.CreateDefaultContext()
    for row, q in enumerate(poses):
        plant.SetPositions(context, arm.linkage.position(q))
        plant.SetVelocities(context, arm.linkage.velocity(v[row]))
        tau_g = plant.CalcGravityGeneralizedForces(context)
        np.testing.assert_allclose(holding_torques(arm, q[None])[0], -arm.linkage.pull_back_effort(tau_g), atol=1e-9)
        M, bias = plant.CalcMassMatrix(context), plant.CalcBiasTerm(context)
        tau = M @ arm.linkage.velocity(vd[row]) + bias - tau_g
        tau[0] += 0.5 * v[row, 0]
        np.testing.assert_allclose(efforts[row], arm.linkage.pull_back_effort(tau), atol=1e-9)


def test_frames_of_fixed_links_remain(crane):
    from dvrk_drake.models.plant import shared_plant

    plant, original = shared_plant(load_arm(crane)), original_plant(crane, URDF)
    poses = []
    for model in (plant, original):
        context = model.CreateDefaultContext()
        model.SetPositions(context, [0.3, 0.1, 0.5, -0.3])
        poses.append([model.GetFrameByName(name).CalcPoseInWorld(context).GetAsMatrix4() for name in ("tip", "floor")])
    np.testing.assert_allclose(*poses, atol=1e-9)


def test_sticks_show_a_model_without_shapes(crane):
    """The mesh of the file is missing, so its collision shape is omitted, too."""
    root = compose_sdf(load_arm(crane).sdf)
    assert {shape.tag for shape in root.iterfind("model/link/*/geometry/*")} == {"capsule"}
    assert len(root.findall("model/link[visual]")) == len(root.findall("model/link"))
    assert root.find("model/link/collision") is None


def test_meshes_of_a_model_file_are_drawn_and_exported(tmp_path):
    (tmp_path / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    arm = load_arm(write_robot(tmp_path, ("package://crane_description/meshes/no_such_file.obj", "box.obj")))
    (uri,) = arm_sdf(arm).iter("uri")
    assert uri.text == f"file://{tmp_path / 'box.obj'}"
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 1e-3)
    add_arm(plant, arm)
    inspector = scene_graph.model_inspector()
    assert any(isinstance(inspector.GetShape(shape), Mesh) for shape in inspector.GetAllGeometryIds())
    write_model(arm, [], tmp_path / "own.urdf", "a test", format="urdf")
    assert (tmp_path / "own_meshes" / tmp_path.name / "box.obj").is_file()
    assert load_arm(tmp_path / "own.urdf").joint_names == arm.joint_names


def test_mjcf_is_read(tmp_path):
    path = write_robot(tmp_path, name="lever.xml", text=MJCF)
    arm, plant = load_arm(path), original_plant(path, MJCF)
    assert arm.joint_names == ("tilt", "slide")
    np.testing.assert_array_equal(arm.effort_limits, [30, 9])
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, [0.4, 0.1])
    tau_g = plant.CalcGravityGeneralizedForces(context)
    np.testing.assert_allclose(holding_torques(arm, np.array([[0.4, 0.1]]))[0], -tau_g, atol=1e-9)


def test_model_directives_and_sdf_are_read(crane, tmp_path):
    arm = load_arm(crane)
    write_model(arm, [], tmp_path / "own.sdf", "a test")
    (tmp_path / "package.xml").write_text("<package><name>here</name></package>")
    directives = tmp_path / "scene.dmd.yaml"
    directives.write_text(
        "directives:\n- add_model: {name: a, file: 'package://here/own.sdf'}\n"
        "- add_weld: {parent: world, child: a::base_link}\n"
    )
    poses = arm.sample_poses(3, np.random.default_rng(0))
    for path in (tmp_path / "own.sdf", directives):
        assert load_arm(path).joint_names == arm.joint_names
        np.testing.assert_allclose(holding_torques(load_arm(path), poses), holding_torques(arm, poses), atol=1e-9)


def test_massless_and_thin_links_get_an_inertia(tmp_path):
    hand = '<mass value="0.4"/>\n      <inertia ixx="0.0004" iyy="0.0008" izz="0.0007"'
    path = write_robot(tmp_path, (hand, hand.replace("0.0004", "0").replace("0.0008", "0").replace("0.0007", "0")))
    from dvrk_drake.dynamics.inertial_parameters import link_inertias

    for link in link_inertias(load_arm(path)):
        assert np.linalg.eigvalsh(link.pseudo_inertia()).min() > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([('type="continuous"', 'type="planar"'), ('"0.5"', '"0.5 0.5 0.5"')], "joint turn is of type planar"),
        ([('<child link="arm"/>', '<child link="missing"/>')], "Drake cannot read this model: .*missing"),
        ([("<mass ", "<no_mass ")], "no moving link has a mass"),
        ([('<mass value="0.4"', '<mass value="-0.4"')], "link hand: the mass is '-0.4'; allowed: a number"),
        ([('lower="-1.5" upper="2"', 'lower="0" upper="0"')], "joint swing: the position limits are 0, 0"),
        ([('effort="20"', 'effort="0"')], "joint swing needs a positive effort limit"),
        ([('<parent link="floor"/>', '<parent link="tip"/>')], "."),
        ([('<link name="tip"/>', '<link name="tip"/><link name="free"/>')], "no joint connects free to the rest"),
        ([("</robot>", "")], "invalid XML"),
        ([('name="lift"', 'name="turn"')], "turn"),
    ],
)
def test_unsuitable_model_is_refused_in_one_line(changes, message, tmp_path):
    path = write_robot(tmp_path, *changes)
    with pytest.raises(ArmError, match=message) as refusal:
        load_arm(path)
    assert str(refusal.value).startswith(str(path))
    assert "\n" not in str(refusal.value)


def test_impossible_inertia_is_replaced_with_a_warning(tmp_path):
    path = write_robot(tmp_path, ('ixx="0.0004"', 'ixx="0.1"'))
    with pytest.warns(UserWarning, match=r"crane\.urdf:43: the inertia is not physically consistent"):
        load_arm(path)


def test_other_files_are_refused(tmp_path):
    for name in ("robot.stl", "robot"):
        (tmp_path / name).write_text("solid")
        with pytest.raises(ArmError, match=r"is not the file of an arm; known arms: .*URDF"):
            load_arm(tmp_path / name)


def test_derived_arm_file_describes_the_same_arm(crane, tmp_path):
    path = tmp_path / "crane.yaml"
    path.write_text(derived_arm_file(crane, tmp_path))
    stated, derived = load_arm(path), load_arm(crane)
    assert stated.joint_names == derived.joint_names
    np.testing.assert_allclose(stated.position_upper, derived.position_upper, atol=1e-6)
    np.testing.assert_allclose(np.divide(stated.gains.kp, derived.gains.kp), 1.0, atol=0.01)
    text = path.read_text().replace("swing: [-1.5, 2.0]", "swing: [-1.0, 1.0]")
    path.write_text(f"{text}\nposition_offsets: {{swing: 0.5}}\n")
    changed = load_arm(path)
    # Limits are those of recorded positions.
    assert changed.position_upper[2] == 1.0
    poses = changed.sample_poses(3, np.random.default_rng(0))
    shifted = poses + np.array([0.0, 0.0, 0.5])
    np.testing.assert_allclose(holding_torques(changed, poses), holding_torques(derived, shifted), atol=1e-9)


def test_names_that_yaml_would_convert_are_quoted(tmp_path):
    path = write_robot(tmp_path, ('"swing"', '"on"'), name="7 axes.urdf")
    file = tmp_path / "robot.yaml"
    file.write_text(derived_arm_file(path, tmp_path))
    assert load_arm(file).joint_names == ("turn", "lift", "on")
