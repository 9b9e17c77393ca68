"""Controller process for tests that regulates the first received pose of the arm with effort commands.

    python lcm_controller.py ARM [--lcm-url URL]

The process uses real-time scheduling if that is permitted.
"""

import sys

import lcm
import numpy as np
from effort_controller import effort_command

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.pace import make_realtime
from dvrk_drake.systems.lcm.messages import draw_id


class Controller:
    def __init__(self, arm_name: str, url: str) -> None:
        self.arm = load_arm(arm_name)
        self.kp, self.kd = np.array(self.arm.gains.kp), np.array(self.arm.gains.kd)
        self.sender_id, self.sequence = draw_id(), 0
        self.held = None
        self.lcm = lcm.LCM(url)
        self.lcm.subscribe(f"DVRK_STATUS_{self.arm.name}", self.answer)

    def answer(self, channel: str, data: bytes) -> None:
        status = lcmt_dvrk_status.decode(data)
        q, v = np.array(status.position), np.array(status.velocity)
        if self.held is None:
            self.held = q, np.array(status.effort_measured)
        q_held, effort = self.held
        self.sequence += 1
        effort = effort + self.kp * (q_held - q) - self.kd * v
        command = effort_command(status, effort, self.sender_id, self.sequence)
        self.lcm.publish(f"DVRK_COMMAND_{self.arm.name}", command.encode())


def main(arguments: list[str]) -> None:
    make_realtime()  # before LCM starts its reading thread
    url = arguments[arguments.index("--lcm-url") + 1] if "--lcm-url" in arguments else ""
    controller = Controller(arguments[0], url)
    while True:
        controller.lcm.handle()


def flood(arguments: list) -> None:
    """Publishes one valid command of another sender at maximum rate. Arguments: URL, encoded status to answer."""
    url, data = arguments
    network, status = lcm.LCM(url), lcmt_dvrk_status.decode(data)
    command = effort_command(status, [0.0] * status.num_joints, draw_id(), 2)
    command.utime = 1
    message = command.encode()
    while True:
        network.publish(f"DVRK_COMMAND_{status.arm_name}", message)


if __name__ == "__main__":
    main(sys.argv[1:])
