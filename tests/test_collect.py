"""Collecting poses without a network: files of poses, what is gone on with, ways, rests, and friction that cancels."""

import itertools
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import CollectionError, DvrkDrakeError, RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.collection_file import CollectionFile
from dvrk_drake.models.pose_file import load_poses, save_poses
from dvrk_drake.models.recording import read_recording
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.collector import CollectionSettings, Collector
from dvrk_drake.processes.leg import Leg, beside
from dvrk_drake.processes.rest_detector import RestDetector
from dvrk_drake.processes.teacher import EnterKey, Teacher

ARMS = ("mtml", "psm")
PERIOD = 1e-3


def random_poses(arm, count, seed=0, margin=0.1):
    return arm.sample_poses(count, np.random.default_rng(seed), margin=margin)


# --- files of poses


@pytest.mark.parametrize("name", ARMS)
def test_poses_come_back_bit_for_bit(name, tmp_path):
    arm = load_arm(name)
    poses = random_poses(arm, 30)
    save_poses(poses, arm, tmp_path / "p.yaml")
    np.testing.assert_array_equal(load_poses(tmp_path / "p.yaml", arm), poses)


GOOD = "0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a file of poses"),
        ("just words", "not a file of poses"),
        ("arm: MTML\nposes: []", "has no poses"),
        (f"arm: MTMR\nposes:\n- [{GOOD}]", 'arm is "MTMR", not MTML'),
        (f"poses:\n- [{GOOD}]", 'arm is "", not MTML'),
        (f"format: other\narm: MTML\nposes:\n- [{GOOD}]", 'format is "other"'),
        ("arm: MTML\nposes: 3", "not a file of poses"),
        ("arm: MTML\nposes:\n- [a, b]", "not a file of poses"),
        (f"arm: MTML\nspeed: 3\nposes:\n- [{GOOD}]", "not a file of poses"),
        ("arm: MTML\nposes: [[", "not a file of poses"),
        (f"arm: MTML\nposes:\n- [{GOOD}]\n- [0.1, 0.2]", "pose 2 has 2 numbers; MTML has 7 joints: outer_yaw"),
        (f"arm: MTML\nposes:\n- [{GOOD[:-3]}.nan]", "pose 1 must be finite numbers"),
        (f"arm: MTML\nposes:\n- [{GOOD[:-3]}.inf]", "pose 1 must be finite numbers"),
        (f"arm: MTML\nposes:\n- [{GOOD}]\n- [0.101, {GOOD[5:]}]", "pose 2 is pose 1 again"),
        ("arm: MTML\nposes:\n- [5.7, 22.9, -14.3, 34.4, 51.6, 5.7, 28.6]", "pose 1: .*degrees"),
        (f"arm: MTML\nposes:\n- [{GOOD}]\n- [1.2, {GOOD[5:]}]", "pose 2: outer_yaw = 1.2 is outside"),
        ("arm: MTML\nposes:\n- [0.1, 0.7, 0.3, 0, 0, 0, 0]", "pose 1: parallelogram = 1 is outside"),
    ],
)
def test_bad_files_of_poses_are_one_line(text, message, tmp_path, capsys):
    path, output = tmp_path / "p.yaml", tmp_path / "o.csv"
    path.write_text(text)
    with pytest.raises(CollectionError, match=message):
        load_poses(path, load_arm("mtml"))
    # The command refuses it before it looks for an arm, and for every task.
    for task in (["--output", str(output)], ["--teach"], ["--random", "2"]):
        assert main(["collect", "--arm", "mtml", "--poses", str(path), *task]) == 2
        error = capsys.readouterr().err
        assert error.startswith("dvrk-drake: error: ") and error.count("\n") == 1
        assert str(path) in error
    assert path.read_text() == text
    assert not output.exists()


