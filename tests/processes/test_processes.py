"""Pace, network and start of the processes."""

import os
import signal
import subprocess
import sys

import lcm
import numpy as np
import pytest
from waiting import TIMEOUT

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import DvrkDrakeError, StationError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes import pace
from dvrk_drake.processes.simulated_arm import load_driver, start_pose, stop_on_signals
from dvrk_drake.systems.lcm.lcm_network import open_lcm


class Clock:
    def __init__(self):
        self.now, self.slept = 100.0, 0.0

    def sleep(self, seconds):
        self.slept += seconds
        self.now += seconds


def test_pace_keeps_its_period_and_catches_up():
    clock = Clock()
    pacer = pace.Pace(1e-3, lambda: clock.now, clock.sleep, clock.sleep)
    tick_times = []
    for k in range(1000):
        pacer.wait()
        tick_times.append(clock.now - 100.0)
        clock.now += 0.0105 if k == 500 else 0.0003  # one tick takes ten periods
    assert np.abs(np.array(tick_times[:501]) - 1e-3 * np.arange(501)).max() < 1e-9
    assert np.abs(np.array(tick_times[-400:]) - 1e-3 * np.arange(600, 1000)).max() < 1e-9
    assert 9 <= pacer.late <= 15
    assert (pacer.count, pacer.lost) == (1000, 0.0)


def test_pace_of_a_slow_loop_rests():
    """Linux would take 50 ms at once from a real-time loop that leaves less than 5 % of its core to others."""
    clock, rests = Clock(), []
    pacer = pace.Pace(
        1e-3, lambda: clock.now, lambda seconds: None, lambda seconds: (rests.append(seconds), clock.sleep(seconds))
    )
    for _ in range(1000):
        pacer.wait()
        clock.now += 1.2e-3
    assert sum(rests) > 0.05 * (clock.now - 100.0)
    assert max(rests) <= 1e-3
    assert pacer.late > 900


def test_pace_continues_from_now_after_long_delay():
    clock = Clock()
    pacer = pace.Pace(1e-3, lambda: clock.now, clock.sleep, clock.sleep)
    pacer.wait()
    clock.now += 10.0
    tick_times = []
    for _ in range(5):
        pacer.wait()
        tick_times.append(clock.now - 110.0)
    np.testing.assert_allclose(tick_times[1:], 1e-3 * np.arange(1, 5), atol=1e-9)
    assert tick_times[0] <= 1e-3 + 1e-9  # it rests
    assert pacer.late == 1
    assert pacer.describe() == (
        "1 of 6 steps (16.7 %) started more than one period late, and the simulation was 10.0 s slower than real time"
    )


@pytest.mark.parametrize(
    ("number", "before", "is_stopped"),
    [
        (signal.SIGINT, signal.SIG_DFL, True),
        (signal.SIGTERM, signal.SIG_DFL, True),
        (signal.SIGHUP, signal.SIG_DFL, True),
        (signal.SIGHUP, signal.SIG_IGN, False),  # nohup
    ],
)
def test_signals_stop_a_process(number, before, is_stopped):
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = {each: signal.getsignal(each) for each in numbers}
    try:
        signal.signal(number, before)
        stopped = stop_on_signals()
        assert not stopped()
        signal.raise_signal(number)
        assert stopped() == is_stopped
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)


def test_missing_realtime_permissions_are_warnings(monkeypatch):
    def refuse(*arguments):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(pace, "_lock_memory", refuse)
    memory, cores, scheduling = pace.make_realtime()
    assert scheduling.startswith("no real-time scheduling") and scheduling.endswith("(Operation not permitted)")
    assert "memlock" in memory and "/dev/cpu_dma_latency" in cores


def test_realtime_sets_scheduler_and_locks_memory():
    """Memory is locked before: with real-time priority, that would delay other processes with this priority."""
    code = (
        "import os; from dvrk_drake.processes import pace; lock = pace._lock_memory; during = []; "
        "os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0)); "  # not that of the process that runs the tests
        "pace._lock_memory = lambda: (during.append(os.sched_getscheduler(0)), lock()); "
        "print(len(pace.make_realtime()), during == [os.SCHED_OTHER], os.sched_getscheduler(0) == os.SCHED_FIFO, "
        "'VmLck:\\t       0 kB' not in open('/proc/self/status').read())"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=TIMEOUT, check=True)
    if result.stdout.split()[0] != "0":
        pytest.skip("no permission for real-time scheduling, locked memory or cores that stay awake")
    assert result.stdout.split() == ["0", "True", "True", "True"]


@pytest.mark.parametrize("url", ["bogus://", "udpm://nonsense"])
def test_unusable_network_is_an_error(url):
    with pytest.raises(DvrkDrakeError, match=f'LCM network "{url}" cannot be used'):
        open_lcm(url)


