"""Mode guide over a real LCM network: the springs of the controller detach without a step of their efforts."""

import lcm
import numpy as np
import pytest
from guard_bench import ARM
from guarded_arm import GuardedArm

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.systems.lcm.arm_link import LcmArmLink
from dvrk_drake.systems.lcm.messages import handle_message, usable_lcm_url

pytestmark = pytest.mark.network

#: Number of the status at which an event begins. The joints are then at rest, and the springs are deflected.
EVENT = 1000


class NetworkArm(GuardedArm):
    """Arm whose statuses and commands are LCM messages. Each status is answered before the next one is sent."""

    def __init__(self):
        super().__init__()
        url = usable_lcm_url()
        self.network, self.link = lcm.LCM(url), LcmArmLink(ARM, url)
        self.link.now = self.now
        self.network.subscribe(command_channel(ARM), lambda channel, data: self.send(Command.decode(data)))

    def answer(self, guide):
        """Sends a status to the controller, and its command to the guard. Returns the efforts of the springs (n,)."""
        if self.commands:
            self.status.effort_measured = self.commands[-1].effort
        self.network.publish(status_channel(ARM), self.next_status(1.0).encode())
        self.link.send(guide.answer(self.link.next_status(1.0), self.now()))
        assert handle_message(self.network, 1.0)
        context, controller = guide._controller_context, guide._controller
        effort, gravity = (controller.GetOutputPort(name).Eval(context) for name in ("effort", "gravity_effort"))
        return effort - gravity


@pytest.mark.parametrize("event", ["no measurement", "jump", "watchdog hold"])
def test_springs_detach_without_a_step(event):
    arm, guide = NetworkArm(), ArmController(ARM, IdentifiedModel.from_arm(ARM), "guide", 1e-3)
    springs = []
    for k in range(EVENT + 200):
        q = np.array(arm.status.position) + (5e-6 if 700 < k < 900 else 0.0)
        if k == EVENT and event == "watchdog hold":
            arm.utime += 200_000  # no command arrives for 0.2 s
        elif k == EVENT and event == "jump":
            q = q + 0.05
        lost = event == "no measurement" and EVENT <= k < EVENT + 10
        arm.status.position = list(np.full(len(q), np.nan) if lost else q)
        springs.append(arm.answer(guide))
        arm.status.position = list(q)
    if event == "watchdog hold":
        assert guide._controller.GetMode(guide._controller_context) == "gravity"
        np.testing.assert_allclose(arm.commands[-1].effort, arm.status.effort_measured, atol=1e-12)
    before = np.abs(springs[EVENT - 1])
    assert before.max() > 1e-3
    # A detached spring decays with a time constant of 20 ms, so by 5 % per period.
    assert np.all(np.abs(np.diff(springs[EVENT - 1 :], axis=0)) <= 0.06 * before + 1e-9)
    assert np.all(np.abs(springs[-1]) <= 0.01 * before + 1e-9)
