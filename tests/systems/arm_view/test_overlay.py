"""Overlay: ghost, efforts, frames, texts, recording, and drawing in a simulation."""

import gc
import threading

import numpy as np
import pytest
from forked import run_forked
from pydrake.math import RigidTransform

import dvrk_drake as dvrk
from dvrk_drake.errors import ArmError, DvrkDrakeError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant
from dvrk_drake.models.sdf_model import MODELS_FOLDER
from dvrk_drake.systems.arm_view import page
from dvrk_drake.systems.arm_view.camera import Camera
from dvrk_drake.systems.arm_view.efforts import LEVELS, share_color
from dvrk_drake.systems.arm_view.joints import ArmJoints
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import page_html, start_meshcat
from dvrk_drake.systems.arm_view.text import image_mesh, text_image

pytestmark = pytest.mark.drake_api

HOME = {"mtml": np.zeros(7), "psm": np.array([0, 0, 0.1, 0, 0, 0, 0])}


class Recorder:
    """Meshcat that counts messages by method."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *args, **kwargs: self.calls.append((name, *args)) if name != "GetTrackedCameraPose" else None


@pytest.mark.parametrize("views", [1, 3])
def test_view_is_not_destroyed_in_another_thread(views, monkeypatch):
    """Drake ends the process there, e.g. when a thread of Dask collects garbage. This thread destroys old views."""
    monkeypatch.setattr(page, "MAX_VIEWS", 2)

    def check():
        gc.disable()
        for _ in range(views):
            cycle = {"view": start_meshcat()}
            cycle["itself"] = cycle
        del cycle
        thread = threading.Thread(target=gc.collect)
        thread.start()
        thread.join()
        assert len(page._VIEWS) == min(views, 2)

    monkeypatch.setattr(page, "_VIEWS", [])
    run_forked(check)


def transforms(meshcat, part):
    return [call for call in meshcat.calls if call[0] == "SetTransform" and part in call[1]]


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_effort_share_selects_the_nearest_arc(name):
    arm = load_arm(name)
    overlay = ArmOverlay(arm, start_meshcat())
    share = np.array([0.0, 0.009, 0.04, -0.33, 1.7, -2.0, np.nan])
    overlay.draw(HOME[name], effort=share * arm.effort_limits)
    np.testing.assert_allclose(overlay._efforts.shares, [0, 0, 0.05, -0.3, 1, -1, 0], rtol=0, atol=1e-12)
    assert np.all(np.diff(LEVELS) > 0)


def test_arc_points_in_the_direction_of_the_effort():
    """The axis of an arc is that of the joint in the plant, so a positive effort turns counterclockwise about it."""
    for name in ("mtmr", "psm"):
        arm, plant = load_arm(name), shared_plant(load_arm(name))
        (q,) = arm.sample_poses(1, np.random.default_rng(0))
        joints = ArmJoints(arm)
        joints.set_positions(q)
        context = plant.CreateDefaultContext()
        set_arm_positions(plant, context, arm, q)
        for joint_name, X_BJ, slides in zip(arm.joint_names, joints.axis_frames(), arm.prismatic, strict=True):
            joint = plant.GetJointByName(joint_name)
            v = np.zeros(plant.num_velocities())
            v[joint.velocity_start()] = 1.0
            plant.SetVelocities(context, v)
            V = joint.child_body().EvalSpatialVelocityInWorld(context)
            V_parent = joint.parent_body().EvalSpatialVelocityInWorld(context)
            axis = (V.translational() - V_parent.translational()) if slides else V.rotational() - V_parent.rotational()
            np.testing.assert_allclose(X_BJ.rotation().col(2), axis, rtol=0, atol=1e-9)


def test_frames_are_those_of_the_dvrk():
    assert ArmJoints(load_arm("mtml")).frame_names == [f"dh_{i}" for i in range(8)]
    assert ArmJoints(load_arm("psm")).frame_names == [f"dh_{i}" for i in range(7)]


def test_ghost_links_at_the_place_of_the_arm_are_hidden():
    arm = load_arm("mtml")
    overlay = ArmOverlay(arm, start_meshcat())
    q = np.zeros(7)
    q[2] = 0.2
    overlay.draw(np.zeros(7), desired=q)
    visible = overlay._scene._visible
    assert not visible["ghost/desired/upper_arm_link"]  # not moved by the elbow
    assert visible["ghost/desired/forearm_link"]
    overlay.draw(np.zeros(7), desired=np.zeros(7))
    assert not visible["ghost/desired/forearm_link"]
    with pytest.raises(DvrkDrakeError, match="unknown ghost other; known: desired"):
        overlay.draw(q, ghosts={"other": q})


def test_only_changes_are_sent_without_recording():
    meshcat, arm = Recorder(), load_arm("psm")
    overlay = ArmOverlay(arm, meshcat)
    overlay.draw(HOME["psm"])
    meshcat.calls.clear()
    overlay.draw(HOME["psm"])
    assert transforms(meshcat, "frames") == []
    overlay.draw(HOME["psm"], time=0.5)
    assert len(transforms(meshcat, "frames")) == 7  # a recording interpolates between samples


def test_recording_stores_the_visibility_before_a_change():
    """An animation uses its first value also for earlier times, so it requires a value at time 0."""
    meshcat, arm = Recorder(), load_arm("mtml")
    overlay = ArmOverlay(arm, meshcat)
    overlay.set_phase("held", 0.0)
    overlay.draw(np.zeros(7), effort=np.zeros(7), time=0.0)
    overlay.set_phase("released", 1.0)
    overlay.draw(np.zeros(7), effort=0.5 * arm.effort_limits, time=1.0)
    changes = {}
    for method, path, *change in meshcat.calls:
        if method == "SetProperty" and len(change) == 3 and change[2] is not None:
            changes.setdefault(path.removeprefix("mtml/overlay/"), []).append((change[2], change[1]))
    assert changes["phase/1"] == [(0.0, False), (0.0, True), (1.0, False)]
    assert changes["phase/2"] == [(0.0, False), (1.0, True)]
    assert changes["efforts/elbow_pitch/8"] == [(0.0, False), (1.0, True)]


def test_saved_page_has_a_title():
    assert "<title>MTML &amp; &lt;co&gt;</title>" in page_html(start_meshcat(), "MTML & <co>")


def test_close_ups_come_from_the_arm_file():
    assert ArmOverlay(load_arm("mtmr"), start_meshcat()).camera_presets == ("whole arm", "gimbal")
    assert ArmOverlay(load_arm("psm"), start_meshcat()).camera_presets == ("whole arm", "instrument")


def test_text_follows_the_camera():
    arm = load_arm("mtml")
    meshcat = Recorder()
    X_WB = RigidTransform([0.3, 0.2, 0.1])
    overlay = ArmOverlay(arm, meshcat, X_WB=X_WB)
    overlay.set_title("MTML")
    camera = Camera.looking_at([3.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    overlay.captions.set_camera(camera)
    matrix = transforms(meshcat, "title")[-1][2]
    u, _, depth = camera.place(X_WB @ matrix[:3, 3])
    assert u == pytest.approx(0, abs=1e-9)
    assert 0 < depth < camera.distance
    towards_camera = -matrix[:3, 1] / np.linalg.norm(matrix[:3, 1])
    np.testing.assert_allclose(towards_camera, camera.X_WC.rotation().col(2), rtol=0, atol=1e-9)


def test_images():
    image = text_image("q1\nouter_yaw")
    assert image.height > text_image("q1").height
    meshcat = start_meshcat()
    meshcat.SetObject("text", image_mesh(image, 0.1))
    assert meshcat.HasPath("/drake/text")
    assert share_color(0.0)[2] > share_color(1.0)[2]  # blue to red


def test_drawing_does_not_change_a_simulation():
    arm = load_arm("mtml")
    meshcat = start_meshcat(arm)
    options = {"effects": False, "duration": 0.2, "targets": [(0.1, [0, 0.1, 0, 0, 0, 0, 0])]}
    drawn = dvrk.simulate(arm, meshcat=meshcat, **options)
    np.testing.assert_allclose(drawn.recording.q, dvrk.simulate(arm, **options).recording.q, rtol=0, atol=1e-12)
    for part in ("ghost/desired/forearm_link", "efforts/elbow_pitch", "phase/1", "title"):
        assert meshcat.HasPath(f"/drake/mtml/overlay/{part}")


def test_unknown_frames_in_the_arm_file_are_refused(tmp_path):
    mechanism = (
        (MODELS_FOLDER / "mechanisms/psm.yaml").read_text().replace("remote_center: dh_0", "remote_center: dh_x")
    )
    (tmp_path / "mechanism.yaml").write_text(mechanism)
    arm = (MODELS_FOLDER / "arms/psm.yaml").read_text().replace("mechanism: psm", "mechanism: mechanism.yaml")
    (tmp_path / "arm.yaml").write_text(arm)
    with pytest.raises(ArmError, match=r"frames\.remote_center: the SDF has no frame dh_x"):
        load_arm(tmp_path / "arm.yaml")