class LossyLcm(lcm.LCM):
    """Network that loses the first two messages that any instance publishes."""

    lost = 0

    def publish(self, channel, data):
        if LossyLcm.lost < 2:
            LossyLcm.lost += 1
        else:
            super().publish(channel, data)


def test_network_with_lost_messages_is_usable(monkeypatch):
    monkeypatch.setattr("dvrk_drake.systems.lcm.lcm_network.lcm.LCM", LossyLcm)
    assert open_lcm("memq://").get_lcm_url() == "memq://"
    assert LossyLcm.lost == 2


def test_network_without_route_is_an_error():
    code = "from dvrk_drake.systems.lcm.lcm_network import open_lcm; open_lcm()"
    try:
        done = subprocess.run(
            ["unshare", "-rn", sys.executable, "-c", code],
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
    except OSError:
        pytest.skip("no unshare here")
    if "unshare failed" in done.stderr:
        pytest.skip("a network of its own is not permitted here")
    assert done.returncode == 1
    assert 'DvrkDrakeError: LCM network "udpm://239.255.76.67:7667' in done.stderr


def test_start_pose_is_inside_limits():
    for name in ("mtml", "mtmr", "psm"):
        arm = load_arm(name)
        assert not arm.limit_violations(start_pose(arm), tolerance=-0.01)
    arm = load_arm("mtml")
    np.testing.assert_array_equal(start_pose(arm, [0.1] * 7), [0.1] * 7)
    with pytest.raises(StationError, match="a pose of MTML is 7 finite numbers"):
        start_pose(arm, [0.1] * 6)
    with pytest.raises(StationError, match=r"parallelogram = 1.2 is outside"):
        start_pose(arm, [0.0, 0.7, 0.5, 0.0, 0.0, 0.0, 0.0])


def test_driver_file(tmp_path):
    path = tmp_path / "driver.yaml"
    path.write_text("control_modes: [effort]\nguard: {expiry: 0.03}\n")
    driver = load_driver(path)
    assert (driver.control_modes, driver.guard.expiry, driver.status_period) == (["effort"], 0.03, 1e-3)
    for text in ("control_modes: [speed]", "gard: {}", "guard: {expiry: -1}", "guard: {expiry: soon}", "["):
        path.write_text(text)
        with pytest.raises(StationError, match=r"driver\.yaml: "):
            load_driver(path)
    for text, message in (
        ("guard: 3", "guard is 3; allowed: a mapping with the keys expiry, "),
        ("gard: {}", 'key "gard" is unknown; did you mean "guard"\\? allowed in .*: .*lcm_url, '),
        (
            "control_modes: [off]",
            r"control_modes\[0\] is False; allowed: a string; quote a word, e\.g\. \"off\": YAML reads off and no "
            "without quotes as false",
        ),
        ("control_modes: off", r"control_modes is False; .* quote a word, e\.g\. \[\"off\"\]: YAML reads off"),
        ("lcm_url: yes", r"lcm_url is True; .*\"on\": YAML reads on and yes without quotes as true"),
        ("control_modes: effort", r"control_modes is \"effort\"; allowed: a list of strings, e\.g\. \[effort\]"),
    ):
        path.write_text(text)
        with pytest.raises(StationError, match=rf"driver\.yaml: .*{message}"):
            load_driver(path)
    with pytest.raises(StationError, match=r"nowhere\.yaml: no such file"):
        load_driver(tmp_path / "nowhere.yaml")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sim-arm", "--arm", "mtml", "--pose", "1", "2"], "a pose of MTML is 7 finite numbers"),
        (["sim-arm", "--arm", "mtml", "--lcm-url", "bogus://"], 'LCM network "bogus://" cannot be used'),
        (["sim-arm", "--arm", "mtml", "--driver", "nowhere.yaml"], "nowhere.yaml"),
        (["control", "--arm", "mtml", "--lcm-url", "bogus://"], 'LCM network "bogus://" cannot be used'),
        (["control", "--arm", "nobody"], 'unknown arm "nobody"'),
    ],
)
def test_invalid_input_prints_one_line_and_exits_with_2(arguments, message, capfd):
    assert main(arguments) == 2
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("dvrk-drake")]
    assert message in line


def test_rejects_model_of_another_arm(tmp_path, capfd):
    path = tmp_path / "model.yaml"
    IdentifiedModel.from_arm(load_arm("mtmr")).save(path)
    assert main(["control", "--arm", "mtml", "--model", str(path)]) == 2
    assert "model.yaml: the model is for MTMR, not for MTML" in capfd.readouterr().err
