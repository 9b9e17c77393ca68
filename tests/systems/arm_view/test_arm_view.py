"""Interactive view of an arm: linkage, sliders at the coupled limit, buttons, and the live view."""

import gc
import math
import threading

import numpy as np
import pytest
from arm_copies import copy_arm
from command_output import assert_refused
from forked import run_forked

import dvrk_drake as dvrk
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ArmError, ControllerError, DvrkDrakeError
from dvrk_drake.lcmtypes import lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant
from dvrk_drake.processes.live_view import LiveForce, show_status
from dvrk_drake.systems.arm_view import page
from dvrk_drake.systems.arm_view.arm_view import DEGREES, FRAMES, ArmView
from dvrk_drake.systems.arm_view.drawn_arm import Visibility
from dvrk_drake.systems.arm_view.efforts import LEVELS, axis_frames
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import (
    ASPECT,
    HALF_HEIGHT,
    REPORT_ASPECT,
    corners_at,
    framing,
    geometry_corners,
    start_meshcat,
)

pytestmark = pytest.mark.drake_api


@pytest.fixture(scope="module")
def view():
    view = ArmView(load_arm("mtml"), start_meshcat())
    view.add_sliders()
    return view


def test_dependent_joints_follow(view):
    view.show([0.1, 0.3, -0.2, 0.4, 0.5, 0.3, 0.2])
    plant, context = view._links.plant, view._links.context
    (loop,) = view.arm.loop_closures
    gap = plant.GetFrameByName(loop.frame_a).CalcPose(context, plant.GetFrameByName(loop.frame_b)).translation()
    assert np.linalg.norm(gap) < 1e-12
    assert plant.GetJointByName("motor_4").get_angle(context) == pytest.approx(0.6697 * -0.2)


def test_sliders_stop_at_the_coupled_limit(view):
    for i, name in enumerate(view.arm.joint_names):
        view.meshcat.SetSliderValue(f"q{i + 1} [rad] {name}", 0.0)
    view.follow_controls()
    view.meshcat.SetSliderValue("q2 [rad] shoulder_pitch", 0.6)
    q = view.follow_controls()
    assert q[1] == pytest.approx(0.6, abs=2e-3)
    view.meshcat.SetSliderValue("q3 [rad] elbow_pitch", 0.6)
    q = view.follow_controls()
    assert q[1] + q[2] <= 0.68 + 2e-3
    assert q[1] + q[2] > 0.6
    assert view.meshcat.GetSliderValue("q3 [rad] elbow_pitch") == pytest.approx(q[2])


def test_other_sliders_move_at_the_coupled_limit(view):
    """Regression: at the stop of the parallelogram, a division by zero reset every slider."""
    q = np.zeros(7)
    q[1:3] = 0.4, 0.28033  # a step of a slider beyond the limit
    view._sliders.set_positions(q)
    view.follow_controls()
    with np.errstate(all="raise"):
        for wanted in (0.2, 0.4):
            view.meshcat.SetSliderValue("q1 [rad] outer_yaw", wanted)
            view.meshcat.SetSliderValue("q3 [rad] elbow_pitch", 0.6)
            q = view.follow_controls()
            assert q[0] == pytest.approx(wanted, abs=2e-3)
            assert 0.67 < q[1] + q[2] < 0.685
    assert view._sliders.stopped_by == "stop: parallelogram -0.33 to 0.68 rad"
    view.meshcat.SetSliderValue("q3 [rad] elbow_pitch", 0.1)
    assert view.follow_controls()[2] == pytest.approx(0.1, abs=2e-3)
    assert view._sliders.stopped_by == ""


def test_switches_and_camera_positions(view):
    view.add_view_buttons()
    assert view.camera_presets == ("whole arm", "gimbal")
    for value in (1.0, 0.0):
        view.meshcat.SetSliderValue(FRAMES, value)
        view.follow_controls()
        assert view.meshcat.HasPath("/drake/mtml/frames/mtml") == bool(value)
    view.meshcat.SetSliderValue(DEGREES, 1.0)
    np.testing.assert_allclose(view.follow_controls(), view._q, rtol=0, atol=1e-12)
    assert view._sliders.names[1] == "q2 [deg] shoulder_pitch"
    view.meshcat.SetSliderValue(DEGREES, 0.0)
    view.follow_controls()
    view.meshcat.SetSliderValue("q5 [rad] wrist_pitch", 0.2)
    view.follow_controls()
    assert view.meshcat.GetButtonClicks(view._describe(4)) == 0, "the control panel shows name and range"


