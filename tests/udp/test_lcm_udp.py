"""An arm process and its controllers over real UDP multicast, in a network of their own.

Run by itself, this file starts itself again inside a network namespace; the tests of that run are the real ones.
Processes are forked from one that has compiled everything; where a test starts them by their command line, it says so.
"""

import signal
import subprocess
import time
from pathlib import Path

import lcm
import numpy as np
import pytest
from arm_observer import NETWORK_URL, Observer
from arm_processes import POSES, CommandLine, start_arm, start_controller, start_run
from own_network import inside, outside, run_inside

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.processes.pace import Pace, make_realtime
from dvrk_drake.systems.lcm.dvrk_command_sender import draw_id

OTHER_URL = "udpm://239.255.76.67:7668?ttl=0"
LCM_TOOLS = Path(lcm.__file__).parent / "../bin"


@outside
def test_in_a_network_of_its_own():
    run_inside(__file__)


@pytest.fixture(scope="module", params=["mtml", "psm"])
def running_arm(request):
    observer = Observer(request.param)
    process = start_arm(request.param)
    observer.until(lambda status: True, 90, "first status")
    yield request.param, process, observer
    said = process.end(signal.SIGINT)
    assert process.wait(0) == 0, said
    assert "ended" in said


@pytest.fixture
def arm(running_arm):
    """A running arm that holds: its name, its process, what it says."""
    name, process, observer = running_arm
    if observer.last.guard_state != Status.STATE_HOLD:  # a test before failed
        reset(name, observer)
    return name, process, observer


def drift(name, status):
    return np.abs(np.array(status.position) - POSES[name]).max()


def send(network, status, sequence, sender_id, **fields):
    """A HOLD command that answers `status`, with other fields as given."""
    n, command = status.num_joints, Command()
    command.utime, command.sequence, command.sender_id = time.monotonic_ns() // 1000, sequence, sender_id
    command.session_id, command.status_utime = status.session_id, status.utime
    command.arm_name, command.num_joints, command.control_mode = status.arm_name, n, Command.HOLD
    command.position = command.velocity = command.effort = [0.0] * n
    for field, value in fields.items():
        setattr(command, field, value)
    network.publish(f"DVRK_COMMAND_{status.arm_name.upper()}", command.encode())


def reset(name, observer):
    """Clears a fault: HOLD, HOLD, HOLD with the request; again, as a person would, if one of them came too late."""
    network = lcm.LCM()
    end = time.monotonic() + 5
    while observer.last.guard_state != Status.STATE_HOLD and time.monotonic() < end:
        time.sleep(0.1)  # whoever commanded before is silent by then
        sender_id = draw_id()
        for k, asks in enumerate((False, False, True)):
            send(network, observer.last, k, sender_id, reset_fault=asks)
            time.sleep(0.01)
        time.sleep(0.05)
    assert observer.last.guard_state == Status.STATE_HOLD


@inside
def test_command_and_status_go_round(arm):
    name, _, observer = arm
    controller = start_controller(name, "--echo")
    try:
        observer.until(lambda status: status.num_accepted > 0, 60, "first command")
        first = len(observer.heard)
        observer.until(lambda status: status.num_accepted > 2000, 60, "2000 commands")
    finally:
        controller.end()
    heard = [status for _, status in observer.heard[first:]]
    sequences = np.array([status.sequence for status in heard])
    assert np.all(np.diff(sequences) == 1)
    assert np.all(np.diff([status.utime for status in heard]) == 1000)
    assert all(status.guard_state == Status.STATE_HOLD for status in heard)
    assert heard[-1].num_refused == heard[0].num_refused
    assert heard[-1].command_sequence > 2000
    assert drift(name, heard[-1]) < 1e-4


@inside
def test_a_killed_controller_is_followed_by_a_hold(arm):
    name, _, observer = arm
    realtime = not make_realtime()
    controller = start_controller(name)
    try:
        observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 60, "start of the controller")
        time.sleep(1.0)
        assert observer.last.guard_state == Status.STATE_EFFORT
        controller.send_signal(signal.SIGKILL)
        killed, first = time.monotonic(), len(observer.heard)
    finally:
        controller.end()
    held = observer.until(lambda status: status.guard_state == Status.STATE_HOLD, 5, "hold", first)
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
    starts = CommandLine if (name, mode) == ("mtml", "gravity") else start_run
    process = starts(name, "--mode", mode, "--realtime")
    try:
        begun = observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 90, "run")
        time.sleep(2.0)
        acting = [status for _, status in observer.heard[begun:]]
    finally:
        said = process.end(signal.SIGINT)
    assert process.wait(0) == 0, said
    assert {status.guard_state for status in acting} == {Status.STATE_EFFORT}
    efforts = np.array([status.effort_commanded for status in acting])
    assert np.all(np.abs(np.diff(efforts, axis=0)) < 0.01 * load_arm(name).effort_limits)
    assert observer.last.guard_state == Status.STATE_HOLD
    assert observer.last.num_expired == expired  # it was told to hold, it did not have to notice
    assert drift(name, observer.last) < 1e-3
    assert "holds by itself" in said
    assert "effort; " in said and " Hz, round trip " in said
    print(f"{name} {mode}: {said.splitlines()[-2].strip()}")


