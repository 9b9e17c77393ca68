"""Tests that exported SDF and URDF files have the given inertial parameters and equations of motion."""

import base64
import dataclasses
import json
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from command_output import assert_refused
from pydrake.geometry import Mesh
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.cli import main
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias, parameters_from_pseudo_inertia
from dvrk_drake.dynamics.model_links import nearest_links
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.export.gravity_sources import c_identifier
from dvrk_drake.export.model_writer import changed_links, to_obj, to_text, with_inertias, write_model
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import arm_sdf, make_arm_plant, set_arm_positions, tree_selector
from dvrk_drake.models.sdf_model import MODELS_FOLDER, compose_sdf
from dvrk_drake.models.urdf import to_urdf

pytestmark = pytest.mark.drake_api


def perturbed(arm: Arm, seed: int = 0) -> tuple[LinkInertia, ...]:
    """Returns consistent links that differ from the SDF, by a random linear map of each pseudo-inertia."""
    generator = np.random.default_rng(seed)
    links = []
    for link in link_inertias(arm):
        X = np.eye(4) + 0.1 * generator.normal(size=(4, 4))
        links.append(LinkInertia(link.link, parameters_from_pseudo_inertia(X @ link.pseudo_inertia() @ X.T)))
    return tuple(links)


def inverse_dynamics(plant: MultibodyPlant, arm: Arm, motion) -> np.ndarray:
    """Returns Drake's inverse dynamics (m, n), projected through the linkage."""
    context = plant.CreateDefaultContext()
    index = tree_selector(plant, arm)
    tau = []
    for q, v, vd in zip(*motion, strict=True):
        set_arm_positions(plant, context, arm, q)
        v_tree, vd_tree = np.zeros((2, plant.num_velocities()))
        v_tree[index], vd_tree[index] = arm.linkage.velocity(v), arm.linkage.velocity(vd)
        plant.SetVelocities(context, v_tree)
        forces = plant.CalcGravityGeneralizedForces(context)
        tau_tree = plant.CalcInverseDynamics(context, vd_tree, MultibodyForces(plant)) - forces
        tau.append(arm.linkage.pull_back_effort(tau_tree[index]))
    return np.array(tau)


def motion_of(arm: Arm, count: int = 50):
    generator = np.random.default_rng(1)
    q = arm.sample_poses(count, generator)
    return q, generator.normal(size=q.shape), 5 * generator.normal(size=q.shape)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_sdf_has_the_given_inertial_parameters(name, tmp_path):
    arm, path = load_arm(name), tmp_path / "identified.sdf"
    links = perturbed(arm)
    write_model(arm, links, path, "a test")
    exported = dataclasses.replace(arm, sdf=(str(path),))
    motion = motion_of(arm)
    actual = inverse_dynamics(make_arm_plant(exported), exported, motion)
    # Compute the expected torque from the regressor of the original arm.
    regressor = DynamicRegressor(arm)
    parameters = regressor.values.copy()
    by_name = {link.link: link.parameters for link in links}
    for i, link in enumerate(regressor.links):
        parameters[10 * i : 10 * i + 10] = by_name[link.link]
    expected = regressor.torque(*motion, parameters)
    scale = np.abs(expected).max(axis=0)
    assert np.abs((actual - expected) / scale).max() < 1e-12
    assert np.abs((expected - regressor.torque(*motion, regressor.values)) / scale).max() > 0.05
    for before, after in zip(links, link_inertias(exported), strict=True):
        assert before.link == after.link
        np.testing.assert_allclose(after.parameters, before.parameters, rtol=0, atol=1e-13)


