"""An arm process and its controllers over real UDP multicast, in a network of their own.

Run by itself, this file starts itself again inside a network namespace; the tests of that run are the real ones.
"""

import signal
import sys
import threading
import time
from pathlib import Path

import lcm
import numpy as np
import pytest
from own_network import end, inside, outside, run_inside, start

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.processes.pace import make_realtime
from dvrk_drake.systems.dvrk_command_sender import draw_id

POSES = {"mtml": [0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5], "psm": [0.2, -0.3, 0.1, 0.5, 0.2, -0.3, 0.3]}


@outside
def test_in_a_network_of_its_own():
    run_inside(__file__)


class Observer:
    """What an arm says, with the time of arrival, gathered by a thread."""

    def __init__(self, name):
        self.heard = []
        self.lcm = lcm.LCM()
        subscription = self.lcm.subscribe(f"DVRK_STATUS_{name.upper()}", self.hear)
        subscription.set_queue_capacity(0)  # no limit: none may be lost here
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self):
        while True:
            self.lcm.handle()

    def hear(self, channel, data):
        self.heard.append((time.monotonic(), Status.decode(data)))

    @property
    def last(self):
        return self.heard[-1][1]

    def until(self, condition, seconds, what):
        """Waits for a status that meets the condition."""
        end = time.monotonic() + seconds
        seen = len(self.heard)
        while time.monotonic() < end:
            for k in range(seen, len(self.heard)):
                if condition(self.heard[k][1]):
                    return k
            seen = len(self.heard)
            time.sleep(1e-3)
        last = self.last if self.heard else Status()
        raise AssertionError(f"{what}: not within {seconds} s; state {last.guard_state}, refusal {last.refusal_code}")


def start_arm(name):
    pose = [str(q) for q in POSES[name]]
    return start(sys.executable, "-m", "dvrk_drake.cli", "arm", "--arm", name, "--realtime", "--pose", *pose)


def start_controller(name, *options):
    return start(sys.executable, str(Path(__file__).with_name("lcm_controller.py")), name, *options)


@pytest.fixture(scope="module", params=["mtml", "psm"])
def arm(request):
    """A running arm: its name, its process, what it says."""
    observer = Observer(request.param)
    process = start_arm(request.param)
    observer.until(lambda status: True, 90, "first status")
    yield request.param, process, observer
    said = end(process, signal.SIGINT)
    assert process.returncode == 0, said
    assert "ended" in said


def drift(name, status):
    return np.abs(np.array(status.position) - POSES[name]).max()


def reset(name, observer):
    """Clears a fault: HOLD, HOLD, HOLD with the request."""
    network, sender_id = lcm.LCM(), draw_id()
    time.sleep(0.1)  # whoever commanded before is silent by then
    for k, asks in enumerate((False, False, True)):
        status, command = observer.last, Command()
        command.utime, command.sequence, command.sender_id = time.monotonic_ns() // 1000, k, sender_id
        command.session_id, command.status_utime = status.session_id, status.utime
        command.arm_name, command.num_joints, command.control_mode = status.arm_name, status.num_joints, Command.HOLD
        command.position = command.velocity = command.effort = [0.0] * status.num_joints
        command.reset_fault = asks
        network.publish(f"DVRK_COMMAND_{name.upper()}", command.encode())
        time.sleep(0.01)
    observer.until(lambda status: status.guard_state == Status.STATE_HOLD, 5, "reset")


@inside
def test_command_and_status_go_round(arm):
    name, _, observer = arm
    controller = start_controller(name, "--echo")
    try:
        observer.until(lambda status: status.num_accepted > 0, 60, "first command")
        first = len(observer.heard)
        observer.until(lambda status: status.num_accepted > 2000, 60, "2000 commands")
    finally:
        end(controller)
    heard = [status for _, status in observer.heard[first:]]
    sequences = np.array([status.sequence for status in heard])
    assert np.all(np.diff(sequences) == 1)
    assert np.all(np.diff([status.utime for status in heard]) == 1000)
    assert all(status.guard_state == Status.STATE_HOLD for status in heard)
    assert heard[-1].num_refused == 0
    assert heard[-1].command_sequence > 2000
    assert drift(name, heard[-1]) < 1e-4


