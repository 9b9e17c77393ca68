"""Simulated arm with static friction, and a collector that moves the arm without a network."""

from concurrent.futures import Executor, Future

import numpy as np

from dvrk_drake.analysis.excitation.pose_file import CollectionFile
from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.collector import CollectionSettings, Collector
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.lcm.messages import fill_in_guard

PERIOD = 1e-3


class Disk(Executor):
    """Replacement for the writing thread, so that no test depends on a disk.

    Work is done immediately, or with `slow` when `finish` is called.
    """

    def __init__(self, slow=False):
        self.slow, self.waiting = slow, []

    def submit(self, work, *arguments):
        future = Future()
        self.waiting.append((future, work, arguments))
        if not self.slow:
            self.finish()
        return future

    def finish(self):
        while self.waiting:
            future, work, arguments = self.waiting.pop(0)
            try:
                future.set_result(work(*arguments))
            except Exception as error:
                future.set_exception(error)


def random_poses(arm, count, seed=0, margin=0.1):
    return arm.sample_poses(count, np.random.default_rng(seed), margin=margin)


class StickyArm:
    """Arm with decoupled joints, gravity and static friction. Its efforts equal the commands."""

    def __init__(self, arm, model, friction, q):
        self.arm, self.model, self.friction = arm, model, friction
        self.inertia = np.array(arm.gains.kd) ** 2 / (4 * np.array(arm.gains.kp))  # critically damped
        self.q, self.v, self.effort = q.copy(), np.zeros(len(q)), model.holding_torque(q)
        self.ticks, self.sender_id, self.acts, self.off = 0, 0, False, False

    def status(self):
        status = Status()
        status.arm_name, status.num_joints = self.arm.name, len(self.q)
        status.sequence, status.utime = self.ticks, 1000 * self.ticks
        status.position, status.velocity = self.q.tolist(), self.v.tolist()
        status.effort_measured = self.effort.tolist()
        status.guard_state = Status.STATE_EFFORT if self.acts else Status.STATE_HOLD
        status.command_sender_id = self.sender_id
        return status

    def step(self, command):
        self.ticks += 1
        self.sender_id, self.acts = command.sender_id, self.ticks > 250 and not self.off
        if self.acts:
            self.move(command.effort)

    def move(self, effort):
        """Advances the motion by one period under an effort (n,)."""
        self.effort = np.array(effort)
        drive = self.effort - self.model.holding_torque(self.q)
        dv = PERIOD / self.inertia
        moved = self.v + dv * drive
        # Friction reduces the velocity at most to zero.
        self.v = np.sign(moved) * np.maximum(np.abs(moved) - dv * self.friction, 0)
        self.q = self.q + PERIOD * self.v


class GuardedArm(StickyArm):
    """StickyArm with a guard that resumes automatically. The clock advances by one period per step.

    tests/processes/test_control.py tests guards that require an operator to resume.
    """

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.guard = CommandGuard(self.arm, 7, ControlModel(self.model), GuardSettings(resume_automatically=True))
        self._step_guard()

    def status(self):
        status = super().status()
        status.accepted_modes = self.guard.accepted_modes
        fill_in_guard(status, self.guard)
        return status

    def step(self, command=None):
        """Advances by one period. `command` is received first if it is not None."""
        if command is not None:
            self.guard.receive(command, 1000 * self.ticks)
        self.acts = self.guard.state == Status.STATE_EFFORT
        if self.acts:
            self.move(self.guard.output.effort)
        self.ticks += 1
        self._step_guard()

    def _step_guard(self):
        self.guard.step(1000 * self.ticks, 1000 * self.ticks, self.q, self.v, self.effort)


def make_collector(path, poses, friction, both_sides=True, *, arm_type=StickyArm, **options):
    arm = load_arm("mtml")
    model = IdentifiedModel.from_arm(arm)
    controller = ArmController(arm, model, "hold", PERIOD)
    sticky = arm_type(arm, model, friction, poses[0] * 0.9)
    output = CollectionFile(path, arm, both_sides)
    settings = CollectionSettings(1.0, both_sides)
    return Collector(poses, controller, output, settings, **{"writer": Disk()} | options), controller, sticky


def run_collector(collector, controller, sticky, seconds, until=lambda: False):
    """Runs a collection for at most `seconds`, until it is finished or `until` returns true."""
    end = sticky.ticks + seconds / PERIOD
    while not (collector.finished or until()) and sticky.ticks < end:
        status, time = sticky.status(), PERIOD * sticky.ticks
        sticky.step(controller.answer(status, time, collector.update(status, time)))


def near_poses(count=3):
    """Returns poses (count, 7) for which a one-sided collection takes about 1.3 s each."""
    return np.array([0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5]) + 0.05 * np.arange(count)[:, None]


def make_quick(tmp_path, **options):
    return make_collector(tmp_path / "o.csv", near_poses(), np.zeros(7), both_sides=False, **options)
