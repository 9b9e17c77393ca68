"""Comparison of two models of the PSM: closed loops with pins, and a tree with couplings."""

import numpy as np
import pytest
from controlled_arm import ControlledArm
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions, tree_selector
from dvrk_drake.systems.arm_station import ArmStation

pytestmark = pytest.mark.drake_api

ARM = load_arm("psm")
N = ARM.num_joints
#: Joints outside of loops, coupled by a cable in both models: dependent joint -> (leader, multiplier).
CABLES = {"counterweight": ("insertion", 1.0), "finger_1": ("jaw", -0.5)}


def box_poses(count=30):
    """Returns the corners of the first three joints' ranges, then random poses in all ranges."""
    poses = ARM.sample_poses(count, np.random.default_rng(0))
    ranges = zip(ARM.position_lower[:3], ARM.position_upper[:3], strict=True)
    corners = np.array(np.meshgrid(*ranges)).reshape(3, -1).T
    poses[: len(corners), :3] = corners
    return poses


def gaps(plant, context):
    """Returns the largest distance [m] between pinned points, and that of the RCM from its nominal position."""
    pins = []
    for loop in ARM.loop_closures:
        A, B = plant.GetFrameByName(loop.frame_a), plant.GetFrameByName(loop.frame_b)
        pins.append(np.linalg.norm(A.CalcPose(context, B).translation()))
    remote_center = plant.GetFrameByName("remote_center").CalcPoseInWorld(context).translation()
    return np.array([max(pins), np.linalg.norm(remote_center)])


def constraint_jacobian(plant, context):
    """Returns the exact Jacobian (k, nq) of all constraints of the pinned plant: pins and cables."""
    world, nothing = plant.world_frame(), np.zeros((3, 1))
    rows = []
    for loop in ARM.loop_closures:
        A, B = plant.GetFrameByName(loop.frame_a), plant.GetFrameByName(loop.frame_b)
        J_A, J_B = (
            plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kQDot, F, nothing, world, world)
            for F in (A, B)
        )
        rows.append(J_A - J_B)
    for dependent, (leader, multiplier) in CABLES.items():
        row = np.zeros((1, plant.num_positions()))
        row[0, plant.GetJointByName(dependent).position_start()] = 1.0
        row[0, plant.GetJointByName(leader).position_start()] = -multiplier
        rows.append(row)
    return np.vstack(rows)


def allowed_motion(plant, context):
    """Returns the matrix (nq, n) from independent to all joint velocities, from the constraints alone."""
    J = constraint_jacobian(plant, context)
    independent = [plant.GetJointByName(name).position_start() for name in ARM.joint_names]
    dependent = [i for i in range(plant.num_positions()) if i not in independent]
    assert np.linalg.matrix_rank(J[:, dependent]) == len(dependent)
    H = np.zeros((plant.num_positions(), N))
    H[independent, range(N)] = 1.0
    H[dependent] = -np.linalg.lstsq(J[:, dependent], J[:, independent], rcond=None)[0]
    return H


def test_pins_and_couplings_give_the_same_dynamics():
    tree, pinned = make_arm_plant(ARM), make_arm_plant(ARM, closure="ball")
    tree_context, context = tree.CreateDefaultContext(), pinned.CreateDefaultContext()
    G = ARM.linkage.matrix
    select, tree_select = tree_selector(pinned, ARM), tree_selector(tree, ARM)
    for q in box_poses():
        set_arm_positions(pinned, context, ARM, q)
        set_arm_positions(tree, tree_context, ARM, q)
        H = allowed_motion(pinned, context)
        np.testing.assert_allclose(H[select], G, atol=1e-12)
        tau = -H.T @ pinned.CalcGravityGeneralizedForces(context)
        np.testing.assert_allclose(tau, holding_torque(tree, tree_context, ARM), rtol=0, atol=1e-9)
        M = G.T @ tree.CalcMassMatrix(tree_context)[np.ix_(tree_select, tree_select)] @ G
        np.testing.assert_allclose(H.T @ pinned.CalcMassMatrix(context) @ H, M, rtol=0, atol=1e-12)


