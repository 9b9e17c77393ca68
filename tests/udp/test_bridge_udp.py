"""Bridge to the dVRK console: efforts, kills, failures of the console and of the network. All are real processes.

The console has no dynamics, so its guard is lenient, and the
controllers command efforts of zero.
"""

import contextlib
import os
import re
import signal
import subprocess
import time

import pytest
from dvrk_console import start_console
from own_network import NETWORK
from ros_bridge import CommandMonitor, Operator, start_bridge, start_controller, wait_for_line
from ros_publisher import DOMAIN_FILE
from waiting import wait_until

from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS

pytestmark = [pytest.mark.network, pytest.mark.realtime, pytest.mark.slow]

EFFORT, POSITION = "JOINT_SPACE/EFFORT_MODE", "JOINT_SPACE/POSITION_MODE"
#: Time for which DDS by default lists a killed process [s].
DDS_LEASE = 10.0
#: Environment of all processes. Each test file has a network of its own, so the number of the domain is free.
os.environ.setdefault("CYCLONEDDS_URI", DOMAIN_FILE)


@pytest.fixture(scope="module")
def console(tmp_path_factory):
    """Console of an MTML that is enabled and homed."""
    with start_console("MTML", tmp_path_factory.mktemp("console")) as console:
        console.enable_and_home()
        yield console


@pytest.fixture(scope="module")
def operator():
    operator = Operator("mtml")
    yield operator
    operator.end()


@contextlib.contextmanager
def running(*processes):
    """Ends the processes with the block."""
    try:
        yield processes
    finally:
        for process in processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.end()


def wait_for_mode(console, mode, *processes):
    text = " ".join(process.output() for process in processes)
    wait_until(lambda: console.modes()[-1:] == [mode], f"{mode}; {text}", console.process)


def start_efforts(arm, folder, console, *options):
    """Returns a bridge and a controller whose efforts act. Ends them if the efforts do not act."""
    bridge, controller = start_bridge(arm, folder, *options), start_controller(arm)
    try:
        wait_for_efforts(console, bridge)
    except BaseException:
        bridge.end()
        controller.end()
        raise
    return bridge, controller


def wait_for_efforts(console, bridge, after=0):
    """Waits until efforts act. `after` is a number of characters of the bridge's output."""
    # If the computer is stalled, the guard changes to FAULT and remains there.
    try:
        wait_until(lambda: re.search(r"effort, sender|\bfault: ", bridge.output()[after:]), "efforts", bridge)
    except AssertionError as error:
        raise AssertionError(f"{error}; {bridge.output()}") from None
    assert not re.search(r"\bfault: ", bridge.output()[after:]), bridge.output()
    wait_for_mode(console, EFFORT, bridge)


def test_wrong_domain_topic_and_arm_end_with_one_line(tmp_path):
    """The first two cases wait for a publisher, the others do not."""
    cases = {
        ("mtml", "--domain", "77"): "error: ROS domain 77: no topic /MTML/measured_js within 10 s. Start the dVRK's "
        "console, or check --domain and the network",
        ("mtml", "--topic", "/MTMX"): "error: ROS domain 0: no topic /MTMX within 10 s. Start the dVRK's console, or "
        "check --domain and the network",
        ("mtml", "--topic", "/MTMR"): "error: ROS domain 0: /MTMR is the namespace of the arm MTMR, not of MTML. "
        "Choose --arm mtmr, or the namespace of MTML with --topic (topic= in Python).",
        ("mtml", "--domain", "300"): "error: ROS domain 300: allowed: 0 to 232 (--domain, or ROS_DOMAIN_ID)",
    }
    start = time.monotonic()
    processes = {case: start_bridge(case[0], tmp_path, *case[1:]) for case in cases}
    with running(*processes.values()):
        for case, process in processes.items():
            assert process.wait() == 2
            lines = [line for line in process.output().splitlines() if "warning: " not in line]
            if case[2] == "300":  # found before any other step
                lines.insert(0, "connecting MTML to LCM")
            assert lines[0].startswith("connecting MTML to LCM")
            searching = [line for line in lines[1:] if line.startswith("searching for /MTM")]
            assert len(searching) == ("within 10 s" in cases[case])
            assert lines[1 + len(searching) :] == [f"dvrk-drake: {cases[case]}"]
    # Most of this time is the longest time for discovery, 10 s.
    assert time.monotonic() - start < 60.0


