"""Several arms and other objects in one plant."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ArmError, StationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import add_arm, set_arm_positions
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config
from dvrk_drake.systems.ideal_drive import add_arm_drive

pytestmark = pytest.mark.drake_api

MTML, PSM = load_arm("mtml"), load_arm("psm")
X_WP = RigidTransform(RollPitchYaw(0.5, 0.2, 0.1), [0.0, 1.0, 0.6])
TILTED_PSM = PSM.with_gravity(X_WP.rotation().inverse() @ [0, 0, -9.81])
EFFORTS = {"MTML": [0.1, 0.2, -0.2, 0.02, 0.01, 0.01, 0.001], "PSM": [0.3, -0.4, 0.5, 0.01, 0.01, -0.01, 0.01]}


def alone(arm, q, steps):
    """Returns the state (2n,) of an arm in its station after constant efforts."""
    station = ArmStation(arm)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.SetPositions(context, q)
    station.GetInputPort(f"{arm.name.lower()}.effort_commanded").FixValue(context, EFFORTS[arm.name])
    simulator.AdvanceTo(1e-3 * steps)
    return station.GetOutputPort(f"{arm.name.lower()}.state_estimated").Eval(context)


def test_arms_beside_others_move_as_alone():
    """A floating body comes first, so that positions and velocities have different indices."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(arm_plant_config(), builder)
    ball = plant.AddRigidBody("ball", plant.AddModelInstance("ball"), SpatialInertia.SolidSphereWithMass(0.1, 0.03))
    arms = [MTML, TILTED_PSM, MTML]
    poses = [arm.sample_poses(1, np.random.default_rng(k), margin=0.2)[0] for k, arm in enumerate(arms)]
    mounts = [RigidTransform([1.0, 0, 0]), X_WP, RigidTransform([-1.0, 0, 0])]
    instances = [add_arm(plant, arm, X_PB=X, collision_shapes=False) for arm, X in zip(arms, mounts, strict=True)]
    plant.Finalize()
    drives = [add_arm_drive(builder, plant, arm, instance) for arm, instance in zip(arms, instances, strict=True)]
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    context = plant.GetMyMutableContextFromRoot(root)
    for arm, instance, drive, q in zip(arms, instances, drives, poses, strict=True):
        set_arm_positions(plant, context, arm, q, instance)
        port = drive.effort_commanded
        port.FixValue(port.get_system().GetMyMutableContextFromRoot(root), EFFORTS[arm.name])
    simulator.AdvanceTo(0.03)
    for arm, drive, q in zip(arms, drives, poses, strict=True):
        port = drive.state_estimated
        state = port.Eval(port.get_system().GetMyContextFromRoot(root))
        assert np.abs(state[arm.num_joints :]).max() > 0.01
        np.testing.assert_allclose(state, alone(arm, q, 30), atol=1e-6)
    fallen = ball.EvalPoseInWorld(context).translation()[2]
    assert fallen == pytest.approx(-9.81 * 0.5 * 0.03**2, rel=0.05)


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
