"""Simulated arm with the ports of its driver."""

import dataclasses

import numpy as np
import pytest
from controlled_arm import ControlledArm
from pydrake.geometry import HalfSpace, Role
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import tree_selector
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config, station_ports

pytestmark = pytest.mark.drake_api

ARM = load_arm("mtml")
MODEL = IdentifiedModel.from_arm(ARM)
N = ARM.num_joints
# Accuracy [m] of SAP for the linkage at 1 ms under this arm's loads: its constraints are stiff, not rigid.
# Measured: 1.0e-8 at rest and 1.2e-8 falling with couplers, 4e-9 with the loop pinned.
GAP = 2e-8
POSES = ARM.sample_poses(5, np.random.default_rng(0), margin=0.1)


def loop_gap(station, context):
    """Returns the largest distance [m] between frames that the linkage connects."""
    plant = station.plant
    plant_context = station.GetSubsystemContext(plant, context)
    gaps = []
    for loop in ARM.loop_closures:
        A, B = plant.GetFrameByName(loop.frame_a), plant.GetFrameByName(loop.frame_b)
        gaps.append(np.linalg.norm(A.CalcPose(plant_context, B).translation()))
    return max(gaps)


def linkage_error(station, context):
    """Returns the largest difference [rad] of the tree's joints from the linkage at the arm's joint positions."""
    plant_context = station.GetSubsystemContext(station.plant, context)
    q_tree = station.plant.GetPositions(plant_context)[tree_selector(station.plant, ARM)]
    return np.abs(q_tree - ARM.linkage.position(station.GetPositions(context))).max()


@pytest.mark.parametrize("name", ["mtml", "mtmr"])
def test_port_names_and_sizes(name):
    arm = load_arm(name)
    station = ArmStation(arm)
    inputs = {p.get_name(): p.size() for p in map(station.get_input_port, range(station.num_input_ports()))}
    outputs = {p.get_name(): p.size() for p in map(station.get_output_port, range(station.num_output_ports()))}
    expected = station_ports(arm)
    assert expected.inputs == {f"{name}.effort_commanded": 7}
    assert expected.inputs.items() <= inputs.items()
    assert expected.outputs.items() <= outputs.items()
    assert set(inputs) - set(expected.inputs) == {f"{name}.effort_disturbance"}
    assert set(outputs) - set(expected.outputs) == {f"{name}.state_true", "plant_state", "body_poses", "query_object"}


@pytest.mark.parametrize("q", POSES)
@pytest.mark.parametrize("closure", ["mimic", "ball"])
def test_exact_gravity_compensation_holds_a_released_arm(q, closure):
    arm = ControlledArm(ARM, q, closure=closure)
    assert arm.drift(2.0).max() < 1e-4
    assert loop_gap(arm.station, arm.context) < GAP


@pytest.mark.parametrize("closure", ["mimic", "ball"])
def test_linkage_stays_closed_while_the_arm_falls(closure):
    station = ArmStation(ARM, closure=closure)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.SetPositions(context, POSES[0])
    worst = 0.0
    for t in np.arange(0.01, 0.5, 0.01):
        simulator.AdvanceTo(t)
        worst = max(worst, loop_gap(station, context))
    assert np.abs(station.GetPositions(context) - POSES[0]).max() > 0.1
    assert worst < GAP


def test_energy_loss_vanishes_with_time_step():
    # Without damping and limits, the loss is that of the integrator, which is of first order in the step.
    q = np.array([0.1, 0.4, -0.2, 0.3, 0.5, 0.1, 0.0])
    losses = []
    for time_step in (1e-3, 2.5e-4):
        station = ArmStation(ARM, plant_config=arm_plant_config(time_step))
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        station.SetPositions(context, q)
        plant = station.plant
        plant_context = station.GetSubsystemContext(plant, context)

        def energy(plant=plant, plant_context=plant_context):
            # Drake's kinetic energy excludes the rotors. Its mass matrix includes them.
            v = plant.GetVelocities(plant_context)
            kinetic = 0.5 * v @ plant.CalcMassMatrix(plant_context) @ v
            return kinetic, plant.EvalPotentialEnergy(plant_context)

        total = [sum(energy())]
        for t in np.arange(0.01, 0.201, 0.01):
            simulator.AdvanceTo(t)
            total.append(sum(energy()))
        A, lower, upper = ARM.limit_matrix()
        assert np.all(A[:N] @ station.GetPositions(context) > lower[:N])
        assert np.all(A[:N] @ station.GetPositions(context) < upper[:N])
        kinetic, _ = energy()
        assert kinetic > 0.05
        losses.append((total[0] - np.array(total)) / kinetic)
    assert np.abs(losses[0]).max() < 0.02
    assert np.abs(losses[1]).max() < np.abs(losses[0]).max() / 3