@inside
def test_a_killed_controller_is_followed_by_a_hold(arm):
    name, _, observer = arm
    realtime = make_realtime() == ""
    controller = start_controller(name)
    try:
        observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 60, "start of the controller")
        time.sleep(1.0)
        assert observer.last.guard_state == Status.STATE_EFFORT
        controller.send_signal(signal.SIGKILL)
        killed, first = time.monotonic(), len(observer.heard)
    finally:
        end(controller)
    held = observer.until(lambda status: status.guard_state == Status.STATE_HOLD, 5, "hold")
    last_command = max(
        k for k in range(held) if observer.heard[k][1].num_accepted < observer.heard[held][1].num_accepted
    )
    on_its_clock = 1e-6 * (observer.heard[held][1].utime - observer.heard[last_command][1].utime)
    after_kill = observer.heard[held][0] - killed
    time.sleep(2.0)
    worst = max(drift(name, status) for _, status in observer.heard[first:])
    print(f"{name}: hold {1e3 * on_its_clock:.1f} ms after the last command, {1e3 * after_kill:.1f} ms after the kill")
    print(f"{name}: drift {1e3 * worst:.3g} mrad or mm; real-time scheduling: {realtime}")
    assert on_its_clock <= 0.060
    if realtime:
        assert after_kill <= 0.060
    assert worst < 1e-3
    assert observer.last.num_expired >= 1


@inside
@pytest.mark.parametrize("mode", ["gravity", "hold"])
def test_run_starts_ramps_in_and_leaves_the_arm_to_its_hold(arm, mode):
    name, _, observer = arm
    expired = observer.last.num_expired
    process = start(sys.executable, "-m", "dvrk_drake.cli", "run", "--arm", name, "--mode", mode, "--realtime")
    try:
        begun = observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 90, "run")
        time.sleep(2.0)
        acting = [status for _, status in observer.heard[begun:]]
    finally:
        said = end(process, signal.SIGINT)
    assert process.returncode == 0, said
    assert {status.guard_state for status in acting} == {Status.STATE_EFFORT}
    efforts = np.array([status.effort_commanded for status in acting])
    assert np.all(np.abs(np.diff(efforts, axis=0)) < 0.01 * load_arm(name).effort_limits)
    assert observer.last.guard_state == Status.STATE_HOLD
    assert observer.last.num_expired == expired  # it was told to hold, it did not have to notice
    assert drift(name, observer.last) < 1e-3
    assert "holds by itself" in said
    assert "effort; " in said and " Hz, round trip " in said
    print(f"{name} {mode}: {said.splitlines()[-3].strip()}")


@inside
def test_run_stops_when_the_arm_faults_and_refuses_one_that_has_a_fault(arm):
    name, _, observer = arm
    process = start(sys.executable, "-m", "dvrk_drake.cli", "run", "--arm", name)
    other = None
    try:
        observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 90, "run")
        other = start_controller(name, "--echo")
        observer.until(lambda status: status.guard_state == Status.STATE_FAULT, 60, "fault")
        assert process.wait(20) == 2
    finally:
        process.kill()
        if other is not None:
            end(other)
    assert "has a fault: senders" in process.stdout.read()
    again = start(sys.executable, "-m", "dvrk_drake.cli", "run", "--arm", name)
    assert again.wait(60) == 2
    assert "It must be reset first" in again.stdout.read()
    reset(name, observer)
    assert drift(name, observer.last) < 1e-3


@inside
def test_garbage_neither_stops_nor_moves_the_arm(arm):
    name, process, observer = arm
    generator = np.random.default_rng(7)
    network = lcm.LCM()
    n = load_arm(name).num_joints
    command = Command()  # of an earlier session, as in a log that is played again
    command.arm_name, command.num_joints, command.control_mode = name.upper(), n, Command.EFFORT
    command.session_id, command.sender_id = draw_id(), draw_id()
    command.position, command.velocity, command.effort = [0.0] * n, [0.0] * n, [1e3] * n
    refused, first = observer.last.num_refused, len(observer.heard)
    for k in range(10_000):
        command.status_utime, command.sequence, command.utime = observer.last.utime, k, observer.last.utime
        data = bytearray(command.encode() if k % 2 else generator.bytes(int(generator.integers(0, 400))))
        for _ in range(generator.integers(0, 6)):
            if data:
                data[generator.integers(len(data))] = generator.integers(256)
        network.publish(f"DVRK_COMMAND_{name.upper()}", bytes(data))
        if k % 20 == 0:
            time.sleep(1e-3)
    time.sleep(0.2)
    assert process.poll() is None
    heard = [status for _, status in observer.heard[first:]]
    assert np.all(np.diff([status.sequence for status in heard]) == 1)
    assert {status.guard_state for status in heard} == {Status.STATE_HOLD}
    assert max(drift(name, status) for status in heard) < 1e-4
    assert heard[-1].num_refused - refused > 9_000  # UDP may lose a few


@inside
def test_two_controllers_are_noticed_and_a_reset_must_be_meant(arm):
    name, _, observer = arm
    first, second = start_controller(name, "--echo"), start_controller(name, "--echo")
    try:
        observer.until(lambda status: status.fault_code == Status.FAULT_DUPLICATE_SENDER, 60, "fault")
    finally:
        end(first)
        end(second)
    time.sleep(0.2)
    assert observer.last.guard_state == Status.STATE_FAULT
    reset(name, observer)
    assert drift(name, observer.last) < 1e-3