@pytest.mark.parametrize("q", ARM.sample_poses(3, np.random.default_rng(1), margin=0.25))
def test_same_torques_give_the_same_motion(q):
    """Gravity torque plus a different torque per joint for 0.5 s without control: about 1 rad/s."""
    phase = np.arange(N)
    push = 0.05 * np.array([2.0, 2.0, 6.0, 0.003, 0.006, 0.015, 0.004])
    runs = {}
    for closure in ("mimic", "ball"):
        station = ArmStation(ARM, closure=closure)
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        station.SetPositions(context, q)
        balance = IdentifiedModel.from_arm(ARM).holding_torque(q)
        states = []
        for t in np.arange(0.0, 0.5, 0.01):
            effort = balance + push * np.sin(10.0 * t + phase)
            station.GetInputPort("psm.effort_commanded").FixValue(context, effort)
            simulator.AdvanceTo(t + 0.01)
            states.append(station.GetOutputPort("psm.state_estimated").Eval(context))
        runs[closure] = np.array(states)
    moved = np.abs(runs["mimic"][:, :N] - q).max(axis=0)
    assert np.all(moved > [0.02, 0.02, 0.004, 0.02, 0.02, 0.02, 0.02])
    difference = np.abs(runs["ball"] - runs["mimic"]).max(axis=0)
    # Both satisfy their constraints to about 1e-8. Measured: 2e-7 rad and 1.3e-6 rad/s.
    assert np.all(difference[:N] < 1e-6)
    assert np.all(difference[N:] < 5e-6)


@pytest.mark.parametrize("num_corners", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_closure_and_remote_centre_during_motion(num_corners):
    """Controlled motion with pinned loops to corners of yaw, pitch and insertion, at up to 1.6 rad/s.

    Four corners contain both limits of each joint, eight are all.
    """
    # Slightly inside the limits, so that the controller does not push against the stops.
    center, half = (ARM.position_lower + ARM.position_upper) / 2, (ARM.position_upper - ARM.position_lower) / 2
    corners = [(-1, -1, -1), (1, -1, 1), (1, 1, -1), (-1, 1, 1), (-1, -1, 1), (1, 1, 1), (1, -1, -1), (-1, 1, -1)]
    signs = np.array([[*corner, *(corner[::-1]), corner[0]] for corner in corners[:num_corners]], float)
    knots = center + 0.98 * half * signs
    times = 3.0 * np.arange(len(knots))
    trajectory = PiecewisePolynomial.CubicHermite(times, knots.T, np.zeros_like(knots.T))
    desired = TrajectorySource(trajectory, output_derivative_order=1)
    arm = ControlledArm(ARM, knots[0], mode="hold", desired=desired, closure="ball")
    plant, plant_context = arm.station.plant, arm.plant_context
    select = tree_selector(plant, ARM)
    worst, tracking, linkage, q_seen = np.zeros(2), np.zeros(N), 0.0, []
    for t in np.arange(0.005, times[-1], 0.005):
        arm.simulator.AdvanceTo(t)
        q = arm.q
        worst = np.maximum(worst, gaps(plant, plant_context))
        tracking = np.maximum(tracking, np.abs(q - trajectory.value(t)[:, 0]))
        linkage = max(linkage, np.abs(plant.GetPositions(plant_context)[select] - ARM.linkage.position(q)).max())
        q_seen.append(q)
    covered = np.ptp(q_seen, axis=0) / (2 * half)
    assert np.all(covered > 0.97)
    assert np.all(tracking < [5e-3, 5e-3, 5e-4, 1e-2, 5e-3, 5e-3, 5e-3])
    assert np.all(worst < 1e-7)  # the aim is 1e-6 m; measured 3e-9 at the pins, 1.4e-8 at the remote centre
    assert linkage < 2e-6  # measured 5e-7 rad


@pytest.mark.parametrize("closure", ["mimic", "ball"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_full_effort_at_stops_keeps_linkage_closed(closure, sign):
    """A stop acts on the leading joint. Dependent bodies, above all the counterweight, must stop as well."""
    station = ArmStation(ARM, closure=closure)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    inset = 0.02 * (ARM.position_upper - ARM.position_lower)
    stop = ARM.position_upper if sign > 0 else ARM.position_lower
    station.SetPositions(context, stop - sign * inset)
    station.GetInputPort("psm.effort_commanded").FixValue(context, sign * ARM.effort_limits)
    plant, select = station.plant, tree_selector(station.plant, ARM)
    plant_context = station.GetSubsystemContext(plant, context)
    for t in np.arange(0.002, 0.5, 0.002):
        simulator.AdvanceTo(t)
        q = station.GetPositions(context)
        assert np.all(gaps(plant, plant_context) < 2e-7)  # measured 8e-8
        follows = np.abs(plant.GetPositions(plant_context)[select] - ARM.linkage.position(q))
        assert follows.max() < 2e-5  # measured 7e-6 rad on the light finger as it stops, 4e-7 elsewhere
    assert np.abs(q - stop).max() < 1e-5
