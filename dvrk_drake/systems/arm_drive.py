"""Drive of an arm in a plant, which may contain other arms and objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import DiscreteTimeDelay, PassThrough

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DelayEffect
from dvrk_drake.models.plant import base_body, set_arm_positions
from dvrk_drake.systems.arm_effects.drive_force import DriveForce, EffortSensor, Motors
from dvrk_drake.systems.arm_effects.drive_step import DriveStep
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.ideal_drive import (
    DrivePorts,
    PlantJoints,
    add_generalized_force,
    add_ideal_drive,
    add_true_state,
)

#: Largest difference [m/s^2] of the gravity vectors of a plant and of an arm in it: the range of gravity on the surface
#: of the earth is 9.76 to 9.83 m/s^2.
GRAVITY_TOLERANCE = 0.1


@dataclass(frozen=True)
class ArmDrive(DrivePorts):
    """Ports of an arm in a plant, and its pose.

    Attributes:
        plant: Plant with the arm.
        arm: The arm.
        instance: Model instance of the arm.
        joints: Joints of the arm in the plant.
        effects: Simulated effects in the plant. None: the drive is ideal.
        step: System that computes the measured state, if there are effects.
    """

    plant: MultibodyPlant
    arm: Arm
    instance: ModelInstanceIndex
    joints: PlantJoints
    effects: PlantEffects | None
    step: DriveStep | None

    def set_positions(self, diagram: Diagram, context: Context, q: ArrayLike) -> None:
        """Sets the pose of the arm, with its linkage and the joints of its drive, and its velocities to zero.

        Args:
            diagram: Diagram that contains the plant and this drive.
            context: Context of the Diagram.
            q: Pose (n,) [rad, m], which may be outside the limits.

        Raises:
            StationError: q does not have n finite numbers.
        """
        q, plant = np.asarray(q, float), self.plant
        if q.shape != (self.arm.num_joints,) or not np.all(np.isfinite(q)):
            raise StationError(
                f"a pose of {self.arm.name} is {self.arm.num_joints} finite numbers [rad, m]; got {q.tolist()}"
            )
        plant_context = diagram.GetMutableSubsystemContext(plant, context)
        set_arm_positions(plant, plant_context, self.arm, q, self.instance)
        plant.SetVelocities(plant_context, self.instance, np.zeros(plant.num_velocities(self.instance)))
        if self.effects is not None and self.step is not None:
            q_plant = plant.GetPositions(plant_context)
            self.effects.drive.set_positions(q_plant, q)
            plant.SetPositions(plant_context, q_plant)
            self.step.SetAtRest(diagram.GetMutableSubsystemContext(self.step, context), q)


def add_arm_drive(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    arm: Arm,
    instance: ModelInstanceIndex,
    effects: PlantEffects | None = None,
    *,
    seed: int = 0,
) -> ArmDrive:
    """Adds the drive of one arm of a finalized plant, which may contain other arms and objects, to a Diagram.

    The ports are those of `ArmStation` and fit to a `GravityPidController` of the same arm. The drive connects the
    inputs of the arm's model instance, and adds its efforts to the port `applied_generalized_force` of the plant.
    Connect a force of your own to that port before.

    Args:
        builder: Builder of the Diagram that contains the plant.
        plant: Plant to which `add_arm` added the arm.
        arm: The arm. Its gravity vector is that of the plant, in the frame of its base.
        instance: Model instance that `add_arm` returned.
        effects: Simulated effects that were added to the plant for this arm. None: the drive is ideal, i.e. efforts act
            without friction, and measurements are exact.
        seed: Seed of the effects' noise.

    Raises:
        ArmError: The arm has locked joints.
        StationError: The gravity vector of the arm is not that of the plant, so that a controller would compensate a
            wrong gravity; a joint has no motor; or the effects are those of another arm.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
        >>> from pydrake.systems.framework import DiagramBuilder
        >>> builder, arm = DiagramBuilder(), dvrk.load_arm("mtml")
        >>> plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        >>> mtml = dvrk.add_arm(plant, arm)
        >>> plant.Finalize()
        >>> drive = dvrk.add_arm_drive(builder, plant, arm, mtml)
        >>> controller = builder.AddSystem(dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm)))
        >>> builder.Connect(drive.state_estimated, controller.GetInputPort("state_estimated"))
        >>> builder.Connect(controller.GetOutputPort("effort"), drive.effort_commanded)
    """
    arm.refuse_locked_joints("a drive")
    if plant.IsAnchored(base_body(plant, instance)):
        gravity = gravity_at_base(plant, instance)
        if np.linalg.norm(gravity - arm.gravity) > GRAVITY_TOLERANCE:
            expected, found = (", ".join(f"{g:.3f}" for g in vector) for vector in (gravity, arm.gravity))
            raise StationError(
                f"{arm.name}: gravity in the frame of the base is [{expected}] m/s^2 in this plant, but [{found}] in "
                f"the arm, so a controller would compensate a wrong gravity; use arm.with_gravity([{expected}])"
            )
    joints, step = PlantJoints(plant, arm, instance), None
    if effects is None:
        ports = add_ideal_drive(builder, plant, joints, instance)
    elif effects.plant is not plant or effects.instance != instance:
        raise StationError(f"the effects belong to another arm than {plant.GetModelInstanceName(instance)}")
    else:
        ports, step = add_drive_with_effects(builder, effects, joints, seed)
    return ArmDrive(**vars(ports), plant=plant, arm=arm, instance=instance, joints=joints, effects=effects, step=step)


def add_drive_with_effects(
    builder: DiagramBuilder, parts: PlantEffects, joints: PlantJoints, seed: int
) -> tuple[DrivePorts, DriveStep]:
    """Adds the systems of the drive and connects the inputs of the plant.

    Args:
        builder: Builder of the Diagram that contains the plant.
        parts: Effects of the arm in the finalized plant.
        joints: Joints of the arm in the plant.
        seed: Seed of the noise.

    Returns:
        Ports of the drive, and the system that computes the measured state.
    """
    parts.finish(joints)
    plant, arm, instance, effects = parts.plant, parts.arm, parts.instance, parts.effects
    prefix, delay = plant.GetModelInstanceName(instance), effects.delay or DelayEffect()
    step = builder.AddNamedSystem(f"{prefix}_drive_step", DriveStep(parts, len(joints.actuators)))
    builder.Connect(plant.get_state_output_port(instance), step.get_input_port())
    if parts.needs_desired_state:
        builder.Connect(step.GetOutputPort("desired_state"), plant.get_desired_state_input_port(instance))
    state = add_true_state(builder, plant, joints, instance)
    motors = Motors(arm, effects, joints.effort_limits)
    # The input of the PassThrough is optional. If this input is unconnected, the output is zero.
    commanded = builder.AddNamedSystem(f"{prefix}_effort_commanded", PassThrough(arm.num_joints))
    force = builder.AddNamedSystem(f"{prefix}_drive_force", DriveForce(motors, parts, joints))
    at_motors = _add_delay(builder, f"{prefix}_command_delay", delay.command, commanded.get_output_port(), parts)
    builder.Connect(at_motors, force.GetInputPort("effort_commanded"))
    builder.Connect(plant.get_state_output_port(instance), force.GetInputPort("plant_state"))
    add_generalized_force(builder, plant, instance, force.get_output_port())
    sensor = EffortSensor(arm, motors, effects.effort, parts.plant.time_step(), seed)
    builder.AddNamedSystem(f"{prefix}_effort_sensor", sensor)
    measured = _add_delay(builder, f"{prefix}_measurement_delay", delay.measurement, at_motors, parts)
    builder.Connect(measured, sensor.get_input_port())
    ports = DrivePorts(
        effort_commanded=commanded.get_input_port(),
        effort_disturbance=force.GetInputPort("effort_disturbance"),
        effort_measured=sensor.get_output_port(),
        state_estimated=step.GetOutputPort("state_estimated"),
        state_true=state,
    )
    return ports, step


def _add_delay(builder: DiagramBuilder, name: str, steps: int, port: OutputPort, parts: PlantEffects) -> OutputPort:
    if steps == 0:
        return port
    # The delay system samples its input, which already causes a delay of one step.
    delay = builder.AddNamedSystem(name, DiscreteTimeDelay(parts.plant.time_step(), steps - 1, parts.arm.num_joints))
    builder.Connect(port, delay.get_input_port())
    return delay.get_output_port()


def gravity_at_base(plant: MultibodyPlant, instance: ModelInstanceIndex) -> NDArray[np.float64]:
    """Returns the gravity vector (3,) of a finalized plant in the base frame of an arm at the default pose [m/s^2]."""
    R_WB = base_body(plant, instance).EvalPoseInWorld(plant.CreateDefaultContext()).rotation()
    return np.asarray(R_WB.inverse() @ plant.gravity_field().gravity_vector())
