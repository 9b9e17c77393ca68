"""Tests the SDF of the PSM: DH table of the dVRK, linkage and remote centre of motion."""

import numpy as np
import pytest
from dvrk_share import craig

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions

pytestmark = pytest.mark.drake_api

PI = np.pi
#: sawIntuitiveResearchKit share/kinematic/psm.json, modified DH: alpha, a, theta offset, d; joint 3 is prismatic.
TABLE = [
    (PI / 2, 0, PI / 2, 0),
    (-PI / 2, 0, -PI / 2, 0),
    (PI / 2, 0, 0, -0.4318),
    (0, 0, 0, 0.4162),
    (-PI / 2, 0, -PI / 2, 0),
    (-PI / 2, 0.0091, -PI / 2, 0),
]


@pytest.fixture(scope="module")
def arm():
    return load_arm("psm")


@pytest.fixture(scope="module")
def plant(arm):
    return make_arm_plant(arm)


@pytest.fixture(scope="module")
def box(arm):
    """Returns random poses. In the first eight, the first three joints are at the corners of their limits."""
    poses = np.random.default_rng(0).uniform(arm.position_lower, arm.position_upper, (200, 7))
    corners = np.array(np.meshgrid(*zip(arm.position_lower[:3], arm.position_upper[:3], strict=True))).reshape(3, -1).T
    poses[: len(corners), :3] = corners
    return poses


def test_joints_and_limits_equal_those_of_the_dvrk(arm):
    assert arm.joint_names == ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw")
    np.testing.assert_allclose(arm.position_lower[:3], [-1.588, -0.925025, 0.0], atol=1e-9)
    np.testing.assert_allclose(arm.effort_limits, [3.316, 3.316, 9.878, 0.33, 0.25, 0.20, 0.16], atol=1e-9)


def test_forward_kinematics_equals_the_dvrk_dh_table(arm, plant, box):
    context = plant.CreateDefaultContext()
    for q in box:
        set_arm_positions(plant, context, arm, q)
        X = np.eye(4)
        for i, (alpha, a, offset, d) in enumerate(TABLE):
            prismatic = i == 2
            X = X @ craig(alpha, a, offset + (0 if prismatic else q[i]), d + (q[i] if prismatic else 0))
            frame = plant.GetFrameByName(f"dh_{i + 1}")
            np.testing.assert_allclose(
                frame.CalcPose(context, plant.GetFrameByName("dh_0")).GetAsMatrix4(), X, rtol=0, atol=1e-12
            )


def test_linkage_is_closed_and_remote_centre_is_fixed(arm, plant, box):
    context = plant.CreateDefaultContext()
    assert len(arm.loop_closures) == 2
    for q in box:
        set_arm_positions(plant, context, arm, q)
        for loop in arm.loop_closures:
            A, B = plant.GetFrameByName(loop.frame_a), plant.GetFrameByName(loop.frame_b)
            assert np.linalg.norm(A.CalcPose(context, B).translation()) < 1e-12
        center = plant.GetFrameByName("remote_center").CalcPoseInWorld(context).translation()
        assert np.linalg.norm(center) < 1e-12


def test_fingers_are_at_plus_and_minus_half_of_the_jaw(arm, plant):
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, [0.1, 0.2, 0.1, 0.3, 0.4, 0.5, 0.8])
    wrist = plant.GetBodyByName("wrist_yaw_link").EvalPoseInWorld(context).rotation()
    for finger, angle in (("finger_1_link", -0.4), ("finger_2_link", 0.4)):
        R = wrist.inverse() @ plant.GetBodyByName(finger).EvalPoseInWorld(context).rotation()
        axis_angle = R.ToAngleAxis()
        assert axis_angle.angle() * axis_angle.axis() @ [0, -1, 0] == pytest.approx(angle, abs=1e-12)


def test_counterweight_moves_against_the_insertion(arm, plant):
    context = plant.CreateDefaultContext()

    def heights(insertion):
        set_arm_positions(plant, context, arm, [0, 0, insertion, 0, 0, 0, 0])
        names = ("insertion_link", "counterweight_link")
        return np.array([plant.GetBodyByName(n).EvalPoseInWorld(context).translation()[2] for n in names])

    np.testing.assert_allclose(heights(0.2) - heights(0.0), [-0.2, 0.2], atol=1e-12)


def test_holding_torque_is_the_gradient_of_potential_energy(arm, plant, box):
    context = plant.CreateDefaultContext()

    def energy(q):
        set_arm_positions(plant, context, arm, q)
        return plant.CalcPotentialEnergy(context)

    h = 1e-5
    for q in box[::10]:
        gradient = [(energy(q + h * e) - energy(q - h * e)) / (2 * h) for e in np.eye(7)]
        set_arm_positions(plant, context, arm, q)
        np.testing.assert_allclose(holding_torque(plant, context, arm), gradient, atol=1e-8)


def test_inertias_are_physically_consistent(plant):
    for index in plant.GetBodyIndices(plant.GetBodyByName("base_link").model_instance()):
        body = plant.get_body(index)
        if body.name() != "base_link":
            assert body.default_mass() > 0
            assert body.default_spatial_inertia().IsPhysicallyValid()
            assert np.linalg.norm(body.default_com()) > 1e-4 or body.name() == "counterweight_link"


def test_disc_coupling_equals_the_dvrk_and_conserves_power(arm):
    M = np.array([[-1.5632, 0, 0, 0], [0, 1.0186, 0, 0], [0, -0.8306, 0.6089, 0.6089], [0, 0, -1.2177, 1.2177]])
    disc = np.array([0.1, -0.2, 0.3, 0.5])
    q = np.concatenate([[0.1, 0.2, 0.05], M @ disc])
    np.testing.assert_allclose(arm.transmission.position(q), np.concatenate([[0.1, 0.2, 0.05], disc]), atol=1e-12)
    qd, tau = np.arange(1.0, 8.0), np.arange(-3.0, 4.0)
    assert arm.transmission.velocity(qd) @ tau == pytest.approx(qd @ arm.transmission.pull_back_effort(tau))


def test_unknown_instrument_lists_the_known_ones(tmp_path):
    text = "name: PSM9\nmechanism: psm\ninstrument: scissors\nposition_limits: {}\n"
    (tmp_path / "psm9.yaml").write_text(text)
    with pytest.raises(ArmError, match='unknown instrument "scissors"; known instruments: large_needle_driver'):
        load_arm(str(tmp_path / "psm9.yaml"))