def test_efforts_act_and_other_bridge_is_refused(console, operator, tmp_path):
    monitor = CommandMonitor(console.domain, "/MTML")
    bridge, controller = start_efforts("mtml", tmp_path, console)
    other, missing = start_bridge("mtml", tmp_path), start_bridge("mtmr", tmp_path)
    with running(bridge, controller, other, missing):
        assert "deadman process" in bridge.output()
        assert "/MTML: switched off the dVRK's own gravity compensation" in bridge.output()
        assert other.wait() == missing.wait() == 2
        assert other.output().splitlines()[-1] == (
            "dvrk-drake: error: another process publishes /MTML/move_jp, /MTML/servo_jf, /MTML/servo_jp, e.g. "
            "another bridge, teleoperation or a script. Only one process may command an arm. " + END_OTHER_PROCESS
        )
        assert "has no topic /MTMR/measured_js. Topics with JointState messages: /MTML/" in missing.output()
        # The first bridge is not affected.
        assert not re.search(r"\bfault\b", bridge.output())
        assert operator.last.guard_state == Status.STATE_EFFORT
        controller.end(signal.SIGKILL)
        wait_for_line(bridge, "hold", after=bridge.output().index("effort, sender"))
        wait_for_mode(console, POSITION, bridge)
        before = time.time_ns()
        assert bridge.end(signal.SIGINT).splitlines()[-1] == "bridge ended; the arm has confirmed hold"
        assert bridge.poll() == 0
        wait_until(lambda: monitor.first(["hold"], before), "hold")
        assert "deadman: " not in bridge.output()[bridge.output().rindex("hold") :]
    wait_for_mode(console, POSITION)


@pytest.mark.parametrize("killed", ["bridge", "both"])
def test_deadman_holds_after_kill(console, tmp_path, killed):
    bridge, controller = start_efforts("mtml", tmp_path, console)
    with running(bridge, controller):
        bridge.send_signal(signal.SIGKILL)
        if killed == "both":
            controller.send_signal(signal.SIGKILL)
        wait_for_mode(console, POSITION, bridge)
        # The end of a killed process may take longer than the silence that the deadman permits.
        line = r"deadman: /MTML: (the bridge has ended|no command for \d+ ms); published hold at"
        wait_until(lambda: re.search(line, bridge.output()), "line")


def test_deadman_holds_while_bridge_is_stopped(console, operator, tmp_path):
    bridge, controller = start_efforts("mtml", tmp_path, console)
    with running(bridge, controller):
        bridge.send_signal(signal.SIGSTOP)
        wait_for_mode(console, POSITION, bridge)
        assert re.search(r"deadman: /MTML: no command for \d+ ms; published hold at", bridge.output())
        # All commands expire before the bridge continues.
        wait_one_second()
        num_modes = len(console.modes())
        bridge.send_signal(signal.SIGCONT)
        operator.until(lambda status: status.guard_state == Status.STATE_FAULT, "fault", process=bridge)
        assert EFFORT not in console.modes()[num_modes:]


def test_bridge_without_its_deadman_refuses_efforts(console, operator, tmp_path):
    bridge, controller = start_efforts("mtml", tmp_path, console)
    with running(bridge, controller):
        pid = int(re.search(r"deadman process (\d+)", bridge.output())[1])
        os.kill(pid, signal.SIGKILL)
        wait_for_line(bridge, "hold: the deadman process has ended. Restart the bridge")
        wait_for_mode(console, POSITION, bridge)


