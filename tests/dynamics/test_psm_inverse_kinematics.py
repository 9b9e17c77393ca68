"""Inverse kinematics of the PSM against its forward kinematics."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from teleoperation_loop import MTM, PSM, Q_F, tip

from dvrk_drake.dynamics.kinematics import PsmInverseKinematics
from dvrk_drake.errors import ArmError
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions

pytestmark = [pytest.mark.numeric, pytest.mark.drake_api]


def test_inverse_kinematics_inverts_forward_kinematics():
    inverse = PsmInverseKinematics(PSM)
    lower, upper = PSM.position_lower.copy(), PSM.position_upper
    assert inverse.depth_at_zero == pytest.approx(-0.0156)
    assert inverse.wrist_length == pytest.approx(0.0091)
    lower[2] = -inverse.depth_at_zero + 2e-3
    poses = np.random.default_rng(0).uniform(lower, upper, (300, 7))
    corners = np.array(np.meshgrid(*zip(lower[:6], upper[:6], strict=True))).reshape(6, -1).T
    plant = make_arm_plant(PSM)
    context = plant.CreateDefaultContext()
    for q in [*poses, *np.hstack([corners, np.zeros((len(corners), 1))])]:
        set_arm_positions(plant, context, PSM, q)
        X_FT = plant.GetFrameByName("dh_6").CalcPoseInWorld(context)
        np.testing.assert_allclose(inverse.solve(X_FT, q), q[:6], rtol=0, atol=1e-9)


def test_roll_is_within_half_a_revolution_of_the_guess():
    inverse = PsmInverseKinematics(PSM)
    q = Q_F.copy()
    for roll in (-4.0, -0.5, 4.0):
        q[3] = roll
        assert inverse.solve(tip(q), q)[3] == pytest.approx(roll, abs=1e-9)


def test_no_solution_above_the_remote_centre():
    inverse = PsmInverseKinematics(PSM)
    X_FT = tip(Q_F)
    up = RigidTransform(X_FT.rotation(), [*X_FT.translation()[:2], 0.1])
    assert inverse.solve(up, Q_F) is None
    assert inverse.solve(RigidTransform(X_FT.rotation(), np.zeros(3)), Q_F) is None
    q = Q_F.copy()
    q[2] = 0.0156 + 0.019
    assert inverse.solve(tip(q), q) is not None
    assert PsmInverseKinematics(PSM, min_depth=0.02).solve(tip(q), q) is None


def test_rejects_an_arm_that_is_not_a_psm():
    with pytest.raises(ArmError, match="MTML does not have the kinematics of a PSM"):
        PsmInverseKinematics(MTM)
