"""Drive with simulated effects, between a plant and the ports of an arm."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import DiscreteTimeDelay, PassThrough

from dvrk_drake.models.effects_schema import DelayEffect
from dvrk_drake.systems.arm_effects.drive_force import DriveForce, EffortSensor, Motors
from dvrk_drake.systems.arm_effects.drive_step import DriveStep
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.ideal_drive import DrivePorts, PlantJoints, add_generalized_force, add_true_state


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