@inside
def test_run_stops_when_the_arm_faults_and_refuses_one_that_has_a_fault(arm):
    name, _, observer = arm
    process = start_run(name)
    other = None
    try:
        observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 90, "run")
        other = start_controller(name, "--echo")
        observer.until(lambda status: status.guard_state == Status.STATE_FAULT, 60, "fault")
        assert process.wait(20) == 2
    finally:
        process.end()
        if other is not None:
            other.end()
    assert "has a fault: senders" in process.said()
    again = start_run(name)
    assert again.wait(60) == 2
    assert "It must be reset first" in again.said()
    meant = start_run(name, "--reset")
    try:
        observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 90, "run after the reset")
    finally:
        said = meant.end(signal.SIGINT)
    assert meant.wait(0) == 0, said
    assert f"{name.upper()} has a fault, which is reset now: senders" in said
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
            # No faster than the arm reads on a busy machine: what the system drops says nothing about the arm.
            late = time.monotonic() + 0.1
            while k > observer.last.num_refused - refused + 100 and time.monotonic() < late:
                time.sleep(1e-3)
    time.sleep(0.2)
    assert process.process.is_alive()
    heard = [status for _, status in observer.heard[first:]]
    assert np.all(np.diff([status.sequence for status in heard]) == 1)
    assert {status.guard_state for status in heard} == {Status.STATE_HOLD}
    assert max(drift(name, status) for status in heard) < 1e-4
    assert heard[-1].num_refused - refused > 9_000  # UDP may lose a few


@inside
def test_a_jump_of_the_controllers_clock_is_followed_by_a_hold_and_a_new_start(arm):
    name, _, observer = arm
    first = len(observer.heard)
    controller = start_controller(name, "--clock-jump", {"mtml": "10", "psm": "-10"}[name])
    try:
        begun = observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 60, "start of the controller")
        jumped = observer.until(lambda status: status.guard_state == Status.STATE_HOLD, 30, "hold", begun)
        assert observer.heard[jumped][1].refusal_code == Status.REFUSAL_CLOCK_JUMP
        observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 30, "a new start", jumped)
        time.sleep(0.2)
    finally:
        controller.end()
    assert max(drift(name, status) for _, status in observer.heard[first:]) < 1e-3


class Logged:
    """What lcm-logger writes of the commands while the block runs, for lcm-logplayer."""

    def __init__(self, path, url):
        self.path, self.url = path, url

    def __enter__(self):
        self.logger = subprocess.Popen(
            [LCM_TOOLS / "lcm-logger", "-q", "-f", "-c", "DVRK_COMMAND.*", "-l", self.url, self.path]
        )
        network, end = lcm.LCM(self.url), time.monotonic() + 20
        while not (self.path.exists() and self.path.stat().st_size) and time.monotonic() < end:
            network.publish("DVRK_COMMAND_NOBODY", b"is the logger there?")
            time.sleep(0.01)
        return self

    def __exit__(self, *exception):
        self.logger.send_signal(signal.SIGINT)
        self.logger.wait(20)

    def count(self, name):
        return sum(event.channel == f"DVRK_COMMAND_{name.upper()}" for event in lcm.EventLog(str(self.path), "r"))

    def play(self, speed):
        command = [LCM_TOOLS / "lcm-logplayer", f"--speed={speed}", "-l", self.url, self.path]
        subprocess.run(command, check=True, timeout=60, capture_output=True)


@inside
def test_commands_that_are_played_again_from_a_log_are_refused(arm, tmp_path):
    name, _, observer = arm
    with Logged(tmp_path / "commands", NETWORK_URL) as log:
        controller = start_controller(name)
        try:
            observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 60, "start of the controller")
            time.sleep(0.5)
        finally:
            controller.end()
        observer.until(lambda status: status.guard_state == Status.STATE_HOLD, 5, "hold")
    before, first = observer.last, len(observer.heard)
    log.play(speed=1)
    time.sleep(0.1)
    heard = [status for _, status in observer.heard[first:]]
    assert {status.guard_state for status in heard} == {Status.STATE_HOLD}
    assert heard[-1].num_accepted == before.num_accepted
    assert heard[-1].num_refused - before.num_refused > 0.9 * log.count(name) > 200
    assert heard[-1].refusal_code == Status.REFUSAL_STALE
    assert max(drift(name, status) for status in heard) < 1e-3


