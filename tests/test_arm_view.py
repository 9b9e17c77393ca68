"""The Meshcat view: the linkage follows, and sliders cannot leave the coupled limit."""

import numpy as np
import pytest

from dvrk_drake.models.arm import load_arm
from dvrk_drake.systems.arm_view import ArmView, start_meshcat


@pytest.fixture(scope="module")
def view():
    view = ArmView(load_arm("mtml"), start_meshcat())
    view.add_sliders()
    return view


def test_dependent_joints_follow(view):
    view.show([0.1, 0.3, -0.2, 0.4, 0.5, 0.3, 0.2])
    plant = view._plant
    context = plant.GetMyContextFromRoot(view._context)
    (loop,) = view.arm.loop_closures
    gap = plant.GetFrameByName(loop.frame_a).CalcPose(context, plant.GetFrameByName(loop.frame_b)).translation()
    assert np.linalg.norm(gap) < 1e-12
    assert plant.GetJointByName("motor_4").get_angle(context) == pytest.approx(0.6697 * -0.2)


def test_sliders_cover_each_joint_and_stop_at_the_coupled_limit(view):
    view.show(np.zeros(7))
    for i, name in enumerate(view.arm.joint_names):
        view.meshcat.SetSliderValue(f"q{i + 1} {name}", 0.0)
    view.follow_sliders()
    view.meshcat.SetSliderValue("q2 shoulder_pitch", 0.6)
    q = view.follow_sliders()
    assert q[1] == pytest.approx(0.6, abs=2e-3)
    view.meshcat.SetSliderValue("q3 elbow_pitch", 0.6)
    q = view.follow_sliders()
    assert q[1] + q[2] <= 0.68 + 2e-3
    assert q[1] + q[2] > 0.6
    assert view.meshcat.GetSliderValue("q3 elbow_pitch") == pytest.approx(q[2])