def test_psm_sliders_move_joints_and_linkage():
    view = ArmView(load_arm("psm"), start_meshcat())
    view.add_sliders()
    assert view._sliders.names == [
        "q1 [rad] yaw",
        "q2 [rad] pitch",
        "q3 [m] insertion",
        "q4 [rad] roll",
        "q5 [rad] wrist_pitch",
        "q6 [rad] wrist_yaw",
        "q7 [rad] jaw",
    ]
    assert view._q[2] == pytest.approx(0.1), "the instrument is visible"
    wanted = [-0.7, 0.6, 0.15, 2.0, -0.5, 0.8, 0.9]
    for name, value in zip(view._sliders.names, wanted, strict=True):
        view.meshcat.SetSliderValue(name, value)
    np.testing.assert_allclose(view.follow_controls(), wanted, atol=6e-3)  # a slider has steps of 1/1000 of its range
    plant, context = view._links.plant, view._links.context
    for loop in view.arm.loop_closures:
        A, B = plant.GetFrameByName(loop.frame_a), plant.GetFrameByName(loop.frame_b)
        assert np.linalg.norm(A.CalcPose(context, B).translation()) < 1e-12
    q = view._q
    assert plant.GetJointByName("pitch").get_angle(context) == q[1]
    assert plant.GetJointByName("top_bar").get_angle(context) == pytest.approx(-q[1])
    assert plant.GetJointByName("counterweight").get_translation(context) == pytest.approx(q[2])


class Link:
    """Returns statuses like an ArmLink, one after the other; None for no status."""

    def __init__(self, *positions):
        self.positions = list(positions)

    def next_status(self, seconds):
        position = self.positions.pop(0)
        if position is None:
            raise ControllerError("no status")
        status = lcmt_dvrk_status()
        status.position = position
        status.position_commanded = [1.1 * q for q in position]
        status.effort_measured = [0.5 * limit for limit in load_arm("mtml").effort_limits]
        return status


def test_live_view_draws_the_last_status():
    arm = load_arm("mtml")
    view, pose = ArmView(arm, start_meshcat()), [0.1, 0.2, 0.0, 0.0, 0.5, 0.0, 0.0]
    link, force = Link(pose, None, [math.nan] * 7), LiveForce(arm, "memq://")
    for _ in range(3):
        show_status(view, link, force)
        np.testing.assert_array_equal(view._q, pose)  # last drawn pose
    np.testing.assert_array_equal(view.overlay._efforts.shares, 0.5)
    assert view.meshcat.HasPath("/drake/mtml/overlay/ghost/desired/mtml/forearm_link")


