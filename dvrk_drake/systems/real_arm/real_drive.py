"""The drive of a real arm: the parts of `ArmEffects` between a plant and the ports of its station."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import DiscreteTimeDelay, MatrixGain

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, DelayEffect
from dvrk_drake.systems.ideal_drive import DrivePorts, add_disturbance, add_true_state
from dvrk_drake.systems.joint_effect_torque import JointEffectTorque
from dvrk_drake.systems.plant_joints import PlantJoints
from dvrk_drake.systems.real_arm.drive_step import DriveStep
from dvrk_drake.systems.real_arm.effort_sensor import EffortSensor
from dvrk_drake.systems.real_arm.motor_channel import MotorChannel
from dvrk_drake.systems.real_arm.plant_effects import PlantEffects


@dataclass(frozen=True)
class RealDrive:
    """What `add_real_drive` needs.

    Attributes:
        arm: that is simulated.
        plant: finalized, of which `instance` is the arm, `joints` its joints, `parts` what was added to it.
        effects: all of them.
        seed: of the noise.
        home: (n,) where the arm rests before it starts.
    """

    arm: Arm
    plant: MultibodyPlant
    instance: ModelInstanceIndex
    joints: PlantJoints
    parts: PlantEffects
    effects: ArmEffects
    seed: int
    home: NDArray[np.float64]


def add_real_drive(builder: DiagramBuilder, drive: RealDrive) -> tuple[DrivePorts, DriveStep]:
    """Connects a finalized plant's inputs; returns the ports and the system that knows what was measured."""
    drive.parts.finish(drive.joints)
    plant, delay = drive.plant, drive.effects.delay or DelayEffect()
    step = builder.AddNamedSystem("drive_step", DriveStep(drive.arm, drive.parts, drive.effects, drive.home))
    builder.Connect(plant.get_state_output_port(), step.get_input_port())
    if drive.parts.needs_desired_state:
        builder.Connect(step.GetOutputPort("desired_state"), plant.get_desired_state_input_port(drive.instance))
    state = add_true_state(builder, plant, drive.joints)
    motors = builder.AddNamedSystem("motors", MotorChannel(drive.arm, drive.effects, drive.joints.effort_limits))
    commanded = motors.get_input_port()
    if delay.command:
        late = _delay(builder, "command_delay", delay.command, drive)
        builder.Connect(late.get_output_port(), commanded)
        commanded = late.get_input_port()
    to_plant = _behind(builder, motors.get_output_port(), "to_actuators", MatrixGain(D=drive.parts.from_motors))
    builder.Connect(to_plant, plant.get_actuation_input_port(drive.instance))
    measured = motors.get_output_port()
    if delay.measurement:
        late = _delay(builder, "measurement_delay", delay.measurement, drive)
        builder.Connect(measured, late.get_input_port())
        measured = late.get_output_port()
    sensor = EffortSensor(drive.arm, drive.effects.effort, drive.parts.time_step, drive.seed)
    measured = _behind(builder, measured, "effort_sensor", sensor)
    disturbance = add_disturbance(builder, plant, drive.joints, _cables_and_springs(builder, drive, state))
    return DrivePorts(commanded, disturbance, measured, state, step.GetOutputPort("state_estimated")), step


def _cables_and_springs(builder: DiagramBuilder, drive: RealDrive, state: OutputPort) -> OutputPort | None:
    laws = [*drive.effects.cables, *drive.effects.springs]
    if not laws:
        return None
    effects = [ActuatorEffect(law.coordinate, law.kind, law.scale) for law in laws]
    torque = JointEffectTorque(drive.arm, effects, [law.coefficient for law in laws])
    return _behind(builder, state, "cables_and_springs", torque)


def _delay(builder: DiagramBuilder, name: str, steps: int, drive: RealDrive) -> System:
    # What goes in comes out a step later by itself: the plant steps while it is stored.
    return builder.AddNamedSystem(name, DiscreteTimeDelay(drive.parts.time_step, steps - 1, drive.arm.num_joints))


def _behind(builder: DiagramBuilder, port: OutputPort, name: str, system: System) -> OutputPort:
    builder.AddNamedSystem(name, system)
    builder.Connect(port, system.get_input_port(0))
    return system.get_output_port()
