"""From the effort that is commanded to what motors apply and what is measured of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import Adder, DiscreteTimeDelay, MatrixGain, Saturation

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, DelayEffect, EffortEffect, per_actuator
from dvrk_drake.systems.real_arm.noise_source import NoiseSource
from dvrk_drake.systems.real_arm.quantizer import Quantizer


def add_motor_channel(
    builder: DiagramBuilder, arm: Arm, effects: ArmEffects, commanded: OutputPort, time_step: float, seed: int
) -> tuple[OutputPort, OutputPort]:
    """What the motors make of the efforts (n) on the joints that are `commanded`; both results are on the joints too.

    In the actuators' coordinates: the command's delay, its steps, the motors' saturation; then, of what is measured,
    noise, steps and delay. The same `seed` gives the same noise, bit for bit; it is new in every time step.

    Args:
        builder: of the station.
        arm: whose transmission it is.
        effects: of which `delay`, `effort` and `saturation` count.
        commanded: after the limits of the joints.
        time_step: of the plant [s].
        seed: of the noise.

    Returns:
        the applied efforts, and the measured ones.
    """
    if effects.delay is None and effects.effort is None and not effects.saturation:
        return commanded, commanded
    names, n = arm.joint_names, arm.num_joints
    delay, effort = effects.delay or DelayEffect(), effects.effort or EffortEffect()
    J = arm.transmission.matrix

    def behind(port: OutputPort, system: System, name: str) -> OutputPort:
        builder.AddNamedSystem(name, system)
        builder.Connect(port, system.get_input_port(0))
        return system.get_output_port()

    def table(values: dict[str, float]) -> NDArray[np.float64]:
        return per_actuator(values, names, 0.0)

    motors = behind(commanded, MatrixGain(D=np.linalg.inv(J).T), "to_motors")
    if delay.command:
        # Its input comes out a step later by itself: the plant steps while it is stored.
        motors = behind(motors, DiscreteTimeDelay(time_step, delay.command - 1, n), "command_delay")
    if effort.command_resolution:
        motors = behind(motors, Quantizer(table(effort.command_resolution)), "command_steps")
    if effects.saturation:
        limit = per_actuator(effects.saturation, names, np.inf)
        motors = behind(motors, Saturation(min_value=-limit, max_value=limit), "motor_saturation")
    measured = motors
    if delay.measurement:
        # Before noise and steps: these are computed only when somebody reads the port.
        measured = behind(measured, DiscreteTimeDelay(time_step, delay.measurement - 1, n), "measurement_delay")
    if effort.noise:
        source = builder.AddNamedSystem("noise", NoiseSource(table(effort.noise), time_step, seed))
        total = builder.AddNamedSystem("noisy_effort", Adder(2, n))
        builder.Connect(measured, total.get_input_port(0))
        builder.Connect(source.get_output_port(), total.get_input_port(1))
        measured = total.get_output_port()
    if effort.measured_resolution:
        measured = behind(measured, Quantizer(table(effort.measured_resolution)), "measured_steps")
    return behind(motors, MatrixGain(D=J.T), "to_joints"), behind(measured, MatrixGain(D=J.T), "measured_effort")