@inside
def test_an_arm_that_is_killed_and_restarted_hears_nothing_from_run_nor_from_a_log(tmp_path):
    observer, on_other = Observer("mtml", OTHER_URL), ("--lcm-url", OTHER_URL)
    arm, run = start_arm("mtml", *on_other), start_run("mtml", "--mode", "hold", "--realtime", *on_other)
    try:
        with Logged(tmp_path / "commands", OTHER_URL) as log:
            observer.until(lambda status: status.guard_state == Status.STATE_EFFORT, 60, "run")
            time.sleep(0.5)
            arm.end(signal.SIGKILL)
            killed = observer.last.session_id
            arm = start_arm("mtml", *on_other)
            first = observer.until(lambda status: status.session_id != killed, 60, "a new session")
            assert run.wait(20) == 2
        # By whichever it notices first: a second of silence, or a session that it did not start with.
        assert "no status of MTML for 1 s" in run.said() or "MTML was restarted: look at it" in run.said()
        assert observer.last.num_refused == 0
        log.play(speed=4)
        time.sleep(0.1)
    finally:
        print(run.end(), arm.end())
    heard = [status for _, status in observer.heard[first:]]
    assert {status.guard_state for status in heard} == {Status.STATE_HOLD}
    assert heard[-1].num_accepted == 0
    assert heard[-1].num_refused > 0.9 * log.count("mtml") > 200
    assert heard[-1].refusal_code == Status.REFUSAL_WRONG_SESSION
    assert max(drift("mtml", status) for status in heard) < 1e-3


class ScriptedArm:
    """An arm that says what the test wants, and hears every command."""

    def __init__(self, url):
        self.commands, self.lcm, self.pace = [], lcm.LCM(url), Pace(1e-3)
        self.lcm.subscribe("DVRK_COMMAND_MTML", lambda _, data: self.commands.append(Command.decode(data)))
        self.held = IdentifiedModel.from_arm(load_arm("mtml")).holding_torque(POSES["mtml"])
        self.status = status = Status()
        status.arm_name, status.num_joints, status.session_id, status.utime = "MTML", 7, draw_id(), 10**15
        status.guard_state, status.accepted_modes = Status.STATE_HOLD, 0b11110
        status.position = status.position_commanded = POSES["mtml"]
        status.velocity, status.joint_flags = [0.0] * 7, [0] * 7
        status.effort_measured = status.effort_commanded = self.held.tolist()

    def say(self, count, utime_jump=0):
        """So many statuses, a millisecond apart; the clock jumps before the first one [us]."""
        self.status.utime += utime_jump
        for _ in range(count):
            self.pace.wait()
            self.status.utime, self.status.sequence = self.status.utime + 1000, self.status.sequence + 1
            self.lcm.publish("DVRK_STATUS_MTML", self.status.encode())
            while self.lcm.handle_timeout(0):
                pass


@inside
def test_run_goes_on_when_the_arms_clock_jumps_and_ends_when_its_session_changes():
    arm, run = ScriptedArm(OTHER_URL), start_run("mtml", "--mode", "hold", "--realtime", "--lcm-url", OTHER_URL)
    try:
        end = time.monotonic() + 60
        while not arm.commands and time.monotonic() < end:
            arm.say(1)
        arm.status.guard_state, arm.status.command_sender_id = Status.STATE_EFFORT, arm.commands[0].sender_id
        arm.say(1500)
        first = len(arm.commands)
        for jump in (3_600_000_000, -7_200_000_000):
            arm.say(300, jump)
            time.sleep(0.05)
            arm.say(1)
            assert abs(arm.commands[-1].status_utime - arm.status.utime) < 500_000
        answers = arm.commands[first:]
        assert len(answers) > 300  # run answers the newest status; a busy machine makes it leave some out
        np.testing.assert_allclose([command.effort for command in answers], len(answers) * [arm.held], atol=1e-9)
        advance = np.diff([command.utime for command in answers])
        assert np.all((advance > 0) & (advance < 500_000))  # of its own clock, which did not jump
        assert {command.session_id for command in arm.commands} == {arm.status.session_id}
        session, arm.status.session_id = arm.status.session_id, draw_id()
        arm.say(100)
        assert run.wait(20) == 2
    finally:
        run.end()
    assert "MTML was restarted: look at it, then start again" in run.said()
    assert {command.session_id for command in arm.commands} == {session}


@inside
def test_two_controllers_are_noticed_and_a_reset_must_be_meant(arm):
    name, _, observer = arm
    first, second = start_controller(name, "--echo"), start_controller(name, "--echo")
    try:
        observer.until(lambda status: status.fault_code == Status.FAULT_DUPLICATE_SENDER, 60, "fault")
    finally:
        first.end()
        second.end()
    time.sleep(0.2)
    assert observer.last.guard_state == Status.STATE_FAULT
    reset(name, observer)
    assert drift(name, observer.last) < 1e-3
