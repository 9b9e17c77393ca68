"""Shapes and bounding boxes of links."""

from __future__ import annotations

import dataclasses
import json
import re
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Role, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint

from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.dynamics.physical_consistency import BoundingBox, bounding_boxes, box_margins, reached_bounds
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.arm_schema import BoundingShapes, BoxCorners
from dvrk_drake.models.plant import add_arm, make_arm_plant, set_arm_positions
from dvrk_drake.models.sdf_model import MODELS_FOLDER, compose_sdf

pytestmark = pytest.mark.drake_api

SDF = MODELS_FOLDER / "sdf"
MESHES = sorted((SDF / "meshes").glob("*/*.gltf"))


def vertices(mesh):
    """Returns the vertices (n, 3) [m] of a mesh in the link frame with Z up."""
    document = json.loads(mesh.read_text())
    data = b64decode(document["buffers"][0]["uri"].partition(",")[2])
    parts = []
    for shape in document["meshes"]:
        accessor = document["accessors"][shape["primitives"][0]["attributes"]["POSITION"]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        parts.append(np.frombuffer(data, "<f4", 3 * accessor["count"], start).reshape(-1, 3))
    return np.concatenate(parts) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture(scope="module")
def plant():
    return make_arm_plant(load_arm("psm"))


@pytest.fixture(scope="module")
def psm_vertices():
    """Returns a mapping from each link of the PSM and its instrument to the vertices (n, 3) of its meshes [m]."""
    found = {}
    for link in compose_sdf(load_arm("psm").sdf).iter("link"):
        meshes = [Path(str(uri.text).replace("package://dvrk_drake", str(MODELS_FOLDER))) for uri in link.iter("uri")]
        found[link.get("name")] = np.concatenate([vertices(mesh) for mesh in meshes])
    return found


def test_every_mesh_is_used_and_small():
    named = {
        SDF.parent / match
        for sdf in SDF.glob("*.sdf")
        for match in re.findall(r"package://dvrk_drake/(.*?\.gltf)", sdf.read_text())
    }
    assert named == set(MESHES)
    for model in {mesh.parent for mesh in MESHES}:
        sizes = [mesh.stat().st_size for mesh in model.glob("*.gltf")]
        assert max(sizes) < 1e6
        assert sum(sizes) < 2.5e6


def test_psm_links_have_visual_and_collision_shapes():
    arm = load_arm("psm")
    plant, scene_graph = MultibodyPlant(1e-3), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instance = add_arm(plant, arm)
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    for index in plant.GetBodyIndices(instance):
        frame = plant.GetBodyFrameIdOrThrow(index)
        for role in (Role.kIllustration, Role.kProximity):
            assert inspector.NumGeometriesForFrameWithRole(frame, role) > 0, plant.get_body(index).name()


def test_both_links_of_a_pin_are_drawn_around_it(plant, psm_vertices):
    pins = []
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if isinstance(joint, RevoluteJoint) and joint.name() not in ("yaw", "roll"):  # shafts
            pins.append((joint.frame_on_parent(), joint.frame_on_child(), joint.revolute_axis()))
    for loop in load_arm("psm").loop_closures:
        pins.append((plant.GetFrameByName(loop.frame_a), plant.GetFrameByName(loop.frame_b), np.array([1.0, 0, 0])))
    assert len(pins) == 11
    for A, B, axis in pins:
        for frame in (A, B):
            drawn = psm_vertices[frame.body().name()] - frame.GetFixedPoseInBodyFrame().translation()
            assert (drawn.min(axis=0) < 0).all()
            assert (drawn.max(axis=0) > 0).all()
            assert (
                np.linalg.norm(np.cross(drawn, axis), axis=1).min() < 0.03
            )  # 26 mm: bolt circle of the largest bearing


def test_shaft_and_cannula_pass_through_the_remote_centre(plant, psm_vertices):
    arm, context = load_arm("psm"), plant.CreateDefaultContext()
    poses = np.random.default_rng(1).uniform(arm.position_lower, arm.position_upper, (50, 7))
    poses[:, 2] = np.maximum(poses[:, 2], 0.02)  # otherwise the wrist is inside the cannula
    for q in poses:
        set_arm_positions(plant, context, arm, q)
        for link in ("roll_link", "end_link"):
            X_LW = plant.GetBodyByName(link).EvalPoseInWorld(context).inverse()
            drawn, center = psm_vertices[link], X_LW.translation()
            assert (drawn.min(axis=0) < center).all()
            assert (drawn.max(axis=0) > center).all()
            around = np.linalg.norm((drawn - center)[:, :2], axis=1)
            assert around.min() < 0.007
    shaft = psm_vertices["roll_link"]
    assert np.linalg.norm(shaft[:, :2], axis=1).max() == pytest.approx(0.0042, abs=2e-4)


def test_instrument_adds_only_shapes_to_links_of_the_arm(tmp_path):
    instrument = tmp_path / "instrument.sdf"
    shape = "<geometry><sphere><radius>0.01</radius></sphere></geometry>"
    text = '<sdf version="1.9"><model name="i"><link name="insertion_link">{}</link></model></sdf>'
    instrument.write_text(text.format(f'<visual name="ball">{shape}</visual>'))
    before = compose_sdf([arm_sdf := "package://dvrk_drake/sdf/psm.sdf"])
    after = compose_sdf([arm_sdf, str(instrument)])
    assert len(list(after.iter("link"))) == len(list(before.iter("link")))
    assert len(list(after.iter("visual"))) == len(list(before.iter("visual"))) + 1
    instrument.write_text(text.format("<inertial><mass>1</mass></inertial>"))
    with pytest.raises(ArmError, match=r"insertion_link has <inertial> in two files; allowed: <visual>, <collision>"):
        compose_sdf([arm_sdf, str(instrument)])


# Tests the bounding boxes of links and their use as bounds of the mass distribution.


@pytest.mark.parametrize("name", known_arms())
def test_links_of_the_sdf_fit_their_boxes(name):
    arm = load_arm(name)
    boxes = bounding_boxes(arm)
    assert list(boxes) == [link.link for link in link_inertias(arm)]
    for link in link_inertias(arm):
        assert np.all(box_margins(link.parameters, boxes[link.link]) > 0.05), link.link


def test_box_encloses_collision_shapes_with_margin_of_its_file():
    boxes = bounding_boxes(load_arm("psm"))
    # The collision shape in psm.sdf is a box of 0.028 x 0.536 x 0.02 m about (0, 0.258, 0).
    np.testing.assert_allclose(boxes["bottom_bar_link"].lower, [-0.054, -0.05, -0.05], atol=1e-9)
    np.testing.assert_allclose(boxes["bottom_bar_link"].upper, [0.054, 0.566, 0.05], atol=1e-9)
    # The shaft of the instrument has a radius of 4.2 mm, and the margin of the instrument is 1 cm.
    assert boxes["roll_link"].half_width[0] == pytest.approx(0.0142, abs=2e-4)


def point_mass(mass, p):
    moments = np.sum(np.square(p)) - np.square(p)
    products = [-p[0] * p[1], -p[0] * p[2], -p[1] * p[2]]
    return mass * np.concatenate([[1.0], p, moments, products])


def test_margin_of_a_point_depends_on_distance_from_centre():
    """Checks that the margin is 1 - (d / w)^2 on each axis, with the distance d from the centre and the half width w.

    The margin of a body inside the box is positive.
    """
    box = BoundingBox(np.array([-0.1, 0.0, 0.2]), np.array([0.3, 0.2, 0.3]))
    p = np.array([0.2, 0.1, 0.32])
    expected = 1 - ((p - box.center) / box.half_width) ** 2
    np.testing.assert_allclose(box_margins(point_mass(0.7, p), box), expected, atol=1e-12)
    inside = np.random.default_rng(0).uniform(box.lower, box.upper, (20, 3))
    body = sum(point_mass(0.05, point) for point in inside)
    assert np.all(box_margins(body, box) >= 0)


def test_active_bounds_are_named():
    box = BoundingBox(np.full(3, -0.1), np.full(3, 0.1))
    nominal = LinkInertia("link", point_mass(1.0, np.zeros(3)))
    assert reached_bounds(nominal.parameters, nominal, box) == []
    assert reached_bounds(5 * nominal.parameters, nominal, box) == ["mass is 5 x the mass in the SDF"]
    far = point_mass(0.1, np.array([0.0, 0.1, 0.0]))
    assert reached_bounds(far, nominal, box) == [
        "mass is 0.1 x the mass in the SDF",
        "mass reaches its bounding box along y",
    ]


def with_shapes(arm, shapes):
    return dataclasses.replace(arm, identification=dataclasses.replace(arm.identification, bounding_shapes=(shapes,)))


def test_link_without_shapes_gets_a_box_around_its_inertia():
    arm = load_arm("mtmr")
    boxes = bounding_boxes(with_shapes(arm, BoundingShapes(margin=0.0)))
    link = next(link for link in link_inertias(arm) if link.link == "motor_4_link")
    # The solid box is the smallest box for which the second moments can be those of a body of uniform density.
    assert np.all(box_margins(link.parameters, boxes["motor_4_link"]) >= 2 / 3 - 1e-9)


def test_invalid_bounds_are_refused():
    arm = load_arm("mtmr")
    box = BoxCorners([0, 0, 0], [1, -1, 1])
    with pytest.raises(ArmError, match="lower and upper of crank_link must be three numbers each"):
        shapes = dataclasses.replace(arm.identification.bounding_shapes[0], boxes={"crank_link": box})
        bounding_boxes(with_shapes(arm, shapes))
    with pytest.raises(ArmError, match=r"boxes: .* has no link elbow"):
        shapes = dataclasses.replace(arm.identification.bounding_shapes[0], boxes={"elbow": box})
        bounding_boxes(with_shapes(arm, shapes))
