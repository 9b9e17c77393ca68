"""Drive with simulated effects, between a plant and the ports of the station."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import DiscreteTimeDelay, PassThrough

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, DelayEffect
from dvrk_drake.systems.arm_effects.drive_force import DriveForce, EffortSensor, Motors
from dvrk_drake.systems.arm_effects.drive_step import DriveStep
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.ideal_drive import DrivePorts, PlantJoints, add_true_state


@dataclass(frozen=True)
class DriveWithEffects:
    """Arguments of `add_drive_with_effects`.

    Attributes:
        arm: Simulated arm.
        plant: Finalized plant.
        instance: Model instance of the arm in the plant.
        joints: Joints of the arm in the plant.
        parts: Effects that were added to the plant.
        effects: All effects of the arm.
        seed: Seed of the noise.
        home: Pose (n,) [rad, m] of the arm at rest before the start.
    """

    arm: Arm
    plant: MultibodyPlant
    instance: ModelInstanceIndex
    joints: PlantJoints
    parts: PlantEffects
    effects: ArmEffects
    seed: int
    home: NDArray[np.float64]


def add_drive_with_effects(builder: DiagramBuilder, drive: DriveWithEffects) -> tuple[DrivePorts, DriveStep]:
    """Adds the systems of the drive and connects the inputs of the plant.

    Returns:
        Ports of the drive, and the system that computes the measured state.

    Raises:
        StationError: The plant has a floating body.
    """
    if drive.plant.num_positions() != drive.plant.num_velocities():
        raise StationError("with effects, modify_plant must not add floating bodies. Weld them to the arm")
    drive.parts.finish(drive.joints)
    plant, delay = drive.plant, drive.effects.delay or DelayEffect()
    step = builder.AddNamedSystem("drive_step", DriveStep(drive.arm, drive.parts, drive.effects, drive.home))
    builder.Connect(plant.get_state_output_port(), step.get_input_port())
    if drive.parts.needs_desired_state:
        builder.Connect(step.GetOutputPort("desired_state"), plant.get_desired_state_input_port(drive.instance))
    state = add_true_state(builder, plant, drive.joints)
    motors = Motors(drive.arm, drive.effects, drive.joints.effort_limits)
    # The input of the PassThrough is optional. If this input is unconnected, the output is zero.
    commanded = builder.AddNamedSystem("effort_commanded", PassThrough(drive.arm.num_joints))
    force = builder.AddNamedSystem("drive_force", DriveForce(drive.arm, motors, drive.parts, drive.effects))
    at_motors = _add_delay(builder, "command_delay", delay.command, commanded.get_output_port(), drive)
    builder.Connect(at_motors, force.GetInputPort("effort_commanded"))
    builder.Connect(plant.get_state_output_port(), force.GetInputPort("plant_state"))
    builder.Connect(force.get_output_port(), plant.get_applied_generalized_force_input_port())
    sensor = EffortSensor(drive.arm, motors, drive.effects.effort, drive.parts.time_step, drive.seed)
    builder.AddNamedSystem("effort_sensor", sensor)
    builder.Connect(
        _add_delay(builder, "measurement_delay", delay.measurement, at_motors, drive), sensor.get_input_port()
    )
    ports = DrivePorts(
        effort_commanded=commanded.get_input_port(),
        effort_disturbance=force.GetInputPort("effort_disturbance"),
        effort_measured=sensor.get_output_port(),
        state_true=state,
        state_estimated=step.GetOutputPort("state_estimated"),
    )
    return ports, step


def _add_delay(builder: DiagramBuilder, name: str, steps: int, port: OutputPort, drive: DriveWithEffects) -> OutputPort:
    if steps == 0:
        return port
    # The delay system samples its input, which already causes a delay of one step.
    delay = builder.AddNamedSystem(name, DiscreteTimeDelay(drive.parts.time_step, steps - 1, drive.arm.num_joints))
    builder.Connect(port, delay.get_input_port())
    return delay.get_output_port()
