"""Several arms and other objects in one plant."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    DiscreteContactApproximation,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import FixedOffsetFrame, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from dvrk_drake.errors import ArmError, StationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import add_arm
from dvrk_drake.systems.arm_drive import add_arm_drive
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config

pytestmark = pytest.mark.drake_api

MTML, PSM = load_arm("mtml"), load_arm("psm")
X_WP = RigidTransform(RollPitchYaw(0.5, 0.2, 0.1), [0.0, 1.0, 0.6])
TILTED_PSM = PSM.with_gravity(X_WP.rotation().inverse() @ [0, 0, -9.81])
EFFORTS = {"MTML": [0.1, 0.2, -0.2, 0.02, 0.01, 0.01, 0.001], "PSM": [0.3, -0.4, 0.5, 0.01, 0.01, -0.01, 0.01]}


def alone(arm, q, steps, effects):
    """Returns the true state (2n,) and the measured effort (n,) of an arm in its station after constant efforts."""
    station, name = ArmStation(arm, effects=effects), arm.name.lower()
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.SetPositions(context, q)
    station.GetInputPort(f"{name}.effort_commanded").FixValue(context, EFFORTS[arm.name])
    simulator.AdvanceTo(1e-3 * steps)
    return [station.GetOutputPort(f"{name}.{port}").Eval(context) for port in ("state_true", "effort_measured")]


@pytest.mark.parametrize(
    ("arms", "groups"), [([MTML, TILTED_PSM, MTML], []), ([MTML, TILTED_PSM], ["all"])], ids=["ideal", "effects"]
)
def test_arms_beside_others_move_as_alone(arms, groups):
    """A floating body comes first, so that positions and velocities have different indices."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(arm_plant_config(), builder)
    ball = plant.AddRigidBody("ball", plant.AddModelInstance("ball"), SpatialInertia.SolidSphereWithMass(0.1, 0.03))
    poses = [arm.sample_poses(1, np.random.default_rng(k), margin=0.2)[0] for k, arm in enumerate(arms)]
    mounts = [RigidTransform([1.0, 0, 0]), X_WP, RigidTransform([-1.0, 0, 0])][: len(arms)]
    instances = [add_arm(plant, arm, X_PB=X, collision_shapes=False) for arm, X in zip(arms, mounts, strict=True)]
    effects = [arm.effects.only(groups) if groups else None for arm in arms]
    in_plant = [
        PlantEffects(plant, arm, instance, own) if own else None
        for arm, instance, own in zip(arms, instances, effects, strict=True)
    ]
    plant.Finalize()
    push = np.zeros(plant.num_velocities())
    push[ball.floating_velocities_start_in_v() + 3] = 2.0
    source = builder.AddSystem(ConstantVectorSource(push))
    builder.Connect(source.get_output_port(), plant.get_applied_generalized_force_input_port())
    drives = [add_arm_drive(builder, plant, *parts) for parts in zip(arms, instances, in_plant, strict=True)]
    diagram = builder.Build()
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    for arm, drive, q in zip(arms, drives, poses, strict=True):
        drive.set_positions(diagram, root, q)
        port = drive.effort_commanded
        port.FixValue(port.get_system().GetMyMutableContextFromRoot(root), EFFORTS[arm.name])
    simulator.AdvanceTo(0.03)
    for arm, drive, q, own in zip(arms, drives, poses, effects, strict=True):
        ports = drive.state_true, drive.effort_measured
        state, effort = (port.Eval(port.get_system().GetMyContextFromRoot(root)) for port in ports)
        assert np.abs(state[arm.num_joints :]).max() > 0.01
        expected = alone(arm, q, 30, own)
        np.testing.assert_allclose(state, expected[0], atol=1e-6)
        np.testing.assert_allclose(effort, expected[1], atol=1e-12)
    moved = ball.EvalPoseInWorld(plant.GetMyContextFromRoot(root)).translation()
    np.testing.assert_allclose(moved, 0.5 * np.array([20.0, 0, -9.81]) * 0.03**2, rtol=0.05, atol=1e-9)


def test_gravity_and_frames_of_the_plant_are_respected():
    plant = MultibodyPlant(1e-3)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -1.62])
    table = plant.AddFrame(FixedOffsetFrame("table", plant.world_frame(), X_WP))
    instance = add_arm(plant, PSM, table, RigidTransform([0, 0, 0.1]))
    plant.Finalize()
    np.testing.assert_array_equal(plant.gravity_field().gravity_vector(), [0, 0, -1.62])
    X_WB = plant.GetFrameByName("base_link", instance).CalcPoseInWorld(plant.CreateDefaultContext())
    assert X_WB.IsNearlyEqualTo(X_WP @ RigidTransform([0, 0, 0.1]), 1e-12)


def test_wrong_gravity_is_refused():
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(arm_plant_config(), builder)
    instance = add_arm(plant, PSM, X_PB=X_WP)
    plant.Finalize()
    with pytest.raises(StationError, match=r"gravity in the frame of the base is .* use arm.with_gravity\(\["):
        add_arm_drive(builder, plant, PSM, instance)
    assert add_arm_drive(builder, plant, TILTED_PSM, instance).effort_commanded.size() == PSM.num_joints


def test_solver_without_constraints_is_refused():
    tamsi = getattr(DiscreteContactApproximation, "kTamsi", None)
    if tamsi is None:
        pytest.skip("this version of drake has no tamsi")
    plant = MultibodyPlant(1e-3)
    plant.set_discrete_contact_approximation(tamsi)
    with pytest.raises(ArmError, match="tamsi; a linkage needs sap"):
        add_arm(plant, PSM)


def test_effects_of_another_arm_or_plant_are_refused():
    builder = DiagramBuilder()
    sampled, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=1e-3), DiagramBuilder())
    with pytest.raises(StationError, match="use_sampled_output_ports must be false"):
        PlantEffects(sampled, PSM, add_arm(sampled, PSM), PSM.effects)
    plant, _ = AddMultibodyPlant(arm_plant_config(), builder)
    left, right = (add_arm(plant, PSM) for _ in range(2))
    effects = PlantEffects(plant, PSM, left, PSM.effects)
    plant.Finalize()
    with pytest.raises(StationError, match="the effects belong to another arm than psm_1"):
        add_arm_drive(builder, plant, PSM, right, effects)
    builder.ExportInput(plant.get_applied_generalized_force_input_port())
    with pytest.raises(StationError, match="applied_generalized_force of the plant is exported"):
        add_arm_drive(builder, plant, PSM, left, effects)


def test_floating_body_of_an_arm_is_refused():
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(arm_plant_config(), builder)
    instance = add_arm(plant, PSM)
    plant.AddRigidBody("ball", instance, SpatialInertia.SolidSphereWithMass(0.1, 0.03))
    plant.Finalize()
    with pytest.raises(StationError, match="psm: the model instance of an arm has a floating body"):
        add_arm_drive(builder, plant, PSM, instance)
