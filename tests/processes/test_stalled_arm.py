"""A simulated arm whose bridge or whose controller is stopped: what the guard does, and how far the arm moves."""

import numpy as np
import pytest
from lcm_arm import POSES

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.simulated_arm import SimulatedArm
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver

STALLS = pytest.mark.parametrize("seconds", [0.02, 0.05, 0.2, 1.0])
#: From the beginning of a stall until 0.5 s after it, of an arm that is held; its efforts balance its weight [rad, m].
MAX_DISTANCE_AT_REST = 1e-4
#: The speed at which the first joint is moved [rad/s], and how far it goes beyond speed times stall [rad]: it is held
#: where it is found and comes to rest.
SPEED, MAX_DISTANCE_BEYOND = 0.1, 0.01


class Loop:
    """A SimulatedArm and the controller of `run --mode hold`, one answer per millisecond of an injected wall clock."""

    def __init__(self, name, speed=0.0):
        arm = load_arm(name)
        self.wall, self.time, self.led, self.status = 10**9, 0.0, 0.0, Status()
        self.arm = SimulatedArm(arm, DvrkDriver(), "memq://", POSES[name], wall_clock=lambda: self.wall)
        self.controller = ArmController(arm, IdentifiedModel.from_arm(arm), "hold", 1e-3)
        self.velocity = speed * np.eye(arm.num_joints)[0]
        self.moved = []
        for _ in range(900):  # from the start on; it holds or is moved for 0.6 s then
            self.tick()
        assert self.status.guard_state == Status.STATE_EFFORT

    def publish(self, channel, data):
        self.status = Status.decode(data)
        self.moved.append(np.array(self.status.position))

    def wait(self, seconds):
        self.wall += round(1e6 * seconds)
        self.time += seconds

    def tick(self, answers=True):
        self.wait(1e-3)
        self.arm.step()
        self.arm.send(self)
        desired = None
        if self.controller.acting:
            self.led += 1e-3
            desired = np.concatenate([POSES[self.status.arm_name.lower()] + self.led * self.velocity, self.velocity])
        if answers:
            self.arm.receive("", self.controller.answer(self.status, self.time, desired).encode())

    def stall_of_the_bridge(self, seconds):
        """Its motors do what was commanded last."""
        self.wait(seconds)
        self.arm.stall(seconds)

    def stall_of_the_process(self, seconds):
        """The arm's clock and its physics stand still with it, as for `dvrk-drake arm` that is stopped."""
        self.wait(seconds)

    def stall_of_the_controller(self, seconds):
        for _ in range(round(1e3 * seconds)):
            self.tick(answers=False)

    def check(self, goes_on, before):
        """The states after a stall; returns the largest movement since `before` and its last 0.1 s [rad, m]."""
        for _ in range(500):
            self.tick()
        if goes_on:
            assert (self.status.guard_state, self.status.fault_text) == (Status.STATE_EFFORT, "")
            assert self.status.num_expired == 0
        else:
            # The controller goes on as if nothing had happened, and is refused.
            assert (self.status.guard_state, self.status.fault_code) == (Status.STATE_HOLD, Status.FAULT_NONE)
            assert self.status.fault_text.startswith("the last command expired: ")
            assert (self.status.refusal_code, self.status.num_expired) == (Status.REFUSAL_RESUME, 1)
        since = np.abs(np.array(self.moved[before:]) - self.moved[before - 1])
        return since.max(), np.ptp(since[-100:], axis=0).max()


@pytest.mark.parametrize("name", ["mtml", "psm"])
@pytest.mark.parametrize("side", ["bridge", "process", "controller"])
@STALLS
def test_an_arm_at_rest_stays_there_whoever_is_stopped(name, side, seconds):
    """After 20 ms it goes on, from 50 ms on it is held until an operator resumes."""
    loop = Loop(name)
    before = len(loop.moved)
    getattr(loop, f"stall_of_the_{side}")(seconds)
    farthest, _ = loop.check(seconds < 0.05, before)
    assert farthest < MAX_DISTANCE_AT_REST


@pytest.mark.parametrize("name", ["mtml", "psm"])
@pytest.mark.parametrize("side", ["bridge", "process", "controller"])
@pytest.mark.parametrize("seconds", [0.05, 0.2])
def test_an_arm_in_motion_comes_to_rest_whoever_is_stopped(name, side, seconds):
    """A bridge that is stopped for a second is not here: nothing in its process can limit what its motors do then.

    With the last effort a moving MTM turns its roll by several rad in that second. The bound of a stopped controller is
    the expiry's, that of a stopped bridge the stall's.
    """
    loop = Loop(name, SPEED)
    before = len(loop.moved)
    getattr(loop, f"stall_of_the_{side}")(seconds)
    acted = {"bridge": seconds, "process": 0.0, "controller": 0.05}[side]
    farthest, last = loop.check(False, before)
    print(f"{name}, {side} stopped for {seconds} s at {SPEED} rad/s: {farthest:.4f} rad or m")
    assert farthest < SPEED * acted + MAX_DISTANCE_BEYOND
    assert last < 5e-3  # it creeps to its pose
