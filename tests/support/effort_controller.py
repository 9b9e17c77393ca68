"""Controller process that answers each status of an arm with small efforts, for tests of a bridge to a dVRK.

    python effort_controller.py ARM [--jaw AMPLITUDE] [--lcm-url URL]

The efforts of the arm are zero. With --jaw, the effort of the last joint follows a sine wave of 0.5 Hz.
"""

import math
import sys
import time

import lcm

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.systems.lcm.messages import draw_id

#: Driver configuration for an arm without dynamics: it measures no effort, although gravity acts on its model.
#: The timeouts are long, so that a busy computer does not end the commands.
LENIENT_DRIVER = """guard:
  {resume_automatically: true, expiry: 0.5, command_age: 0.5, clock_tolerance: 0.5, measurement_age: 0.1,
  longest_period: 1.0, slow_period: 0.02, plausibility: {start_gravity: 2.0, bad_samples: 100}}
"""


def effort_command(status, effort, sender_id, sequence):
    """Returns the command of `effort` (n,) [N m, N] that answers a status."""
    command = lcmt_dvrk_command()
    command.utime, command.sequence, command.sender_id = time.monotonic_ns() // 1000, sequence, sender_id
    command.session_id, command.status_utime = status.session_id, status.utime
    command.arm_name, command.num_joints = status.arm_name, status.num_joints
    command.control_mode = lcmt_dvrk_command.EFFORT
    command.position, command.velocity = [0.0] * status.num_joints, [0.0] * status.num_joints
    command.effort = list(effort)
    return command


def main(arguments):
    """Answers statuses until the process is ended."""

    def option(name, default):
        return arguments[arguments.index(name) + 1] if name in arguments else default

    arm, amplitude = load_arm(arguments[0]), float(option("--jaw", "0"))
    network, sender_id, sequence = lcm.LCM(option("--lcm-url", "")), draw_id(), 0

    def answer(channel, data):
        nonlocal sequence
        sequence += 1
        effort = [0.0] * arm.num_joints
        effort[-1] = amplitude * math.sin(math.pi * time.monotonic())
        command = effort_command(lcmt_dvrk_status.decode(data), effort, sender_id, sequence)
        network.publish(command_channel(arm), command.encode())

    network.subscribe(status_channel(arm), answer)
    while True:
        network.handle()


if __name__ == "__main__":
    main(sys.argv[1:])
