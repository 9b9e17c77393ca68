"""Pace, network and start of the processes."""

import io
import os
import signal
import subprocess
import sys
from unittest import mock

import lcm
import numpy as np
import pytest
from command_output import assert_refused
from forked import run_forked
from lcm_arm import POSES
from waiting import TIMEOUT

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import DvrkDrakeError, StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes import pace
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.control import LiveLine
from dvrk_drake.processes.simulated_arm import SimulatedArm, load_driver, start_pose, stop_on_signals
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.lcm.messages import usable_lcm_url
from dvrk_drake.systems.lcm.sim_dvrk_driver import DvrkArmServer


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
    assert_refused(DvrkDrakeError, f'LCM network "{url}" cannot be used', usable_lcm_url, url)


class LossyLcm(lcm.LCM):
    """Network that loses the first two messages that any instance publishes."""

    lost = 0

    def publish(self, channel, data):
        if LossyLcm.lost < 2:
            LossyLcm.lost += 1
        else:
            super().publish(channel, data)


def test_network_with_lost_messages_is_usable(monkeypatch):
    monkeypatch.setattr("dvrk_drake.systems.lcm.messages.lcm.LCM", LossyLcm)
    assert usable_lcm_url("memq://") == "memq://"
    assert LossyLcm.lost == 2


def test_network_without_route_is_an_error():
    code = "from dvrk_drake.systems.lcm.messages import usable_lcm_url; usable_lcm_url()"
    try:
        done = subprocess.run(
            ["unshare", "-rn", sys.executable, "-c", code], capture_output=True, text=True, timeout=TIMEOUT, check=False
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
    assert_refused(StationError, "a pose of MTML is 7 finite numbers", start_pose, arm, [0.1] * 6)
    with pytest.raises(StationError, match=r"parallelogram = 1.2 is outside"):
        start_pose(arm, [0.0, 0.7, 0.5, 0.0, 0.0, 0.0, 0.0])


def test_driver_file(tmp_path):
    path = tmp_path / "driver.yaml"
    path.write_text("control_modes: [effort]\nguard: {expiry: 0.03}\n")
    driver = load_driver(path)
    assert (driver.control_modes, driver.guard.expiry, driver.status_period) == (["effort"], 0.03, 1e-3)
    for text in ("control_modes: [speed]", "gard: {}", "guard: {expiry: -1}", "guard: {expiry: soon}", "["):
        path.write_text(text)
        assert_refused(StationError, r"driver\.yaml: ", load_driver, path)
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
        assert_refused(StationError, rf"driver\.yaml: .*{message}", load_driver, path)
    assert_refused(StationError, r"nowhere\.yaml: no such file", load_driver, tmp_path / "nowhere.yaml")


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


# Simulated arm with a stopped bridge, process or controller: state of the guard and motion of the arm.


#: Speed of the first joint [rad/s]. Largest distance in addition to speed times stall [rad].
SPEED, MAX_DISTANCE_BEYOND = 0.1, 0.01


class Loop:
    """SimulatedArm with the controller of `control --mode hold` and an injected wall clock, at 1 kHz.

    The start takes longer than a stall. Each test forks the process, so that its stall changes only a copy.
    """

    def __init__(self, name, speed):
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

    def check(self, before):
        """Checks the state after a stall. Returns the largest motion since `before` and in the last 0.1 s [rad, m]."""
        for _ in range(500):
            self.tick()
        # The controller continues to send commands, which the guard refuses.
        assert (self.status.guard_state, self.status.fault_code) == (Status.STATE_HOLD, Status.FAULT_NONE)
        assert self.status.fault_text.startswith("the last command expired: ")
        assert (self.status.refusal_code, self.status.num_expired) == (Status.REFUSAL_RESUME, 1)
        since = np.abs(np.array(self.moved[before:]) - self.moved[before - 1])
        return since.max(), np.ptp(since[-100:], axis=0).max()


@pytest.fixture(scope="module", params=["mtml", "psm"])
def moving(request):
    return Loop(request.param, SPEED)


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
        farthest, last = moving.check(before)
        assert farthest < SPEED * acted + MAX_DISTANCE_BEYOND
        assert last < 5e-3  # slow approach of the held pose

    run_forked(stall)


# Live line: updated in place on a terminal, not written to other streams.


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_line_is_updated_four_times_per_second(monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    terminal, now = Terminal(), [0.0]
    line = LiveLine(terminal, clock=lambda: now[0])
    for k in range(1001):
        now[0] = 1e-3 * k
        line.show(lambda k=k: f"row {k} of a line that is too long")
    line.clear()
    shown = terminal.getvalue().split("\r\x1b[K")
    assert shown == ["", *(f"row {k} of a line that is too long"[:19] for k in (0, 250, 500, 750, 1000)), ""]


def test_line_is_not_written_to_a_file():
    stream = io.StringIO()
    line = LiveLine(stream)
    line.show(lambda: 1 / 0)
    line.clear()
    assert stream.getvalue() == ""
