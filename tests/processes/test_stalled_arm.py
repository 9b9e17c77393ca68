"""Simulated arm with a stopped bridge, process or controller: state of the guard and motion of the arm."""

from unittest import mock

import numpy as np
import pytest
from forked import run_forked
from lcm_arm import POSES

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.simulated_arm import SimulatedArm
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.lcm.sim_dvrk_driver import DvrkArmServer

STALLS = pytest.mark.parametrize("seconds", [0.02, 0.05, 0.2, 1.0])
#: Largest motion of an arm at rest, from the beginning of a stall until 0.5 s after it [rad, m].
MAX_DISTANCE_AT_REST = 1e-4
#: Speed of the first joint [rad/s]. Largest distance in addition to speed times stall [rad].
SPEED, MAX_DISTANCE_BEYOND = 0.1, 0.01


class Loop:
    """SimulatedArm with the controller of `control --mode hold` and an injected wall clock, at 1 kHz.

    The start takes longer than a stall. Each test forks the process, so that its stall changes only a copy.
    """

    def __init__(self, name, speed=0.0):
        arm = load_arm(name)
        self.wall, self.time, self.motion_time, self.status = 10**9, 0.0, 0.0, Status()
        self.is_bridge_stopped = False
        methods = {name: self.unless_stopped(getattr(DvrkArmServer, name)) for name in ("_update", "_store_effort")}
        with mock.patch.multiple(DvrkArmServer, **methods):
            self.arm = SimulatedArm(arm, DvrkDriver(lcm_url="memq://"), POSES[name], wall_clock=lambda: self.wall)
        self.controller = ArmController(arm, IdentifiedModel.from_arm(arm), "hold", 1e-3)
        self.velocity = speed * np.eye(arm.num_joints)[0]
        self.moved = []
        for _ in range(900):  # start check, then 0.6 s of motion or rest
            self.tick()
        assert self.status.guard_state == Status.STATE_EFFORT

    def unless_stopped(self, method):
        """Returns a method of the receiver that does nothing while the bridge is stopped. Its outputs are kept."""

        def call(receiver, *arguments):
            if not self.is_bridge_stopped:
                method(receiver, *arguments)

        return call

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
            self.motion_time += 1e-3
            desired = np.concatenate(
                [POSES[self.status.arm_name.lower()] + self.motion_time * self.velocity, self.velocity]
            )
        if answers:
            self.arm.receive("", self.controller.answer(self.status, self.time, desired).encode())

    def stall_bridge(self, seconds):
        """The guard is not stepped and no status is sent. The motors apply the last commanded efforts, as on a dVRK."""
        self.wait(seconds)
        self.is_bridge_stopped = True
        for _ in range(round(1e3 * seconds)):
            self.arm.step()
        self.is_bridge_stopped = False

    def stall_process(self, seconds):
        """The arm's clock and the simulation stand still, as when `dvrk-drake sim-arm` is stopped."""
        self.wait(seconds)

    def stall_controller(self, seconds):
        for _ in range(round(1e3 * seconds)):
            self.tick(answers=False)

    def check(self, continues, before):
        """Checks the state after a stall. Returns the largest motion since `before` and in the last 0.1 s [rad, m]."""
        for _ in range(500):
            self.tick()
        if continues:
            assert (self.status.guard_state, self.status.fault_text) == (Status.STATE_EFFORT, "")
            assert self.status.num_expired == 0
        else:
            # The controller continues to send commands, which the guard refuses.
            assert (self.status.guard_state, self.status.fault_code) == (Status.STATE_HOLD, Status.FAULT_NONE)
            assert self.status.fault_text.startswith("the last command expired: ")
            assert (self.status.refusal_code, self.status.num_expired) == (Status.REFUSAL_RESUME, 1)
        since = np.abs(np.array(self.moved[before:]) - self.moved[before - 1])
        return since.max(), np.ptp(since[-100:], axis=0).max()


@pytest.fixture(scope="module", params=["mtml", "psm"])
def at_rest(request):
    return Loop(request.param)


@pytest.fixture(scope="module", params=["mtml", "psm"])
def moving(request):
    return Loop(request.param, SPEED)


@pytest.mark.parametrize("side", ["bridge", "process", "controller"])
@STALLS
def test_arm_at_rest_stays_at_rest_during_stalls(at_rest, side, seconds):
    """After a stall of 20 ms, the control continues. From 50 ms on, the arm holds until an operator resumes."""

    def stall():
        before = len(at_rest.moved)
        getattr(at_rest, f"stall_{side}")(seconds)
        farthest, _ = at_rest.check(seconds < 0.05, before)
        assert farthest < MAX_DISTANCE_AT_REST

    run_forked(stall)


@pytest.mark.parametrize("side", ["bridge", "process", "controller"])
@pytest.mark.parametrize("seconds", [0.05, 0.2])
def test_moving_arm_comes_to_rest_after_stalls(moving, side, seconds):
    """The motion is bounded by the expiry for a stopped controller, and by the stall for a stopped bridge.

    A stall of the bridge of 1 s is not tested, because its process cannot limit the efforts. The roll of a moving MTM
    would rotate by several rad in this time.
    """

    def stall():
        before = len(moving.moved)
        getattr(moving, f"stall_{side}")(seconds)
        acted = {"bridge": seconds, "process": 0.0, "controller": 0.05}[side]
        farthest, last = moving.check(False, before)
        assert farthest < SPEED * acted + MAX_DISTANCE_BEYOND
        assert last < 5e-3  # slow approach of the held pose

    run_forked(stall)