def parse(path):
    """Returns plant, scene graph and model instance of a file, parsed strictly and without packages."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    parser = Parser(plant)
    parser.SetStrictParsing()
    (instance,) = parser.AddModels(str(path))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link", instance))
    plant.Finalize()
    return plant, scene_graph, instance


@pytest.mark.parametrize("name", ["mtmr", "psm"])
def test_parser_without_packages_loads_model_and_meshes(name, tmp_path):
    arm = load_arm(name)
    (tmp_path / "first").mkdir()
    write_model(arm, perturbed(arm), tmp_path / "first" / "arm.sdf", "a test")
    path = (tmp_path / "first").rename(tmp_path / "moved") / "arm.sdf"
    plant, scene_graph, instance = parse(path)
    assert plant.num_positions() == make_arm_plant(arm).num_positions()
    inspector = scene_graph.model_inspector()
    shapes = [
        inspector.GetShape(geometry)
        for body in plant.GetBodyIndices(instance)
        for geometry in plant.GetVisualGeometriesForBody(plant.get_body(body))
    ]
    meshes = [shape.source().path() for shape in shapes]
    assert len(meshes) >= 10
    assert all(mesh.is_relative_to(path.parent) and mesh.is_file() for mesh in meshes)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_urdf_has_the_equations_of_motion_of_the_sdf(name, tmp_path):
    arm, path = load_arm(name), tmp_path / "arm.urdf"
    links = perturbed(arm)
    write_model(arm, links, path, "a test", format="urdf")
    write_model(arm, links, tmp_path / "arm.sdf", "a test")
    exported = dataclasses.replace(arm, sdf=(str(tmp_path / "arm.sdf"),))
    sdf_plant, (urdf_plant, scene_graph, _) = make_arm_plant(exported), parse(path)
    motion = motion_of(arm)
    expected = inverse_dynamics(sdf_plant, arm, motion)
    actual = inverse_dynamics(urdf_plant, arm, motion)
    assert np.abs((actual - expected) / np.abs(expected).max(axis=0)).max() < 1e-12
    # Constraints, actuators, limits and frames are equal.
    assert urdf_plant.num_constraints() == sdf_plant.num_constraints() > 0
    assert urdf_plant.num_actuators() == sdf_plant.num_actuators() == arm.num_joints
    contexts = [plant.CreateDefaultContext() for plant in (sdf_plant, urdf_plant)]
    for plant, context in zip((sdf_plant, urdf_plant), contexts, strict=True):
        set_arm_positions(plant, context, arm, motion[0][0])
    for i, joint_name in enumerate(arm.joint_names):
        joint = urdf_plant.GetJointByName(joint_name)
        assert (joint.position_lower_limits()[0], joint.position_upper_limits()[0]) == pytest.approx(
            (arm.position_lower[i], arm.position_upper[i]), abs=1e-12
        )
        assert urdf_plant.GetJointActuatorByName(joint_name).effort_limit() == arm.effort_limits[i]
    root = compose_sdf(arm.sdf)
    names = [part.get("name") for tag in ("link", "frame") for part in root.iterfind(f"model/{tag}")]
    assert "dh_1" in names
    for frame in names:
        poses = [
            plant.GetFrameByName(frame).CalcPoseInWorld(context).GetAsMatrix4()
            for plant, context in zip((sdf_plant, urdf_plant), contexts, strict=True)
        ]
        np.testing.assert_allclose(poses[1], poses[0], rtol=0, atol=1e-12)
    inspector = scene_graph.model_inspector()
    assert len(inspector.GetCollisionCandidates()) == 0  # Collisions between links are filtered as in the SDF.


def test_rejects_an_sdf_that_urdf_does_not_support(tmp_path):
    arm = load_arm("mtml")
    root = arm_sdf(arm)
    next(root.iter("cylinder")).tag = "ellipsoid"
    assert_refused(ModelError, "link base_link, collision housing: URDF does not support the shape ell", to_urdf, root)


def test_only_changed_inertias_are_rewritten():
    arm = load_arm("mtml")
    links = link_inertias(arm)
    assert changed_links(arm, links) == []
    heavier = [
        LinkInertia(link.link, link.parameters * (2.0 if link.link == "forearm_link" else 1.0)) for link in links
    ]
    assert [c.link for c in changed_links(arm, heavier)] == ["forearm_link"]
    texts = (to_text(with_inertias(arm, given)).splitlines() for given in (links, heavier))
    changed = [pair for pair in zip(*texts, strict=True) if pair[0] != pair[1]]
    before = next(link for link in links if link.link == "forearm_link").parameters[0]
    assert [line.strip() for line in changed[0]] == [f"<mass>{before:g}</mass>", f"<mass>{2 * before:g}</mass>"]
    assert all(re.match(r" +<(mass|i[xyz]{2})>", line) for pair in changed for line in pair) and len(changed) <= 7


def test_no_model_is_written_if_meshes_cannot_be_copied(tmp_path, capsys):
    (tmp_path / "arm_meshes").write_text("in the way")
    assert main(["export", "--arm", "mtml", "--sdf", str(tmp_path / "arm.sdf")]) == 2
    assert "arm_meshes" in capsys.readouterr().err and not (tmp_path / "arm.sdf").exists()
    write_model(load_arm("mtml"), [], tmp_path / "other.sdf", "a test")
    (tmp_path / "other_meshes" / "mtm" / "base_link.gltf").unlink()
    incomplete = dataclasses.replace(load_arm("mtml"), sdf=(str(tmp_path / "other.sdf"),))
    with pytest.raises(ArmError, match=r"base_link\.gltf' which does not exist"):
        write_model(incomplete, [], tmp_path / "again.sdf", "a test")


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_an_arm_file_can_refer_to_the_exported_sdf(name, tmp_path, capsys):
    """Follows the instructions of docs/export.md."""
    arm = load_arm(name)
    # `export --sdf` writes these links for a static model.
    links = nearest_links(arm, 1.1 * derive_gravity(arm).base_values)
    write_model(arm, links, tmp_path / "identified.sdf", "a test")
    text = (MODELS_FOLDER / "arms" / f"{name}.yaml").read_text()
    instrument = (MODELS_FOLDER / "instruments" / "large_needle_driver.yaml").read_text()
    (tmp_path / "own.yaml").write_text(re.sub("^sdf: .*$", "", instrument, flags=re.MULTILINE))
    text = re.sub("^sdf: .*$", "", text, flags=re.MULTILINE).replace("large_needle_driver", "own.yaml")
    (tmp_path / "arm.yaml").write_text(text + "sdf: identified.sdf\n")
    own = load_arm(str(tmp_path / "arm.yaml"))
    assert main(["export", "--arm", str(tmp_path / "arm.yaml"), "--sdf", str(tmp_path / "again.sdf")]) == 0
    assert "The SDF has the same inertias as the SDF of the arm." in capsys.readouterr().out
    assert own.joint_names == arm.joint_names and own.sdf == (str(tmp_path / "identified.sdf"),)
    np.testing.assert_allclose(own.transmission.matrix, arm.transmission.matrix, rtol=0, atol=1e-12)
    np.testing.assert_allclose(derive_gravity(own).base_values, 1.1 * derive_gravity(arm).base_values, atol=1e-12)


def test_rejects_invalid_inertias_and_unknown_links(tmp_path):
    arm, path = load_arm("mtml"), tmp_path / "arm.sdf"
    link = link_inertias(arm)[0]
    for parameters, message in (
        (link.parameters * np.r_[-1, np.ones(9)], "not physically consistent"),
        (link.parameters * np.r_[1, np.ones(3), 0.01, np.ones(5)], "not physically consistent"),
    ):
        assert_refused(ModelError, message, write_model, arm, [LinkInertia(link.link, parameters)], path, "a test")
    with pytest.raises(ModelError, match="no moving link tail"):
        write_model(arm, [LinkInertia("tail", link.parameters)], path, "a test")
    with pytest.raises(ModelError, match="rotor inertia -1 must not be negative"):
        write_model(arm, [], path, "a test", {"outer_yaw": -1.0})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("pose", "axis"),
    [
        ('<pose degrees="1">.1 .2 .3 10 20 30</pose>', "<xyz>0 1 0</xyz>"),
        ('<pose degrees="TRUE">.1 .2 .3 10 20 30</pose>', "<xyz>0 1 0</xyz>"),
        ('<pose rotation_format="quat_xyzw">.1 .2 .3 .1 .2 .3 .9273618495495703</pose>', "<xyz>0 1 0</xyz>"),
        ("<pose>.1 .2 .3 .4 .5 .6</pose>", '<xyz expressed_in="__model__">0 0 1</xyz>'),
        ("<pose>.1 .2 .3 .4 .5 .6</pose>", '<xyz expressed_in="base_link">0.6 0 0.8</xyz>'),
        ("<pose>.1 .2 .3 .4 .5 .6</pose>", '<xyz expressed_in="two">0 0 1</xyz>'),
    ],
)
def test_poses_and_axes_of_the_urdf_are_those_that_drake_reads(pose, axis, tmp_path):
    model = (
        f'<link name="base_link"><pose>0 0 .5 .7 0 0</pose></link><link name="b">{pose}<inertial>{pose}<mass>2</mass>'
        "<inertia><ixx>.1</ixx><iyy>.1</iyy><izz>.1</izz></inertia></inertial></link>"
        f'<joint name="two" type="revolute"><parent>base_link</parent><child>b</child><axis>{axis}<limit><lower>-1'
        "</lower><upper>1</upper><effort>9</effort></limit></axis></joint>"
        f'<frame name="f" attached_to="b">{pose}</frame>'
    )
    results = []
    for kind in ("sdf", "urdf"):
        text = f'<sdf version="1.9"><model name="m">{model}</model></sdf>'
        if kind == "urdf":
            (tmp_path / "own.sdf").write_text(text)
            robot = to_urdf(arm_sdf(load_arm(tmp_path / "own.sdf")))
            text = ElementTree.tostring(robot, encoding="unicode")
        plant = MultibodyPlant(0.0)
        Parser(plant).AddModelsFromString(text, kind)
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
        plant.Finalize()
        context = plant.CreateDefaultContext()
        plant.GetJointByName("two").set_angle(context, 0.8)
        poses = [plant.GetFrameByName(name).CalcPoseInWorld(context).GetAsMatrix34() for name in ("b", "f")]
        center = plant.GetBodyByName("b").CalcCenterOfMassInBodyFrame(context)
        results.append(np.hstack([*poses, center[:, None]]))
    np.testing.assert_allclose(results[1], results[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_urdf_has_no_link_without_mass_and_is_an_arm(name, tmp_path):
    """libsdformat (Gazebo) removes links without mass."""
    arm, path = load_arm(name), tmp_path / "arm.urdf"
    write_model(arm, [], path, "a test", format="urdf")
    robot = ElementTree.parse(path).getroot()
    masses = [link.find("inertial/mass") for link in robot.findall("link")]
    assert all(mass is not None and float(mass.get("value")) > 0 for mass in masses)
    assert load_arm(path).joint_names == arm.joint_names


def test_obj_meshes_have_the_shape_of_the_gltf_meshes(tmp_path):
    arm = load_arm("mtmr")
    write_model(arm, [], tmp_path / "arm.urdf", "a test", meshes="obj", format="urdf")
    copies = sorted(tmp_path.rglob("*.obj"))
    assert len(copies) == 10 and not list(tmp_path.rglob("*.gltf"))
    for copy in copies[:2]:
        (source,) = (MODELS_FOLDER / "sdf" / "meshes" / "mtm").glob(f"{copy.stem}.gltf")
        hulls = [Mesh(str(path)).GetConvexHull() for path in (source, copy)]
        corners = [np.array([hull.vertex(i) for i in range(hull.num_vertices())]) for hull in hulls]
        for bound in (np.min, np.max):
            np.testing.assert_allclose(bound(corners[1], axis=0), bound(corners[0], axis=0), rtol=0, atol=1e-6)


def gltf(tmp_path, **changes):
    """Writes a glTF file with one triangle, whose node has a parent."""
    points, corners = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], "<f4"), np.array([0, 1, 2], "<u2")
    data = base64.b64encode(points.tobytes() + corners.tobytes()).decode()
    content = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"translation": [0, 0, 5], "children": [1]},
            {"mesh": 0, "scale": [1, 1, 2], "rotation": [1, 0, 0, 0]},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
        "buffers": [{"uri": f"data:application/octet-stream;base64,{data}", "byteLength": 42}],
    }
    path = tmp_path / "mesh.gltf"
    path.write_text(json.dumps(content | changes))
    return path


def test_gltf_nodes_are_transformed(tmp_path):
    """The rotation by 180 deg about x negates y. The y axis of glTF is the z axis of OBJ."""
    assert to_obj(gltf(tmp_path)) == "v 0 -5 0\nv 1 -5 0\nv 0 -5 -2\nf 1 2 3\n"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]}]}, "primitives other than triangles"),
        ({"nodes": [{"children": [0]}]}, "not a glTF file that can be converted to OBJ"),
        ({"buffers": [{"uri": "data:;base64,AAAA"}]}, "not a glTF file that can be converted to OBJ"),
        ({"buffers": [{"uri": "../other.bin"}]}, "outside the folder of the mesh"),
    ],
)
def test_gltf_that_cannot_be_converted_is_refused(changes, message, tmp_path):
    assert_refused(ArmError, message, to_obj, gltf(tmp_path, **changes))


@pytest.mark.parametrize("origin", ["a---b", "a--b", "-----", "b-"])
def test_comment_of_a_file_is_well_formed(origin):
    assert ElementTree.fromstring(to_text(ElementTree.Element("robot"), f"model {origin}")).tag == "robot"


def test_names_of_arms_are_valid_in_source_code():
    names = ["MTML", "PSM-1", "2nd arm", "", "b\u00e4r", "_"]
    assert [c_identifier(name) for name in names] == ["mtml", "psm_1", "arm_2nd_arm", "arm_", "b_r", "arm__"]