def test_pause_of_console_and_network_loss_lead_to_a_fault(console, operator, tmp_path):
    bridge, controller = start_efforts("mtml", tmp_path, console)
    with running(bridge, controller):
        console.process.send_signal(signal.SIGSTOP)
        wait_one_second()
        console.process.send_signal(signal.SIGCONT)
        wait_for_line(bridge, "s old; allowed: 0 to 0.1 s")
        wait_for_mode(console, POSITION, bridge)
        operator.reset(bridge)
        wait_for_mode(console, EFFORT, bridge)
        length = len(bridge.output())
        network("ip link set lo down")
        wait_one_second()
        network(NETWORK)
        wait_for_line(bridge, "s old; allowed: 0 to 0.1 s", after=length)
        assert "the status could not be sent: Network is unreachable" in bridge.output()
        wait_for_mode(console, POSITION, bridge)
        assert bridge.end(signal.SIGINT).splitlines()[-1] == "bridge ended; the arm has confirmed hold"


def wait_one_second():
    end = time.monotonic() + 1.0
    wait_until(lambda: time.monotonic() > end, "one second")


def network(command):
    subprocess.run(["sh", "-c", command], check=True)


def test_low_rate_is_refused_with_the_option_of_the_console(tmp_path):
    with start_console("MTMR", tmp_path, rate=100.0) as slow:
        slow.enable_and_home()
        bridge, controller = start_bridge("mtmr", tmp_path), start_controller("mtmr")
        with running(bridge, controller):
            line = wait_for_line(bridge, "Hz; commands need 500 Hz")
            assert re.fullmatch(
                r"hold: /MTMR/measured_js arrives at \d+ Hz; commands need 500 Hz. Start the dVRK's console with a "
                r"period of 1 ms: dvrk_system -j FILE.json -p 0.001",
                line,
            )
        assert EFFORT not in slow.modes()


def test_jaw_does_not_change_the_control_space_of_a_psm(tmp_path):
    with start_console("PSM1", tmp_path, motion=True) as psm:
        psm.enable_and_home()
        bridge, controller = start_efforts("psm", tmp_path, psm)
        with running(bridge, controller):
            monitor = CommandMonitor(psm.domain, "/PSM1", "jaw/servo_jf")
            wait_until(lambda: monitor.first(["servo_jf"], 0), "efforts", bridge)
            num_modes, start = len(psm.modes()), monitor.first(["servo_jf"], 0)
            wait_until(lambda: monitor.first(["servo_jf"], start + 5 * 10**9), "efforts for 5 s", bridge)
            names = [name for name, *_ in monitor.messages]
            # On a busy computer, the guard may hold the arm for a moment. The jaw is then commanded again.
            assert names.count("jaw/servo_jf") < 0.01 * names.count("servo_jf")
            changes = sum("CARTESIAN" in mode for mode in psm.modes()[num_modes:])
            assert changes <= names.count("jaw/servo_jf")


def test_restarted_console_is_not_commanded_until_reset(operator, tmp_path):
    with start_console("MTML", tmp_path, domain=9) as console:
        console.enable_and_home()
        bridge, controller = start_efforts("mtml", tmp_path, console, "--domain", "9")
    ended = time.monotonic()
    with running(bridge, controller):
        wait_until(lambda: re.search(r"\bfault: ", bridge.output()), "fault", bridge)
        with start_console("MTML", tmp_path, domain=9) as console:
            wait_for_line(bridge, "/MTML/measured_js: header stamp 0 marks invalid data. Home the arm")
            monitor = CommandMonitor(console.domain, "/MTML")
            console.enable_and_home()
            count = len(operator.received)
            wait_until(lambda: len(operator.received) > count + 300, "statuses", bridge)
            assert operator.last.guard_state == Status.STATE_FAULT
            assert not [name for name, *_ in monitor.receive() if name != "hold"]
            # Until the lease of the killed console has expired, the bridge considers it as a second arm.
            wait_until(lambda: time.monotonic() > ended + DDS_LEASE + 1.0, "end of the lease", bridge)
            before = len(bridge.output())
            operator.reset(bridge)
            # The guard may hold the arm for less time than DDS needs to discover the monitor.
            wait_until(lambda: monitor.first(["servo_jp", "servo_jf"], 0), "commands after the reset", bridge)
            wait_for_efforts(console, bridge, before)
