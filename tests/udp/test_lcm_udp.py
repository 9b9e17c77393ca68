"""Arm process and its controllers over real UDP multicast.

Processes are forked from one that has imported the package; where a test starts them by their command line, it says so.
"""

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import lcm
import lcm_controller
import numpy as np
import pytest
from arm_observer import Observer, accepts_efforts, check_clock, is_holding
from arm_processes import (
    LONG_TIMEOUT_DRIVER,
    POSES,
    CommandLine,
    Forked,
    dvrk_drake,
    start_arm,
    start_controller,
    start_run,
)
from waiting import TIMEOUT, wait_until

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import create_key_file
from dvrk_drake.processes.pace import Pace, make_realtime
from dvrk_drake.systems.lcm.messages import draw_id

pytestmark = [pytest.mark.network, pytest.mark.realtime]

OTHER_URL = "udpm://239.255.76.67:7668?ttl=0"
#: Options of tests that publish invalid messages, which observers do not read.
THIRD_URL = "udpm://239.255.76.67:7669?ttl=0"
#: Options of an arm with long timeouts; its expiry [s] and a margin, after which it releases a silent sender.
PATIENT, FORGOTTEN = ("--driver", LONG_TIMEOUT_DRIVER), 0.6
#: Speed at which logs are played: the network loses nothing when a busy computer delays the player.
SLOWLY = 0.5
LCM_TOOLS = Path(lcm.__file__).parent / "../bin"


