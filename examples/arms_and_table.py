"""Two master arms, a patient-side arm, a table and a ball in one plant, with one controller per arm, in Meshcat."""

import sys

import numpy as np
from pydrake.geometry import Box, MeshcatVisualizer, Sphere, StartMeshcat
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import dvrk_drake as dvrk

builder = DiagramBuilder()
# Without sampled output ports, a command acts after its measurement, as on a real arm.
config = MultibodyPlantConfig(time_step=1e-3, use_sampled_output_ports=False)
plant, scene_graph = AddMultibodyPlant(config, builder)

# The patient-side arm is tilted by 30 degrees. Its model uses gravity in the frame of its base.
X_WP = RigidTransform(RollPitchYaw(np.deg2rad(30), 0, 0), [0.0, 0.6, 0.6])
tilted_gravity = X_WP.rotation().inverse() @ plant.gravity_field().gravity_vector()
arms = [
    (dvrk.load_arm("mtml"), RigidTransform([-0.4, -0.5, 0.8])),
    (dvrk.load_arm("mtmr"), RigidTransform([0.4, -0.5, 0.8])),
    (dvrk.load_arm("psm").with_gravity(tilted_gravity), X_WP),
]
instances = [dvrk.add_arm(plant, arm, X_PB=X_PB, collision_shapes=False) for arm, X_PB in arms]

friction = CoulombFriction(0.5, 0.5)
X_WT = RigidTransform([0.0, 0.6, -0.05])
plant.RegisterCollisionGeometry(plant.world_body(), X_WT, Box(0.6, 0.6, 0.1), "table", friction)
plant.RegisterVisualGeometry(plant.world_body(), X_WT, Box(0.6, 0.6, 0.1), "table", np.array([0.7, 0.6, 0.5, 1.0]))
ball = plant.AddRigidBody("ball", plant.AddModelInstance("ball"), SpatialInertia.SolidSphereWithMass(0.05, 0.03))
plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.03), "ball", friction)
plant.RegisterVisualGeometry(ball, RigidTransform(), Sphere(0.03), "ball", np.array([0.9, 0.4, 0.1, 1.0]))
plant.SetDefaultFloatingBaseBodyPose(ball, RigidTransform([0.1, 0.5, 0.4]))
plant.Finalize()

drives = []
for (arm, _), instance in zip(arms, instances, strict=True):
    drive = dvrk.add_arm_drive(builder, plant, arm, instance)
    controller = dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm))
    controller.set_name(f"{arm.name.lower()}_controller")
    builder.AddSystem(controller)
    builder.Connect(drive.state_estimated, controller.GetInputPort("state_estimated"))
    builder.Connect(controller.GetOutputPort("effort"), drive.effort_commanded)
    drives.append(drive)

meshcat = StartMeshcat()
meshcat.SetCameraPose([1.3, 1.5, 1.2], [0.0, 0.1, 0.4])
MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
simulator = Simulator(builder.Build())
root = simulator.get_mutable_context()
context = plant.GetMyMutableContextFromRoot(root)
poses = [0.5 * (arm.position_lower + arm.position_upper) for arm, _ in arms]
for (arm, _), instance, q in zip(arms, instances, poses, strict=True):
    dvrk.set_arm_positions(plant, context, arm, q, instance)  # the controllers regulate these poses
simulator.set_target_realtime_rate(1.0 if sys.stdin.isatty() else 0.0)
simulator.AdvanceTo(2.0)
for (arm, _), drive, q in zip(arms, drives, poses, strict=True):
    port = drive.state_estimated
    q_end = port.Eval(port.get_system().GetMyContextFromRoot(root))[: arm.num_joints]
    print(f"{arm.name} moved by at most {1e3 * abs(q_end - q).max():.3f} mrad or mm")
print(f"height of the ball [m] {ball.EvalPoseInWorld(context).translation()[2]:.3f}")
if sys.stdin.isatty():  # the page exists only while this script runs
    input(f"{meshcat.web_url()} shows the arms. Press Enter to end. ")