def test_millimetres_are_suspected(tmp_path):
    (tmp_path / "p.yaml").write_text("arm: PSM\nposes:\n- [0.1, 0.1, 120.0, 0, 0, 0, 0.2]")
    with pytest.raises(CollectionError, match=r"pose 1: .*millimetres"):
        load_poses(tmp_path / "p.yaml", load_arm("psm"))


def test_random_poses_are_added_and_the_seed_says_which(tmp_path, capsys):
    path, arm = tmp_path / "p.yaml", load_arm("psm")
    command = ["collect", "--arm", "psm", "--poses", str(path), "--random"]
    assert main([*command, "5", "--seed", "3"]) == 0
    first = load_poses(path, arm)
    assert main([*command, "4", "--seed", "4"]) == 0
    both = load_poses(path, arm)
    np.testing.assert_array_equal(both[:5], first)
    np.testing.assert_array_equal(both[5:], random_poses(arm, 4, seed=4))
    assert main([*command, "0"]) == 2
    assert main([*command, "4", "--seed", "4"]) == 2  # the same again
    assert "is pose 6 again" in capsys.readouterr().err
    np.testing.assert_array_equal(load_poses(path, arm), both)
    assert [p.name for p in tmp_path.iterdir()] == ["p.yaml"]


# --- the file that grows


def append_all(path, arm, poses, both_sides=True):
    file = CollectionFile(path, arm, both_sides)
    for pose in poses:
        friction = (0.1 * pose,) if both_sides else ()
        file.append(pose, pose + 1e-3, 2 * pose, *friction)
    file.close()


@pytest.mark.parametrize("both_sides", [True, False])
@pytest.mark.parametrize("name", ARMS)
def test_a_collection_is_a_recording_and_goes_on(name, both_sides, tmp_path):
    arm, path = load_arm(name), tmp_path / "o.csv"
    poses = random_poses(arm, 6)
    append_all(path, arm, poses[:2], both_sides)
    again = CollectionFile(path, arm, both_sides)
    assert again.finished(poses).tolist() == [True, True, False, False, False, False]
    again.append(poses[4], poses[4], poses[4], *((poses[4],) if both_sides else ()))
    again.close()
    assert CollectionFile(path, arm, both_sides).finished(poses).tolist() == [True, True, False, False, True, False]
    recording = read_recording(path, arm)
    np.testing.assert_array_equal(recording.q, np.vstack([poses[:2] + 1e-3, poses[4]]))
    np.testing.assert_array_equal(recording.tau, np.vstack([2 * poses[:2], poses[4]]))


@pytest.mark.parametrize("cut", [1, 50, 10_000])
def test_a_row_that_a_power_failure_cut_is_measured_again(cut, tmp_path):
    arm, path = load_arm("mtml"), tmp_path / "o.csv"
    poses = random_poses(arm, 3)
    append_all(path, arm, poses)
    whole = path.read_bytes()
    path.write_bytes(whole[: max(len(whole) - cut, 20)])
    left = [True, True, False] if cut < 10_000 else [False] * 3
    again = CollectionFile(path, arm, True)
    assert again.finished(poses).tolist() == left
    for pose in poses[~np.array(left)]:
        again.append(pose, pose + 1e-3, 2 * pose, 0.1 * pose)
    again.close()
    rows = [line.rsplit(",", 8)[0] for line in path.read_text().splitlines()]  # without utime and friction
    assert rows == [line.rsplit(",", 8)[0] for line in whole.decode().splitlines()]


def test_an_output_of_something_else_is_refused_and_stays(tmp_path):
    arm, path = load_arm("mtml"), tmp_path / "o.csv"
    poses = random_poses(arm, 3)
    append_all(path, arm, poses)
    before = path.read_bytes()
    with pytest.raises(CollectionError, match=r"o.csv:2: was collected for a pose that is none of these"):
        CollectionFile(path, arm, True).finished(poses[1:])
    with pytest.raises(CollectionError, match=r"o.csv:2: is of MTML, not of MTMR"):
        CollectionFile(path, load_arm("mtmr"), True)
    with pytest.raises(CollectionError, match=r"was collected from both sides \(--both-sides\)"):
        CollectionFile(path, arm, False)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[-1] + ",1"]) + "\n")
    with pytest.raises(RecordingError, match=r"o.csv:5: has 31 cells, the header names 30"):
        CollectionFile(path, arm, True)
    path.write_text("q1,tau1\n1,2\n")
    with pytest.raises(CollectionError, match="was not collected from MTML; name another output"):
        CollectionFile(path, arm, True)
    path.write_bytes(before)