def test_effort_measured_is_the_clamped_command():
    def strengthen(plant):
        plant.GetJointActuatorByName("outer_yaw").set_effort_limit(50.0)

    station = ArmStation(ARM, modify_plant=strengthen)
    context = station.CreateDefaultContext()
    limits, signs = np.array([50.0, *ARM.effort_limits[1:]]), np.array([1, -1, 1, -1, 1, -1, 1])
    for command in (np.linspace(-0.02, 0.02, N), 100.0 * signs):
        station.GetInputPort("mtml.effort_commanded").FixValue(context, command)
        effort = station.GetOutputPort("mtml.effort_measured").Eval(context)
        np.testing.assert_array_equal(effort, np.clip(command, -limits, limits))


def acceleration_of(station, q, inputs):
    """Returns the mean acceleration of the independent joints over the first millisecond."""
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.SetPositions(context, q)
    for name, value in inputs.items():
        station.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(1e-3)
    return station.GetOutputPort("mtml.velocity_estimated").Eval(context) / 1e-3


@pytest.mark.parametrize("j", range(N))
def test_efforts_act_on_their_joint_through_the_linkage(j):
    # M vd = tau - G at rest, with M and G of the seven independent joints: a known truth for both inputs.
    q = POSES[1]
    station = ArmStation(ARM)
    plant = station.plant
    context = station.CreateDefaultContext()
    station.SetPositions(context, q)
    selection = tree_selector(plant, ARM)
    G = ARM.linkage.matrix
    M = plant.CalcMassMatrix(station.GetSubsystemContext(plant, context))
    M = G.T @ M[np.ix_(selection, selection)] @ G
    tau = MODEL.holding_torque(q)
    extra = 0.2 * ARM.effort_limits * np.eye(N)[j]
    expected = np.linalg.solve(M, extra)
    for name in ("mtml.effort_commanded", "mtml.effort_disturbance"):
        inputs = {"mtml.effort_commanded": tau, "mtml.effort_disturbance": np.zeros(N)}
        inputs[name] = inputs[name] + extra
        # Ten short steps: SAP's couplers deviate by 0.2 % in the first step only.
        measured = acceleration_of(ArmStation(ARM, plant_config=arm_plant_config(1e-4)), q, inputs)
        np.testing.assert_allclose(measured, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


def test_disturbance_is_not_clamped():
    far = 10 * ARM.effort_limits * np.eye(N)[0]
    q = POSES[1]
    commanded = acceleration_of(ArmStation(ARM), q, {"mtml.effort_commanded": far})
    disturbed = acceleration_of(ArmStation(ARM), q, {"mtml.effort_disturbance": far})
    assert disturbed[0] > 5 * commanded[0] > 0


def test_measurements_are_the_state_of_the_independent_joints():
    station = ArmStation(ARM)
    context = station.CreateDefaultContext()
    station.SetPositions(context, POSES[3])
    plant_context = station.GetMutableSubsystemContext(station.plant, context)
    v = np.arange(1.0, 1 + N)
    v_plant = np.zeros(station.plant.num_velocities())
    for name, value in zip(ARM.joint_names, v, strict=True):
        v_plant[station.plant.GetJointByName(name).velocity_start()] = value
    station.plant.SetVelocities(plant_context, v_plant)
    np.testing.assert_array_equal(station.GetOutputPort("mtml.position_measured").Eval(context), POSES[3])
    np.testing.assert_array_equal(station.GetOutputPort("mtml.velocity_estimated").Eval(context), v)
    expected = np.concatenate([POSES[3], v])
    np.testing.assert_array_equal(station.GetOutputPort("mtml.state_estimated").Eval(context), expected)
    np.testing.assert_array_equal(station.GetPositions(context), POSES[3])


def test_set_positions_closes_the_linkage_and_rests():
    station = ArmStation(ARM, closure="ball")
    context = station.CreateDefaultContext()
    station.SetPositions(context, POSES[4])
    assert loop_gap(station, context) < 1e-12
    assert linkage_error(station, context) < 1e-12
    assert not np.any(station.GetOutputPort("mtml.velocity_estimated").Eval(context))


def test_link_inertias_change_only_one_context():
    station = ArmStation(ARM)
    heavy, nominal = station.CreateDefaultContext(), station.CreateDefaultContext()
    payload = SpatialInertia(
        1.0, np.array([0, 0, -0.05]), UnitInertia.SolidSphere(0.03).ShiftFromCenterOfMass([0, 0, 0.05])
    )
    station.SetLinkInertias(heavy, {"wrist_roll_link": payload})
    mass = [station.plant.CalcTotalMass(station.GetSubsystemContext(station.plant, c)) for c in (heavy, nominal)]
    assert mass[0] - mass[1] == pytest.approx(1.0 - 0.06, abs=1e-12)
    with pytest.raises(StationError, match=r"unknown link hand; known links: .*wrist_roll_link"):
        station.SetLinkInertias(heavy, {"hand": payload})


def test_modify_plant_and_plant_arm():
    def add_damping(plant):
        for name in ARM.joint_names:
            plant.GetJointByName(name).set_default_damping_vector([0.5])

    q = POSES[0]
    free, damped = ArmStation(ARM), ArmStation(ARM, modify_plant=add_damping)
    moved = []
    for station in (free, damped):
        simulator = Simulator(station)
        station.SetPositions(simulator.get_mutable_context(), q)
        simulator.AdvanceTo(0.2)
        moved.append(np.abs(station.GetPositions(simulator.get_context()) - q).max())
    assert moved[1] < 0.5 * moved[0]

    weightless = ArmStation(ARM, plant_arm=ARM.with_gravity([0.0, 0.0, 0.0]))
    assert weightless.arm is ARM
    assert not np.any(acceleration_of(weightless, q, {}))


def test_collision_shapes_exist_only_with_contact_candidates():
    def proximity_shapes(station):
        return station._scene_graph.model_inspector().NumGeometriesWithRole(Role.kProximity)

    def add_table(plant):
        top = RigidTransform([0.0, -0.3, -0.3])
        plant.RegisterCollisionGeometry(plant.world_body(), top, HalfSpace(), "table", CoulombFriction(0.5, 0.5))

    assert proximity_shapes(ArmStation(ARM)) == 0
    fallen = []
    for modify_plant in (None, add_table):
        station = ArmStation(ARM, modify_plant=modify_plant)
        simulator = Simulator(station)
        station.SetPositions(simulator.get_mutable_context(), np.zeros(N))
        simulator.AdvanceTo(1.0)
        fallen.append(station.GetPositions(simulator.get_context()))
    assert proximity_shapes(station) > 10
    assert np.abs(fallen[0] - fallen[1]).max() > 0.1, "the arm lies on the table"


def test_errors_state_the_remedy():
    with pytest.raises(StationError, match=r"time_step must be above 0 and at most 0.01 s"):
        ArmStation(ARM, plant_config=arm_plant_config(0.0))
    with pytest.raises(StationError, match='discrete_contact_approximation is "tamsi"; a linkage needs sap'):
        ArmStation(
            ARM,
            plant_config=MultibodyPlantConfig(discrete_contact_approximation="tamsi", use_sampled_output_ports=False),
        )
    with pytest.raises(StationError, match="use_sampled_output_ports must be false"):
        ArmStation(ARM, plant_config=MultibodyPlantConfig())
    with pytest.raises(StationError, match="plant_arm must have the joints of MTML"):
        ArmStation(ARM, plant_arm=dataclasses.replace(ARM, joint_names=ARM.joint_names[::-1]))
    station = ArmStation(ARM)
    with pytest.raises(StationError, match="a pose of MTML is 7 finite numbers"):
        station.SetPositions(station.CreateDefaultContext(), np.zeros(6))
