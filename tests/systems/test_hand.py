"""Hand as spring and damper: force law, limits and stability."""

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ArmError, StationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.hand import Grip, Hand

pytestmark = pytest.mark.drake_api

ARM = load_arm("mtml")
Q = np.array([0.1, 0.3, -0.1, 0.2, 1.0, 0.1, 0.3])
WEAK = Grip(max_force=2000.0, max_torque=500.0)


def evaluate(hand, q, v, X_BG_desired=None):
    context = hand.CreateDefaultContext()
    hand.GetInputPort("state_estimated").FixValue(context, np.concatenate([q, v]))
    if X_BG_desired is not None:
        hand.GetInputPort("X_BG_desired").FixValue(context, AbstractValue.Make(X_BG_desired))
    return hand.GetOutputPort("effort_disturbance").Eval(context), hand.GetOutputPort("spatial_force").Eval(context)


def moved(X, rpy, p):
    return RigidTransform(RotationMatrix(RollPitchYaw(rpy)) @ X.rotation(), X.translation() + p)


def held_arm(grip, X_offset, duration):
    """Returns desired and reached pose and largest speed of a weightless arm that a hand pulls by `X_offset`."""
    arm = ARM.with_gravity([0, 0, 0])
    builder = DiagramBuilder()
    station = builder.AddSystem(ArmStation(arm))
    hand = builder.AddSystem(Hand(arm, grip=grip))
    builder.Connect(station.GetOutputPort("mtml.state_estimated"), hand.GetInputPort("state_estimated"))
    builder.Connect(hand.GetOutputPort("effort_disturbance"), station.GetInputPort("mtml.effort_disturbance"))
    builder.ExportInput(hand.GetInputPort("X_BG_desired"), "wanted")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    context = station.GetMyMutableContextFromRoot(root)
    station.SetPositions(context, Q)
    frame = ArmFrame(arm, "dh_7")
    wanted = moved(frame.pose(Q), *X_offset)
    diagram.GetInputPort("wanted").FixValue(root, AbstractValue.Make(wanted))
    simulator.AdvanceTo(duration)
    state = station.GetOutputPort("mtml.state_estimated").Eval(context)
    return wanted, frame.pose(state[:7]), frame.jacobian(state[:7]) @ state[7:]


def test_mass_matrix_matches_kinetic_energy():
    # The joint inertia of the PSM includes its counterweight and linkage.
    psm = load_arm("psm")
    plant = make_arm_plant(psm)
    context = plant.CreateDefaultContext()
    generator = np.random.default_rng(0)
    q, v = psm.sample_poses(1, generator)[0], generator.normal(size=7)
    set_arm_positions(plant, context, psm, q)
    v_plant = np.zeros(plant.num_velocities())
    for name, rate in zip(psm.tree_joint_names, psm.linkage.velocity(v), strict=True):
        v_plant[plant.GetJointByName(name).velocity_start()] = rate
    plant.SetVelocities(context, v_plant)
    energy = 0.5 * v_plant @ plant.CalcMassMatrix(context) @ v_plant
    assert 0.5 * v @ ArmFrame(psm, "dh_6").mass_matrix(q) @ v == pytest.approx(energy, rel=1e-12)


def test_force_converges_to_spring_and_damper():
    hand = Hand(ARM, grip=WEAK, time_step=1e-9)
    frame = ArmFrame(ARM, "dh_7")
    v = np.array([0.1, -0.2, 0.1, 0.3, 0.2, -0.1, 0.4])
    X = moved(frame.pose(Q), [0.0, 0.0, 0.2], [0.01, -0.02, 0.03])
    tau, F = evaluate(hand, Q, v, X)
    V = frame.jacobian(Q) @ v
    np.testing.assert_allclose(F[:3], 2.0 * np.array([0, 0, 0.2]) - 0.03 * V[:3], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(F[3:], 600.0 * np.array([0.01, -0.02, 0.03]) - 25.0 * V[3:], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(tau, frame.jacobian(Q).T @ F, rtol=0, atol=1e-12 * np.abs(F).max())


def test_limited_force_and_torque_keep_direction():
    way = np.array([0, 0, 1.5, 3.0, 4.0, 0.0])
    far = moved(ArmFrame(ARM, "dh_7").pose(Q), way[:3], way[3:])
    limited = evaluate(Hand(ARM, time_step=1e-9), Q, np.zeros(7), far)[1]
    for part, limit in ((slice(0, 3), 0.6), (slice(3, 6), 20.0)):
        np.testing.assert_allclose(limited[part], limit * way[part] / np.linalg.norm(way[part]), rtol=1e-3, atol=1e-4)


def test_no_force_without_finite_desired_pose():
    X = ArmFrame(ARM, "dh_7").pose(Q + 0.1)
    bad = Q.copy()
    bad[2] = np.nan
    nowhere = RigidTransform(X.rotation(), [np.nan, 0, 0])
    for q, wanted in ((Q, None), (bad, X), (Q, nowhere)):
        for output in evaluate(Hand(ARM), q, np.zeros(7), wanted):
            np.testing.assert_array_equal(output, 0.0)


@pytest.mark.parametrize("firmer", [1.0, 1e3])
def test_hand_moves_handle_to_pose_with_any_stiffness(firmer):
    # 600 kN/m and 2 kN m/rad on a wrist of 1e-5 kg m^2: an explicit spring would be unstable.
    grip = Grip(600.0 * firmer, 25.0 * firmer, 2.0 * firmer, 0.03 * firmer)
    wanted, X, V = held_arm(grip, ([0.1, -0.1, 0.2], [0.02, -0.02, 0.03]), 2.0)
    assert np.linalg.norm(X.translation() - wanted.translation()) < 1e-3
    assert abs((X.rotation() @ wanted.rotation().inverse()).ToAngleAxis().angle()) < 5e-3
    assert np.linalg.norm(V[3:]) < 5e-3


def test_invalid_arguments_are_refused():
    with pytest.raises(ArmError, match='MTML: the SDF has no frame "thumb"; available frames: dh_0'):
        Hand(ARM, "thumb")
    with pytest.raises(StationError, match=r"grip of the hand: stiffness is nan; allowed: 1e-06\.\."):
        Hand(ARM, grip=Grip(stiffness=np.nan))
    with pytest.raises(StationError, match="time_step of the hand must be a positive number of seconds; got 0"):
        Hand(ARM, time_step=0)