def test_all_that_was_written_survives_kill(tmp_path):
    """A process that appends until it is killed: whole rows, in order, no gap."""
    code = (
        "import sys\nfrom dvrk_drake.models.growing_file import GrowingFile\n"
        "file, k = GrowingFile(sys.argv[1], sync=True), 0\n"
        "while True:\n    file.append(b'%d,%s\\n' % (k, b'x' * 4000)); k += 1\n    print(k, flush=True)\n"
    )
    path = tmp_path / "f.csv"
    process = subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE, text=True)
    told = [int(process.stdout.readline()) for _ in range(50)][-1]
    process.send_signal(signal.SIGKILL)
    told = max([told, *map(int, process.stdout.read().split())])
    process.wait()
    rows = path.read_text().split("\n")
    assert rows.pop() == ""
    assert [int(row.split(",")[0]) for row in rows] == list(range(len(rows)))
    assert {len(row.split(",")[1]) for row in rows} == {4000}
    assert len(rows) >= told


def test_a_full_disk_leaves_whole_rows(tmp_path):
    code = (
        "import resource, signal, sys\nfrom dvrk_drake.models.growing_file import GrowingFile\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1050, 1050))\n"
        "file = GrowingFile(sys.argv[1], sync=True)\n"
        "while True:\n    file.append(b'x' * 99 + b'\\n')\n"
    )
    path = tmp_path / "f.csv"
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
    assert "RecordingError: " in done.stderr and "cannot be written any more: no space left" in done.stderr
    assert path.read_bytes() == 10 * (b"x" * 99 + b"\n")


# --- ways and rests


@pytest.mark.parametrize("name", ARMS)
def test_no_joint_is_faster_than_it_may_be_or_leaves_the_limits(name):
    arm = load_arm(name)
    speed = (arm.position_upper - arm.position_lower) / 5.0
    poses = random_poses(arm, 20, margin=0.0)
    for start, end in itertools.pairwise(poses):
        leg = Leg.between(start, end, speed)
        states = np.array([leg.state(t) for t in np.linspace(-1.0, leg.duration + 1.0, 400)])
        q, v = np.split(states, 2, axis=1)
        assert np.all(np.abs(v) <= speed * (1 + 1e-9))
        if leg.duration > 0.3:  # and none is slower than it need be
            assert np.max(np.abs(v) / speed) > 0.99
        assert not any(arm.limit_violations(pose, 1e-9) for pose in q)
        np.testing.assert_array_equal(q[0], start)
        np.testing.assert_allclose(q[-1], end, atol=1e-12)
        assert np.abs(v[[0, -1]]).max() < 1e-12


def test_braking_stays_on_the_way():
    """Whenever it is stopped, a leg's rest is between its ends, and the speed only falls."""
    arm = load_arm("mtml")
    start, end = random_poses(arm, 2)
    leg = Leg.between(start, end, np.full(7, 0.5))
    for t in np.linspace(0, leg.duration, 50):
        duration = min(0.3, max(leg.duration - t, 1e-3))
        stop = Leg.braking(leg.state(t), duration)
        states = np.array([stop.state(s) for s in np.linspace(0, duration, 20)])
        share = (states[:, :7] - start) / (end - start)
        assert np.all((share >= -1e-9) & (share <= 1 + 1e-9))
        assert np.all(np.diff(np.abs(states[:, 7:]), axis=0) <= 1e-9)
        np.testing.assert_allclose(states[0], leg.state(t), atol=1e-12)
        assert np.abs(states[-1, 7:]).max() < 1e-12