def test_live_force_is_drawn_in_the_base_frame_while_it_is_valid():
    arm, q = load_arm("psm"), [0.2, -0.3, 0.1, 0.5, 0.2, -0.3, 0.3]
    message, status = lcmt_dvrk_force(), lcmt_dvrk_status()
    message.arm_name, message.frame_name, message.utime, message.session_id = arm.name, "dh_4", 10**6, 3
    message.force, message.force_covariance = [1.0, math.nan, 2.0], np.diag([0.1, 50.0, 0.2]).tolist()
    status.position, status.utime, status.session_id = q, 10**6 + 50_000, 3
    live = LiveForce(arm, "memq://")
    assert live.at(status) is None
    live.receive(message.encode())
    X_BF, drawn = ArmFrame(arm, "dh_4").pose(q), live.at(status)
    np.testing.assert_allclose(drawn.point, X_BF.translation(), atol=1e-12)
    np.testing.assert_allclose(drawn.force, X_BF.rotation() @ [1.0, 0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(drawn.covariance), [0.1, 0.2, 50.0], atol=1e-9)
    message.frame_name, message.force = "unknown", [9.0, 9.0, 9.0]
    live.receive(message.encode())
    np.testing.assert_allclose(live.at(status).force, drawn.force, atol=0.0)
    for change in ({"utime": 2 * 10**6}, {"session_id": 4}):
        later = lcmt_dvrk_status()
        later.position, later.utime, later.session_id = q, status.utime, status.session_id
        for name, value in change.items():
            setattr(later, name, value)
        assert live.at(later) is None


# Camera positions: the arm fills the view, and close-ups show only their links.


@pytest.mark.parametrize("aspect", [ASPECT, REPORT_ASPECT])
@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_camera_frames_the_whole_arm(name, aspect):
    corners = geometry_corners(load_arm(name))
    camera, target = framing(corners, aspect)
    forward = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    seen = corners - camera
    half_height = HALF_HEIGHT * (seen @ forward)
    share = np.maximum(np.abs(seen @ right) / aspect, np.abs(seen @ np.cross(right, forward))) / half_height
    assert (half_height > 0).all()
    assert 0.8 < share.max() < 1.0


def test_close_up_is_nearer_than_the_whole_arm():
    for name in ("mtmr", "psm"):
        arm = load_arm(name)
        camera, target = framing(geometry_corners(arm))
        q = np.clip(np.zeros(7), arm.position_lower, arm.position_upper)
        for links in arm.view.close_ups.values():
            near, near_target = framing(corners_at(arm, q, tuple(links)))
            assert np.linalg.norm(near - near_target) < 0.6 * np.linalg.norm(camera - target)


# Overlay: ghost, efforts, texts, recording, and drawing in a simulation.


HOME = {"mtml": np.zeros(7), "psm": np.array([0, 0, 0.1, 0, 0, 0, 0])}


@pytest.mark.parametrize("views", [1, 3])
def test_view_is_not_destroyed_in_another_thread(views, monkeypatch):
    """Drake ends the process there, e.g. when another thread collects garbage. This thread destroys old views."""
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
        context = plant.CreateDefaultContext()
        set_arm_positions(plant, context, arm, q)
        poses = axis_frames(arm, plant, context)
        for joint_name, X_BJ, slides in zip(arm.joint_names, poses, arm.prismatic, strict=True):
            joint = plant.GetJointByName(joint_name)
            v = np.zeros(plant.num_velocities())
            v[joint.velocity_start()] = 1.0
            plant.SetVelocities(context, v)
            V = joint.child_body().EvalSpatialVelocityInWorld(context)
            V_parent = joint.parent_body().EvalSpatialVelocityInWorld(context)
            axis = (V.translational() - V_parent.translational()) if slides else V.rotational() - V_parent.rotational()
            np.testing.assert_allclose(X_BJ.rotation().col(2), axis, rtol=0, atol=1e-9)


def test_ghost_links_at_the_place_of_the_arm_are_hidden():
    overlay = ArmOverlay(load_arm("mtml"), start_meshcat())
    q = np.zeros(7)
    q[2] = 0.2
    overlay.draw(np.zeros(7), desired=q)
    ghost = overlay._ghosts["desired"]

    def shown(link):
        return overlay._visibility._visible[ghost.link_path(link)]

    assert not shown("upper_arm_link")  # not moved by the elbow
    assert shown("forearm_link")
    assert overlay.meshcat.HasPath(f"/drake/{ghost.link_path('forearm_link')}")
    overlay.draw(np.zeros(7), desired=np.zeros(7))
    assert not shown("forearm_link")
    assert_refused(DvrkDrakeError, "unknown ghost other; known: desired", overlay.draw, q, ghosts={"other": q})


class Recorder:
    """Meshcat that stores the properties of a recording, as (time, value) by path."""

    def __init__(self):
        self.changes = {}

    def SetProperty(self, path, _, value, time):
        self.changes.setdefault(path, []).append((time, value))


def test_recording_stores_visibility_at_its_ends():
    """An animation uses its first value also for earlier times, and ends each track at its last value."""
    visibility = Visibility(meshcat := Recorder())
    visibility.set("arc", False)
    for time in (0.5, 0.75):
        visibility.set("arc", True, time)
    visibility.set("arc", False, 1.0)
    visibility.end_recording(4.0)
    assert meshcat.changes["arc"] == [(None, False), (0.0, False), (0.5, True), (1.0, False), (4.0, False)]


def test_drawing_does_not_change_a_simulation():
    arm = load_arm("mtml")
    meshcat = start_meshcat(arm)
    options = {"effects": False, "duration": 0.2, "targets": [(0.1, [0, 0.1, 0, 0, 0, 0, 0])]}
    drawn = dvrk.simulate(arm, meshcat=meshcat, **options)
    np.testing.assert_allclose(drawn.recording.q, dvrk.simulate(arm, **options).recording.q, rtol=0, atol=1e-12)
    for part in ("ghost/desired/mtml/forearm_link", "efforts/elbow_pitch"):
        assert meshcat.HasPath(f"/drake/mtml/overlay/{part}")


def test_unknown_frames_in_the_arm_file_are_refused(tmp_path):
    path = copy_arm(tmp_path, "psm", mechanism=lambda text: text.replace("remote_center: dh_0", "remote_center: dh_x"))
    assert_refused(ArmError, r"frames\.remote_center: the SDF has no frame dh_x", load_arm, path)
