"""Interactive view of an arm: linkage, sliders at the coupled limit, buttons, and the live view."""

import math

import numpy as np
import pytest

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.live_view import LiveForce, show_status
from dvrk_drake.systems.arm_view.arm_view import DEGREES, FRAMES, ArmView
from dvrk_drake.systems.arm_view.page import start_meshcat

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