@pytest.fixture(scope="module", params=["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def running_arm(request):
    observer = Observer(request.param)
    process = start_arm(request.param, *PATIENT)
    observer.until(lambda status: True, "first status", process=process)
    yield request.param, process, observer
    said = process.end(signal.SIGINT)
    assert process.wait() == 0, said
    assert "ended" in said


@pytest.fixture(autouse=True)
def end_observers():
    """Stops the observers of a test, which would otherwise read the messages of later tests."""
    before = set(Observer.running)
    yield
    for observer in Observer.running - before:
        observer.end()


@pytest.fixture
def arm(running_arm):
    """Running arm in HOLD without a sender: its name, process and output."""
    name, process, observer = running_arm
    observer.during(FORGOTTEN)
    if observer.last.guard_state != Status.STATE_HOLD:  # an earlier test failed
        reset(name, observer)
    return name, process, observer


def drift(*statuses):
    """Returns the largest distance from the position of the first status [rad, m]."""
    positions = np.array([status.position for status in statuses])
    return np.abs(positions - positions[0]).max()


def send(network, status, sequence, sender_id, **fields):
    """Returns a HOLD command that answers `status`, with other fields as given."""
    n, command = status.num_joints, Command()
    command.utime, command.sequence, command.sender_id = time.monotonic_ns() // 1000, sequence, sender_id
    command.session_id, command.status_utime = status.session_id, status.utime
    command.arm_name, command.num_joints, command.control_mode = status.arm_name, n, Command.HOLD
    command.position = command.velocity = command.effort = [0.0] * n
    for field, value in fields.items():
        setattr(command, field, value)
    network.publish(f"DVRK_COMMAND_{status.arm_name.upper()}", command.encode())


def reset(name, observer):
    """Clears a fault by HOLD, HOLD, and HOLD with the request. Repeats this if a command was late."""
    network = lcm.LCM()

    def is_cleared():
        observer.during(FORGOTTEN)  # earlier senders are silent by then
        sender_id = draw_id()
        for k, asks in enumerate((False, False, True)):
            send(network, observer.last, k, sender_id, reset_fault=asks)
            observer.during(0.01)
        return is_holding(observer.during(0.05)[-1])

    wait_until(is_cleared, "cleared fault")


@pytest.mark.watchdog
@pytest.mark.parametrize("name", ["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def test_arm_holds_after_controller_is_killed(name, tmp_path):
    """Tests the expiry by the arm's clock and, with real-time scheduling, by the wall clock."""
    (tmp_path / "driver.yaml").write_text("status_period: 0.002\nguard: {resume_automatically: true}\n")
    observer = Observer(name, OTHER_URL)
    arm = start_arm(name, "--lcm-url", OTHER_URL, "--driver", tmp_path / "driver.yaml")
    controller = start_controller(name, "--lcm-url", OTHER_URL)
    try:
        observer.until(lambda status: True, "first status", process=arm)
        observer.until(accepts_efforts, "start of the controller", process=controller)
        # A busy computer may make commands expire; then they start again.
        wait_until(lambda: all(map(accepts_efforts, observer.during(0.5))), "half a second of efforts", controller)
        realtime = not make_realtime()  # this thread too: it shares Python's lock with the observer's
        controller.send_signal(signal.SIGKILL)
        first = len(observer.received)
        held = observer.until(is_holding, "hold")
        last_command = max(
            k for k in range(held) if observer.received[k].num_accepted < observer.received[held].num_accepted
        )
        worst = drift(*observer.received[first:], *observer.during(1.0))
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # processes started later would inherit it
        print(controller.end(), arm.end(signal.SIGINT))
    assert arm.wait() == 0
    by_its_clock = 1e-6 * (observer.received[held].utime - observer.received[last_command].utime)
    by_the_wall = observer.times[held] - observer.times[last_command]
    print(f"{name}: hold {1e3 * by_its_clock:.1f} ms after the last command, {1e3 * by_the_wall:.1f} ms by the wall")
    print(f"{name}: drift {1e3 * worst:.3g} mrad or mm; real-time scheduling: {realtime}")
    assert by_its_clock <= 0.060
    if realtime:
        assert by_the_wall <= 0.060
    assert worst < 1e-3
    assert observer.last.num_expired >= 1


def stop(process, seconds):
    """Stops a process for at least the given time."""
    process.send_signal(signal.SIGSTOP)
    stat = Path(f"/proc/{process.process.pid}/stat")
    wait_until(lambda: stat.read_text().rpartition(")")[2].split()[0] == "T", "stop", process)
    time.sleep(seconds)
    process.send_signal(signal.SIGCONT)


def waits_for_an_operator(status):
    """Accepts that the guard detected the stall first by its own period."""
    return is_holding(status) and not status.fault_code and bool(status.fault_text)


@pytest.mark.parametrize("seconds", [0.2, *(pytest.param(seconds, marks=pytest.mark.slow) for seconds in (0.05, 1.0))])
@pytest.mark.parametrize("stalled", ["arm", "controller"])
def test_arm_holds_after_stall_until_operator_resumes(stalled, seconds):
    """Stalls processes by signals, with the default expiry. Stalls of 20 ms are tested with a simulated clock.

    A busy computer may stop one of them before the test does: that has the same end.
    """
    observer, arm = Observer("mtml", OTHER_URL), start_arm("mtml", "--lcm-url", OTHER_URL)
    controller = start_controller("mtml", "--lcm-url", OTHER_URL)
    try:
        begun = observer.until(accepts_efforts, "start of the controller", process=controller)
        stop(arm if stalled == "arm" else controller, seconds)
        held = observer.until(waits_for_an_operator, "hold", begun, arm)
        # The controller continues unchanged.
        observer.until(
            lambda status: status.refusal_code == Status.REFUSAL_RESUME and status.num_refused > 300,
            "refusals",
            held,
            controller,
        )
        after = observer.received[held:]
    finally:
        said = controller.end(), arm.end(signal.SIGINT)
        print(*said)
    assert arm.wait() == 0
    assert all(map(waits_for_an_operator, after))
    assert f"hold: {after[0].fault_text}" in said[1]
    farthest = drift(*observer.received[begun:])
    print(f"{stalled} stopped for {seconds} s: {after[0].fault_text}; the arm moves {farthest:.2g} rad or m")
    assert farthest < 1e-3


@pytest.mark.watchdog
@pytest.mark.parametrize("mode", ["gravity", "hold"])
def test_run_starts_ramps_and_ends_in_hold(arm, mode):
    """A watchdog test, since `control` ends if the computer stops the arm's guard for 0.5 s (`PATIENT`)."""
    name, _, observer = arm
    expired = observer.last.num_expired
    starts = CommandLine if (name, mode) == ("mtml", "gravity") else dvrk_drake
    process = starts("control", "--arm", name, "--mode", mode, "--realtime")
    try:
        begun = observer.until(accepts_efforts, "run", process=process)
        observer.during(1.5)  # the ramp of the efforts takes a second
        acting = observer.received[begun:]
    finally:
        said = process.end(signal.SIGINT)
    assert process.wait() == 0, said
    assert all(map(accepts_efforts, acting))
    steps = np.diff([status.sequence for status in acting])[:, None]
    efforts = np.array([status.effort_commanded for status in acting])
    assert np.all(np.abs(np.diff(efforts, axis=0)) < 0.02 * steps * load_arm(name).effort_limits)
    held = observer.received[observer.until(is_holding, "hold", begun)]
    assert held.num_expired == expired  # it received HOLD and no command expired
    assert drift(*observer.during(0.1)) < 1e-3
    assert "holds its pose" in said
    assert "effort; " in said and " Hz, round trip " in said
    print(f"{name} {mode}: {said.splitlines()[-2].strip()}")


@pytest.mark.parametrize("count", [3_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_invalid_messages_neither_stop_nor_move_the_arm(arm, count):
    name, process, observer = arm
    generator = np.random.default_rng(7)
    network = lcm.LCM()
    n = load_arm(name).num_joints
    command = Command()  # of an earlier session, as in a log that is played again
    command.arm_name, command.num_joints, command.control_mode = name.upper(), n, Command.EFFORT
    command.session_id, command.sender_id = draw_id(), draw_id()
    command.position, command.velocity, command.effort = [0.0] * n, [0.0] * n, [1e3] * n

    def unaccepted(status):
        return status.num_refused + status.num_ignored

    before, first = unaccepted(observer.last), len(observer.received)
    for k in range(count):
        command.status_utime, command.sequence, command.utime = observer.last.utime, k, observer.last.utime
        data = bytearray(command.encode() if k % 2 else generator.bytes(int(generator.integers(0, 400))))
        for _ in range(generator.integers(0, 6)):
            if data:
                data[generator.integers(len(data))] = generator.integers(256)
        network.publish(f"DVRK_COMMAND_{name.upper()}", bytes(data))
        if k % 20 == 0:
            # No faster than the arm reads on a busy machine: what the system drops says nothing about the arm.
            wait_until(lambda k=k: k <= unaccepted(observer.last) - before + 100, "refusals", process)
    # UDP may lose a few messages.
    observer.until(lambda status: unaccepted(status) - before > 0.9 * count, "refusals", first, process)
    received = observer.received[first:]
    check_clock(received)
    assert all(map(is_holding, received))
    assert drift(*received) < 1e-4


class Logged:
    """Records the commands with lcm-logger while the block runs, for lcm-logplayer."""

    def __init__(self, path, url):
        self.path, self.url = path, url

    def __enter__(self):
        self.logger = subprocess.Popen(
            [LCM_TOOLS / "lcm-logger", "-q", "-f", "-c", "DVRK_COMMAND.*", "-l", self.url, self.path]
        )
        network = lcm.LCM(self.url)

        def listens():
            network.publish("DVRK_COMMAND_NOBODY", b"is the logger there?")
            return self.path.exists() and self.path.stat().st_size

        wait_until(listens, "start of the logger", self.logger)
        return self

    def __exit__(self, *exception):
        self.logger.send_signal(signal.SIGINT)
        self.logger.wait(TIMEOUT)

    def count(self, name):
        return sum(event.channel == f"DVRK_COMMAND_{name.upper()}" for event in lcm.EventLog(str(self.path), "r"))

    def play(self):
        command = [LCM_TOOLS / "lcm-logplayer", f"--speed={SLOWLY}", "-l", self.url, self.path]
        subprocess.run(command, check=True, timeout=TIMEOUT, capture_output=True)


@pytest.mark.watchdog
def test_restarted_arm_ignores_run_and_log(tmp_path):
    """A watchdog test, since `control` ends if the computer stops the arm's guard for 40 ms."""
    observer, on_other = Observer("mtml", OTHER_URL), ("--lcm-url", OTHER_URL)
    arm = start_arm("mtml", *PATIENT, *on_other)
    observer.until(lambda status: True, "first status", process=arm)
    run = start_run("mtml", "--mode", "hold", "--realtime", *on_other)
    try:
        with Logged(tmp_path / "commands", OTHER_URL) as log:
            begun = observer.until(accepts_efforts, "run", process=run)
            killed, accepted = observer.received[begun].session_id, observer.received[begun].num_accepted
            observer.until(lambda status: status.num_accepted > accepted + 500, "500 commands", process=run)
            arm.end(signal.SIGKILL)
            arm = start_arm("mtml", *PATIENT, *on_other)
            first = observer.until(lambda status: status.session_id != killed, "a new session", process=arm)
            assert run.wait() == 2
        assert "no status of MTML for 1 s" in run.output()
        assert observer.last.num_refused == 0
        assert log.count("mtml") > 50
        log.play()
        enough = 0.9 * log.count("mtml")
        observer.until(lambda status: status.num_ignored > enough, "ignored commands", first)
    finally:
        print(run.end(), arm.end())
    received = observer.received[first:]
    assert all(map(is_holding, received))
    assert received[-1].num_accepted == 0
    assert received[-1].ignored_code == Status.REFUSAL_WRONG_SESSION
    assert drift(*received) < 1e-3


class ScriptedArm:
    """Arm that sends given statuses and receives every command."""

    def __init__(self, url):
        self.commands, self.lcm, self.pace = [], lcm.LCM(url), Pace(1e-3)
        self.lcm.subscribe("DVRK_COMMAND_MTML", lambda _, data: self.commands.append(Command.decode(data)))
        self.foreign = list  # messages of other processes after each status
        self.held = IdentifiedModel.from_arm(load_arm("mtml")).holding_torque(POSES["mtml"])
        self.status = status = Status()
        status.arm_name, status.num_joints, status.session_id, status.utime = "MTML", 7, draw_id(), 10**15
        status.guard_state, status.accepted_modes = Status.STATE_HOLD, 0b11110
        status.position = status.position_commanded = POSES["mtml"]
        status.velocity, status.joint_flags = [0.0] * 7, [0] * 7
        status.effort_measured = status.effort_commanded = self.held.tolist()

    def say_until(self, condition, what, process=None):
        """Sends statuses, a millisecond apart, until the condition holds."""

        def says():
            self.say()
            return condition()

        wait_until(says, what, process)

    def say(self, count=1):
        """Sends that many statuses, a millisecond apart."""
        for _ in range(count):
            self.pace.wait()
            self.status.utime, self.status.sequence = self.status.utime + 1000, self.status.sequence + 1
            self.lcm.publish("DVRK_STATUS_MTML", self.status.encode())
            for message in self.foreign():
                self.lcm.publish("DVRK_STATUS_MTML", message)
            while self.lcm.handle_timeout(0):
                pass


@pytest.mark.parametrize("ends", ["restarted", pytest.param("clock", marks=pytest.mark.slow)])
def test_run_ignores_foreign_statuses_and_ends_on_silence(ends):
    arm, run = ScriptedArm(THIRD_URL), start_run("mtml", "--mode", "hold", "--realtime", "--lcm-url", THIRD_URL)
    session = arm.status.session_id

    def foreign():
        """Sends corrupted and spoofed copies of the status with another pose."""
        data = arm.status.encode()
        yield data[:-60]
        yield os.urandom(300)
        for field, value in (("session_id", 5), ("sequence", 2**62), ("utime", 2**62), ("sequence", 1), ("utime", 0)):
            spoofed = Status.decode(data)
            spoofed.sequence, spoofed.position = spoofed.sequence + 1, [0.0] * 7
            setattr(spoofed, field, value)
            yield spoofed.encode()

    try:
        arm.say_until(lambda: arm.commands, "first command", run)
        arm.status.guard_state, arm.status.command_sender_id = Status.STATE_EFFORT, arm.commands[0].sender_id
        arm.say(1500)
        first, arm.foreign = len(arm.commands), foreign
        # Run answers the newest status; a busy computer makes it leave some out.
        arm.say_until(lambda: len(arm.commands) >= first + 300, "300 commands", run)
        arm.foreign = list
        answers = arm.commands[first:]
        np.testing.assert_allclose([command.effort for command in answers], len(answers) * [arm.held], atol=1e-9)
        assert {command.session_id for command in arm.commands} == {session}
        if ends == "clock":
            arm.status.utime += 3_600_000_000
        else:
            arm.status.session_id = draw_id()
        arm.say_until(lambda: run.poll() is not None, "end of run")
        assert run.wait() == 2
    finally:
        said = run.end()
    assert "no status of MTML for 1 s" in said
    assert ("MTML was restarted: look at it, then start again" in said) == (ends == "restarted")
    most = {"restarted": "of another session", "clock": "with a jump of sequence or time"}[ends]
    assert re.search(rf"; ignored: \d+ {most}", said), said
    assert {command.session_id for command in arm.commands} == {session}
    assert all(command.status_utime <= 10**15 + 600_000_000 for command in arm.commands)


def speed(observer, what, condition):
    """Returns the speed of the arm's clock until a condition is true, relative to this computer's clock."""
    begun, of_arm = time.monotonic(), observer.last.utime
    observer.until(condition, what)
    return 1e-6 * (observer.last.utime - of_arm) / (time.monotonic() - begun)


@pytest.mark.watchdog
def test_key_protects_from_flood_of_foreign_commands(tmp_path):
    """Floods the arm with valid commands of an unknown sender, as fast as a process can publish them.

    The rate of the arm is compared with its rate before the flood. Without real-time scheduling a flood takes computing
    time from all processes, above all from those that read it, so the rate is judged with real-time scheduling only.

    A watchdog test, since the guard holds where the computer stops it for 0.5 s (`PATIENT`).
    """
    key = tmp_path / "a.key"
    create_key_file(key)
    options = ("--lcm-url", OTHER_URL, "--key", key)
    observer = Observer("mtml", OTHER_URL)
    arm = start_arm("mtml", *PATIENT, *options)
    observer.until(lambda status: True, "first status", process=arm)
    run = start_run("mtml", "--mode", "hold", "--realtime", *map(str, options))
    attacker = None
    try:
        first = observer.until(accepts_efforts, "run", process=run)
        second_later = observer.last.utime + 1_000_000
        before = speed(observer, "one second", lambda status: status.utime > second_later)
        ignored = observer.last.num_ignored
        attacker = Forked(lcm_controller.flood, OTHER_URL, observer.last.encode())
        begun = observer.until(lambda status: status.num_ignored > ignored + 100, "flood", process=attacker)
        flooded = speed(observer, "5000 messages", lambda status: status.num_ignored > ignored + 5000)
        received = observer.received[begun:]
    finally:
        if attacker is not None:
            attacker.end()
        said = run.end(signal.SIGINT)
        said += arm.end(signal.SIGINT)
    realtime = "no real-time scheduling" not in said
    acting = np.mean([accepts_efforts(status) for status in received])
    print(f"speed of the arm {before:.3f} before the flood, {flooded:.3f} during it; {realtime=}")
    print(f"efforts act in {acting:.3f} of the time")
    assert flooded > 0.7 * before or not realtime, said
    assert acting == 1.0, said
    assert received[-1].ignored_code == Status.REFUSAL_NOT_AUTHENTIC, said
    assert {status.command_sender_id for status in observer.received[first:]} <= {0, received[0].command_sender_id}
    assert drift(*observer.received[first:]) < 1e-3