@pytest.mark.parametrize("name", ARMS)
def test_approaches_begin_inside_the_limits(name):
    arm = load_arm(name)
    offset = 0.3 * arm.effort_limits / np.array(arm.gains.kp)
    for pose in random_poses(arm, 200, margin=0.0):
        for side in (-1, 1):
            point = beside(arm, pose, side * offset)
            assert not arm.limit_violations(point, 1e-9)
            assert np.all(side * (point - pose) >= 0)
    middle = random_poses(arm, 1, margin=0.3)[0]
    np.testing.assert_allclose(beside(arm, middle, offset), middle + offset)


def test_rest_is_all_joints_near_one_pose_for_a_while():
    detector = RestDetector(np.array([0.01, 0.001]), 0.5)
    times = np.arange(0, 3, 0.01)
    q = np.column_stack([np.where(times < 1.0, times, 1.0), np.where(times < 1.8, 0.0, 0.1)])
    q += 1e-4 * np.sin(50 * times)[:, None]
    rests = np.array([detector.rests(t, pose) for t, pose in zip(times, q, strict=True)])
    expected = ((times > 1.5) & (times < 1.795)) | (times > 2.3)
    assert np.count_nonzero(rests != expected) <= 4
    assert not detector.rests(9.0, np.array([np.nan, 0.1]))
    creeping = RestDetector(np.array([0.01]), 0.5)
    assert not any(creeping.rests(t, np.array([0.03 * t])) for t in times)


# --- collecting from an arm with dry friction


class StickyArm:
    """An arm whose joints do not feel one another: weight, dry friction that truly sticks, efforts as commanded."""

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
        if not self.acts:
            return
        self.effort = np.array(command.effort)
        drive = self.effort - self.model.holding_torque(self.q)
        dv = PERIOD / self.inertia
        moved = self.v + dv * drive
        # Friction takes as much of the motion as it can, and no more.
        self.v = np.sign(moved) * np.maximum(np.abs(moved) - dv * self.friction, 0)
        self.q = self.q + PERIOD * self.v


def make_collector(path, poses, friction, both_sides=True, **options):
    arm = load_arm("mtml")
    model = IdentifiedModel.from_arm(arm)
    controller = ArmController(arm, model, "hold", PERIOD)
    sticky = StickyArm(arm, model, friction, poses[0] * 0.9)
    output = CollectionFile(path, arm, both_sides)
    return Collector(poses, controller, output, CollectionSettings(1.0, both_sides), **options), controller, sticky


def lead(collector, controller, sticky, seconds, until=lambda: False):
    end = sticky.ticks + round(seconds / PERIOD)
    while not (collector.finished or until()) and sticky.ticks < end:
        status, time = sticky.status(), PERIOD * sticky.ticks
        sticky.step(controller.answer(status, time, collector.lead(status, time)))


FRICTION = 0.08 * load_arm("mtml").effort_limits


def collect_with_friction(path, both_sides):
    arm = load_arm("mtml")
    poses = 0.5 * random_poses(arm, 1) + [0, 0.2, 0, 0, 0, 0, 0]
    lines = []
    collector, controller, sticky = make_collector(path, poses, FRICTION, both_sides, report=lines.append)
    lead(collector, controller, sticky, 60.0)
    collector.close()
    assert collector.finished and collector.problem is None and not collector.unsettled
    assert collector.done.all()
    assert len(lines) == 1
    recording = read_recording(path, arm)
    assert np.all(np.abs(recording.q - poses) < 0.1 * (arm.position_upper - arm.position_lower))
    return recording, (recording.tau - sticky.model.holding_torque(recording.q)) / FRICTION


