"""Simulated teleoperation of a PSM by a master."""

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePose
from teleoperation_loop import MTM, PSM, angle

from dvrk_drake.experiments.demo.teleoperation import (
    SCALE,
    START_FOLLOWER,
    START_MASTER,
)
from dvrk_drake.systems.hand import PoseTrajectorySource
from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms

pytestmark = pytest.mark.drake_api


@pytest.fixture(scope="module")
def arms():
    return TeleoperatedArms(MTM, PSM, scale=SCALE)


def run(arms, duration=2.5):
    """Returns the final states and poses after a hand moves, rotates and then holds the handle."""
    simulator = Simulator(arms)
    context = simulator.get_mutable_context()
    arms.SetPositions(context, START_MASTER, START_FOLLOWER)
    X_MG0, X_FT0 = arms.CalcX_MG(context), arms.CalcX_FT(context)
    arms.GetInputPort("engaged").FixValue(context, [1.0])
    for t in np.arange(0, duration, 0.01):
        s = np.clip((t - 0.1) / 1.0, 0, 1)
        target = RigidTransform(
            RotationMatrix(RollPitchYaw(0.3 * s, -0.2 * s, 0.25 * s)) @ X_MG0.rotation(),
            X_MG0.translation() + s * np.array([0.04, -0.03, 0.05]),
        )
        arms.GetInputPort("X_MG_desired").FixValue(context, AbstractValue.Make(target))
        simulator.AdvanceTo(t + 0.01)
    state = [arms.GetOutputPort(f"{name}.state_estimated").Eval(context) for name in ("mtml", "psm")]
    return np.concatenate(state), (X_MG0, arms.CalcX_MG(context)), (X_FT0, arms.CalcX_FT(context)), target


def test_simulated_follower_follows_the_hand(arms):
    _, (G0, G), (T0, T), target = run(arms)
    # The hand moves the gravity-compensated master to the desired pose without its weight.
    assert np.linalg.norm(G.translation() - target.translation()) < 1e-4
    way = SCALE * (G.translation() - G0.translation())
    assert np.linalg.norm(way) > 0.02
    assert np.linalg.norm(T.translation() - T0.translation() - way) < 5e-4
    wanted = G.rotation() @ G0.rotation().inverse()
    assert angle(wanted) > 0.3
    assert angle(T.rotation() @ T0.rotation().inverse() @ wanted.inverse()) < 5e-3


def test_master_and_follower_stay_without_a_hand(arms):
    simulator = Simulator(arms)
    context = simulator.get_mutable_context()
    arms.SetPositions(context, START_MASTER, START_FOLLOWER)
    arms.GetInputPort("engaged").FixValue(context, [1.0])
    simulator.AdvanceTo(1.0)
    q_M = arms.GetOutputPort("mtml.state_estimated").Eval(context)[:7]
    q_F = arms.GetOutputPort("psm.state_estimated").Eval(context)[:7]
    np.testing.assert_allclose(q_M, START_MASTER, atol=1e-4)
    np.testing.assert_allclose(q_F, START_FOLLOWER, atol=1e-4)


def test_pose_is_constant_outside_the_trajectory():
    ends = [RigidTransform([0.0, 0, 0]), RigidTransform([2.0, 0, 0])]
    source = PoseTrajectorySource(PiecewisePose.MakeLinear([1.0, 2.0], ends))
    context = source.CreateDefaultContext()
    for time, x in ((0.0, 0.0), (1.5, 1.0), (9.0, 2.0)):
        context.SetTime(time)
        assert source.get_output_port().Eval(context).translation()[0] == pytest.approx(x)