def test_both_sides_cancel_dry_friction_and_one_does_not(tmp_path):
    _, error = collect_with_friction(tmp_path / "both.csv", True)
    _, one_sided = collect_with_friction(tmp_path / "one.csv", False)
    assert np.abs(error).max() < 0.01
    assert np.sqrt(np.mean(one_sided**2)) > 0.5
    table = np.genfromtxt(tmp_path / "both.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    friction = np.array([table[f"friction{j + 1}"] for j in range(7)])
    np.testing.assert_allclose(friction, FRICTION, rtol=0.01)


# --- whatever happens on the way


def near_poses(count=3):
    """Poses at which a one-sided collection takes about 1.3 s each."""
    return np.array([0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5]) + 0.05 * np.arange(count)[:, None]


def make_quick(tmp_path, **options):
    return make_collector(tmp_path / "o.csv", near_poses(), np.zeros(7), both_sides=False, **options)


def test_a_stop_on_the_way_brakes_and_the_rest_is_done_next_time(tmp_path):
    asked = []
    collector, controller, sticky = make_quick(tmp_path, stopped=lambda: bool(asked))
    moves = lambda: collector.done.any() and np.abs(sticky.v).max() > 0.03  # noqa: E731
    lead(collector, controller, sticky, 10.0, moves)
    assert moves() and not collector.finished
    asked.append(True)
    stopped_at = sticky.ticks
    lead(collector, controller, sticky, 1.0)
    collector.close()
    assert collector.finished and collector.problem is None
    assert PERIOD * (sticky.ticks - stopped_at) < 0.35
    assert np.abs(sticky.v).max() < 0.03
    assert collector.done.tolist() == [True, False, False]
    first = (tmp_path / "o.csv").read_bytes()

    collector, controller, sticky = make_quick(tmp_path)
    assert collector.done.tolist() == [True, False, False]
    lead(collector, controller, sticky, 20.0)
    collector.close()
    assert collector.done.all()
    assert (tmp_path / "o.csv").read_bytes().startswith(first)
    np.testing.assert_allclose(read_recording(tmp_path / "o.csv").q, near_poses(), atol=2e-3)


def test_a_stop_before_the_arm_obeys_ends_at_once(tmp_path):
    collector, controller, sticky = make_quick(tmp_path, stopped=lambda: True)
    lead(collector, controller, sticky, 0.1)
    assert collector.finished and collector.problem is None and sticky.ticks <= 2
    assert not (tmp_path / "o.csv").exists()


def test_it_ends_when_the_arm_takes_over(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    lead(collector, controller, sticky, 10.0, collector.done.any)
    sticky.off = True
    lead(collector, controller, sticky, 0.1)
    collector.close()
    assert collector.finished and "MTML took over and holds" in str(collector.problem)
    assert len(read_recording(tmp_path / "o.csv")) == 1


def test_it_ends_when_the_arm_never_obeys(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    sticky.off = True
    lead(collector, controller, sticky, 12.0)
    assert collector.finished and "did not let efforts act within 10 s" in str(collector.problem)


def test_it_ends_when_something_is_in_the_way(tmp_path):
    collector, controller, sticky = make_collector(
        tmp_path / "o.csv", near_poses() + np.outer([0, 1, 0], [0.3, 0.3, 0, 0, 0, 0, 0]), np.zeros(7), False
    )
    lead(collector, controller, sticky, 10.0, collector.done.any)
    sticky.friction = np.array([1e3] + [0.0] * 6)  # outer yaw is held
    lead(collector, controller, sticky, 5.0)
    collector.close()
    assert collector.finished and "does not follow: outer_yaw is at" in str(collector.problem)
    assert collector.done.tolist() == [True, False, False]


def test_a_pose_without_rest_is_left_out_and_named(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    lead(collector, controller, sticky, 10.0, lambda: collector.describe().endswith("settling at pose 2"))
    status = sticky.status
    shaken = lambda: [q + 0.01 * np.sin(60 * PERIOD * sticky.ticks) for q in sticky.q]  # noqa: E731

    def shaking():
        said = status()
        if "pose 2" in collector.describe():
            said.position = shaken()
        return said

    sticky.status = shaking
    lead(collector, controller, sticky, 20.0)
    collector.close()
    assert collector.finished and collector.problem is None
    assert collector.unsettled == [2]
    assert collector.done.tolist() == [True, False, True]


def test_a_file_that_cannot_be_written_ends_it(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    (tmp_path / "o.csv").mkdir()
    lead(collector, controller, sticky, 10.0)
    collector.close()
    assert collector.finished and isinstance(collector.problem, RecordingError)
    assert not collector.done.any()


@pytest.mark.parametrize("seconds", [0.5, 61.0])
def test_a_speed_that_is_not_allowed(seconds):
    with pytest.raises(CollectionError, match=r"must be 1..60 s; got"):
        CollectionSettings(seconds)


# --- the command, with an arm that sticks in place of the network


@pytest.fixture
def simulated(monkeypatch):
    """Options for what happens; `main` then controls a StickyArm."""
    arm = load_arm("mtml")
    what = SimpleNamespace(stopped=lambda sticky: False, off_at=None, arms=[])

    def ready(options, mode):
        controller = ArmController(arm, IdentifiedModel.from_arm(arm), mode, PERIOD)
        what.arms.append(StickyArm(arm, IdentifiedModel.from_arm(arm), np.zeros(7), near_poses()[0]))
        return controller, "", PERIOD

    def control(link, controller, stopped, tell, lead):
        sticky = what.arms[-1]
        while not stopped():
            status, time = sticky.status(), PERIOD * sticky.ticks
            sticky.off = sticky.ticks == what.off_at
            sticky.step(controller.answer(status, time, lead(status, time)))

    monkeypatch.setattr("dvrk_drake.cli.collect.ready_controller", ready)
    monkeypatch.setattr("dvrk_drake.processes.control.control", control)
    monkeypatch.setattr("dvrk_drake.processes.control.ArmLink", lambda arm, url: None)
    monkeypatch.setattr(
        "dvrk_drake.processes.simulated_arm.stop_on_signals", lambda: lambda: what.stopped(what.arms[-1])
    )
    return what


def test_the_command_stops_goes_on_and_says_so(simulated, tmp_path, capsys):
    poses, output = tmp_path / "p.yaml", tmp_path / "o.csv"
    save_poses(near_poses(2), load_arm("mtml"), poses)
    command = ["collect", "--arm", "mtml", "--poses", str(poses), "--output", str(output)]
    command += ["--traverse-time", "1", "--no-both-sides"]
    simulated.stopped = lambda sticky: sticky.ticks > 1000
    assert main(command) == 130
    said = capsys.readouterr()
    assert f"{output}: 0 of 2 poses" in said.out and said.err == "dvrk-drake: interrupted\n"

    simulated.stopped, simulated.off_at = lambda sticky: output.exists() and sticky.ticks > 2900, 2900
    assert main(command) == 2
    said = capsys.readouterr()
    assert f"{output}: 1 of 2 poses" in said.out
    assert said.err.startswith("dvrk-drake: error: MTML took over and holds") and said.err.count("\n") == 1

    simulated.stopped, simulated.off_at = lambda sticky: False, None
    assert main(command) == 0
    assert "1 poses of MTML to visit" in capsys.readouterr().out
    assert main(command) == 0
    assert f"{output}: has all 2 poses already" in capsys.readouterr().out
    assert len(simulated.arms) == 3  # the arm was not asked again
    np.testing.assert_allclose(read_recording(output).q, near_poses(2), atol=2e-3)


def test_the_command_teaches(simulated, tmp_path, monkeypatch, capsys):
    poses, arm = tmp_path / "p.yaml", load_arm("mtml")
    reading, writing = os.pipe()
    monkeypatch.setattr(sys, "stdin", os.fdopen(reading))
    os.close(writing)
    simulated.stopped = lambda sticky: sticky.ticks > 3000
    assert main(["collect", "--arm", "mtml", "--poses", str(poses), "--teach", "--at-rest"]) == 0
    np.testing.assert_allclose(load_poses(poses, arm), near_poses(1), atol=0.01)
    assert "pose 1 taken\n" in capsys.readouterr().out


# --- poses shown by hand


class Hand:
    """Tells a teacher of an arm that obeys, wherever the test puts it."""

    def __init__(self, path, at_rest=False):
        self.controller = SimpleNamespace(arm=load_arm("mtml"), ramped=True)
        self.lines, self.enter, self.time = [], False, 0.0
        self.teacher = Teacher(self.controller, path, at_rest=at_rest, told=self.told, report=self.lines.append)

    def told(self):
        enter, self.enter = self.enter, False
        return enter

    def at(self, pose, seconds, enter=False):
        """Stays at a pose; with `enter`, presses the key at first and waits until the file is written."""
        self.enter = enter
        end, said = self.time + seconds, len(self.lines)
        deadline = time.monotonic() + 10
        while self.time < end or (enter and len(self.lines) == said and time.monotonic() < deadline):
            self.time += 0.01
            self.teacher.lead(SimpleNamespace(position=list(pose)), self.time)
            time.sleep(1e-4)


def test_enter_takes_a_pose(tmp_path):
    path, arm = tmp_path / "p.yaml", load_arm("mtml")
    hand, poses = Hand(path), near_poses()
    hand.controller.ramped = False
    hand.at(poses[0], 0.1)
    hand.enter = True
    hand.at(poses[0], 0.1)
    assert not path.exists()  # the arm does not obey yet
    hand.controller.ramped = True
    hand.at(poses[0], 3.0)
    assert not path.exists()  # nobody pressed Enter
    hand.at(poses[0], 0.1, enter=True)
    np.testing.assert_array_equal(load_poses(path, arm), poses[:1])
    hand.at(poses[0] + 1e-3, 0.1, enter=True)
    hand.at([1.2, *poses[0, 1:]], 0.1, enter=True)
    hand.at(poses[1], 0.1, enter=True)
    hand.teacher.close()
    assert hand.lines[0] == "pose 1 taken"
    assert hand.lines[1] == "not taken: it is pose 1 again"
    assert hand.lines[2].startswith("not taken: outer_yaw = 1.2 is outside")
    assert hand.lines[3] == "pose 2 taken"
    np.testing.assert_array_equal(load_poses(path, arm), poses[:2])
    again = Hand(path)
    again.at(poses[2], 0.1, enter=True)
    np.testing.assert_array_equal(load_poses(path, arm), poses)


def test_a_rest_takes_a_pose_once(tmp_path):
    path, arm = tmp_path / "p.yaml", load_arm("mtml")
    hand, poses = Hand(path, at_rest=True), near_poses()
    hand.at(poses[0], 0.9)
    hand.at(poses[1], 3.0)
    hand.at([1.2, *poses[0, 1:]], 3.0)  # outside the limits: not taken, and nothing is said of it all the time
    hand.at(poses[2], 0.9)
    hand.at(poses[1], 3.0)
    hand.at(poses[2], 3.0)
    hand.teacher.close()
    np.testing.assert_array_equal(load_poses(path, arm), poses[1:])
    assert hand.lines == ["pose 1 taken", "pose 2 taken"]


def test_a_file_of_poses_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "folder").mkdir()
    hand = Hand(tmp_path / "folder" / "p.yaml")
    (tmp_path / "folder").rmdir()
    with pytest.raises(DvrkDrakeError, match="cannot be written"):
        hand.at(near_poses()[0], 0.1, enter=True)


def test_enter_key_never_waits():
    reading, writing = os.pipe()
    with os.fdopen(reading) as stream:
        key = EnterKey(stream)
        assert not key()
        os.write(writing, b"abc")
        assert not key()
        os.write(writing, b"\n")
        assert key() and not key()
        os.close(writing)
        assert not key() and not key()
