"""Pose collection without a network: cancellation of friction, interruptions and errors."""

import os
import pty
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from command_output import assert_refused
from recordings import csv_block
from sticky_arm import PERIOD, Disk, GuardedArm, make_collector, make_quick, near_poses, random_poses, run_collector

from dvrk_drake.analysis.excitation.pose_file import load_poses
from dvrk_drake.errors import CollectionError, DvrkDrakeError, RecordingError
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.collector import CollectionSettings
from dvrk_drake.processes.control import AnswerTimes, takeover_reason
from dvrk_drake.processes.teacher import EnterKey, Teacher
from dvrk_drake.recordings.formats import read_recording

FRICTION = 0.08 * load_arm("mtml").effort_limits


def collect_with_friction(path, both_sides):
    arm = load_arm("mtml")
    poses = 0.5 * random_poses(arm, 1) + [0, 0.2, 0, 0, 0, 0, 0]
    lines = []
    collector, controller, sticky = make_collector(path, poses, FRICTION, both_sides, report=lines.append)
    run_collector(collector, controller, sticky, 60.0)
    collector.close()
    assert collector.finished and collector.problem is None and not collector.unsettled
    assert collector.done.all()
    assert len(lines) == 1
    recording = read_recording(path, arm)
    assert np.all(np.abs(recording.q - poses) < 0.1 * (arm.position_upper - arm.position_lower))
    return recording, (recording.tau - sticky.model.holding_torque(recording.q)) / FRICTION


def test_only_approach_from_both_sides_cancels_friction(tmp_path):
    _, error = collect_with_friction(tmp_path / "both.csv", True)
    _, one_sided = collect_with_friction(tmp_path / "one.csv", False)
    assert np.abs(error).max() < 0.01
    assert np.sqrt(np.mean(one_sided**2)) > 0.5
    (friction,) = csv_block(tmp_path / "both.csv", "friction")
    np.testing.assert_allclose(friction, FRICTION, rtol=0.01, atol=0)


def test_stop_brakes_and_next_run_resumes(tmp_path):
    stop_requested = []
    collector, controller, sticky = make_quick(tmp_path, stopped=lambda: bool(stop_requested))
    moves = lambda: collector.done.any() and np.abs(sticky.v).max() > 0.03  # noqa: E731
    run_collector(collector, controller, sticky, 10.0, moves)
    assert moves() and not collector.finished
    stop_requested.append(True)
    stopped_at = sticky.ticks
    run_collector(collector, controller, sticky, 1.0)
    collector.close()
    assert collector.finished and collector.problem is None
    assert PERIOD * (sticky.ticks - stopped_at) < 0.35
    assert np.abs(sticky.v).max() < 0.03
    assert collector.done.tolist() == [True, False, False]
    first = (tmp_path / "o.csv").read_bytes()

    collector, controller, sticky = make_quick(tmp_path)
    assert collector.done.tolist() == [True, False, False]
    run_collector(collector, controller, sticky, 20.0)
    collector.close()
    assert collector.done.all()
    assert (tmp_path / "o.csv").read_bytes().startswith(first)
    np.testing.assert_allclose(read_recording(tmp_path / "o.csv").q, near_poses(), atol=2e-3)


def test_stop_before_start_ends_immediately(tmp_path):
    collector, controller, sticky = make_quick(tmp_path, stopped=lambda: True)
    run_collector(collector, controller, sticky, 0.1)
    assert collector.finished and collector.problem is None and sticky.ticks <= 2
    assert not (tmp_path / "o.csv").exists()


def test_ends_when_arm_takes_over(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    run_collector(collector, controller, sticky, 10.0, collector.done.any)
    sticky.off = True
    run_collector(collector, controller, sticky, 0.1)
    collector.close()
    assert collector.finished and "the guard of MTML holds the arm: its " in str(collector.problem)
    assert len(read_recording(tmp_path / "o.csv")) == 1


def test_ends_when_arm_applies_no_efforts(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    sticky.off = True
    run_collector(collector, controller, sticky, 12.0)
    assert collector.finished and "did not apply efforts within 10 s" in str(collector.problem)


def test_ends_when_arm_is_blocked(tmp_path):
    collector, controller, sticky = make_collector(
        tmp_path / "o.csv", near_poses() + np.outer([0, 1, 0], [0.3, 0.3, 0, 0, 0, 0, 0]), np.zeros(7), False
    )
    run_collector(collector, controller, sticky, 10.0, collector.done.any)
    sticky.friction = np.array([1e3] + [0.0] * 6)  # outer yaw is held
    run_collector(collector, controller, sticky, 5.0)
    collector.close()
    assert collector.finished and "does not follow: outer_yaw is at" in str(collector.problem)
    assert collector.done.tolist() == [True, False, False]


def test_pose_without_rest_is_skipped_and_reported(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    run_collector(collector, controller, sticky, 10.0, lambda: collector.describe().endswith("settling at pose 2"))
    status = sticky.status
    shaken = lambda: [q + 0.01 * np.sin(60 * PERIOD * sticky.ticks) for q in sticky.q]  # noqa: E731

    def shaking():
        changed = status()
        if "pose 2" in collector.describe():
            changed.position = shaken()
        return changed

    sticky.status = shaking
    run_collector(collector, controller, sticky, 20.0)
    collector.close()
    assert collector.finished and collector.problem is None
    assert collector.unsettled == [2]
    assert collector.done.tolist() == [True, False, True]


def test_rest_is_detected_with_alternating_encoder_count(tmp_path):
    """At rest, a reading may alternate between two encoder counts. A count of an MTM's wrist is 3 to 6 mrad."""
    collector, controller, sticky = make_quick(tmp_path)
    counts = load_arm("mtml").encoder_counts()
    assert counts.max() > 5e-3
    status = sticky.status

    def alternating():
        changed = status()
        changed.position = list(sticky.q + (sticky.ticks // 7 % 2) * counts)
        return changed

    sticky.status = alternating
    run_collector(collector, controller, sticky, 40.0)
    collector.close()
    assert collector.finished and collector.problem is None and not collector.unsettled
    assert collector.done.all()


def test_ends_when_file_cannot_be_written(tmp_path):
    collector, controller, sticky = make_quick(tmp_path)
    (tmp_path / "o.csv").mkdir()
    run_collector(collector, controller, sticky, 10.0)
    collector.close()
    assert collector.finished and isinstance(collector.problem, RecordingError)
    assert not collector.done.any()


def test_arm_is_held_while_disk_is_slow(tmp_path):
    disk = Disk(slow=True)
    collector, controller, sticky = make_quick(tmp_path, writer=disk)
    run_collector(collector, controller, sticky, 10.0, lambda: disk.waiting)
    run_collector(collector, controller, sticky, 12.0)  # longer than the arm may take to settle
    assert collector.problem is None and not collector.finished and not collector.done.any()
    assert collector.describe() == "0 of 3 poses, writing pose 1"
    np.testing.assert_allclose(sticky.q, near_poses()[0], atol=2e-3)
    disk.finish()
    disk.slow = False
    run_collector(collector, controller, sticky, 10.0)
    collector.close()
    assert collector.problem is None and collector.done.all()


def test_rows_are_written_by_another_thread(tmp_path):
    """Writes rows with Python's executor. The disk determines the time, so simulated time has no limit here."""
    collector, controller, sticky = make_quick(tmp_path, writer=None)
    written_by, append = [], collector._output.append
    collector._output.append = lambda *row: (append(*row), written_by.append(threading.get_ident()))
    run_collector(collector, controller, sticky, np.inf, collector.done.any)
    collector.close()
    assert threading.get_ident() not in written_by and len(written_by) == 1
    assert len(read_recording(tmp_path / "o.csv")) == 1


@pytest.mark.parametrize("seconds", [0.5, 61.0])
def test_rejects_speed_out_of_range(seconds):
    assert_refused(CollectionError, r"allowed: 1..60 s", CollectionSettings, seconds)


def test_trajectory_follows_clock_of_slow_arm(tmp_path):
    """The arm's clock runs four times slower than the computer's clock. The trajectory follows the arm's clock."""
    poses = random_poses(load_arm("mtml"), 3, seed=4)
    collector, controller, sticky = make_collector(tmp_path / "o.csv", poses, np.zeros(7), both_sides=False)
    while not collector.finished and sticky.ticks < 20_000:
        status, time = sticky.status(), 4 * PERIOD * sticky.ticks
        sticky.step(controller.answer(status, time, collector.update(status, time)))
    collector.close()
    assert collector.problem is None
    assert collector.done.all()


def collect_until_first_pose(tmp_path):
    """Returns collector, controller and guarded arm after the first pose, with an old refusal in the status."""
    made = make_collector(tmp_path / "o.csv", near_poses(), np.zeros(7), both_sides=False, arm_type=GuardedArm)
    collector, controller, arm = made
    bad = controller.answer(arm.status(), 0.0)
    bad.effort = [np.nan] * 7
    arm.step(bad)
    assert arm.guard.refusal_code == Status.REFUSAL_NOT_FINITE
    run_collector(collector, controller, arm, 10.0, collector.done.any)
    assert collector.done.any() and arm.guard.state == Status.STATE_EFFORT
    return made


def problem_after(made, pause):
    """Returns the problem that the collector reports if its clock advances by `pause` [s]."""
    collector, controller, arm = made
    start = PERIOD * arm.ticks + pause
    for tick in range(60):  # longer than the expiry
        if collector.finished:
            break
        status, time = arm.status(), start + PERIOD * tick
        arm.step(controller.answer(status, time, collector.update(status, time)))
    collector.close()
    assert collector.finished
    return str(collector.problem)


def test_pause_of_this_computer_is_reported(tmp_path):
    made = collect_until_first_pose(tmp_path)
    for _ in range(80):
        made[2].step()
    problem = problem_after(made, 0.0)
    assert made[2].guard.counts.expired == 1
    assert "too slow" in problem and "longest interval 81 ms" in problem and "commands per second" in problem
    assert "refusal" not in problem


def test_pause_of_arm_computer_is_reported(tmp_path):
    """The arm's clock stands still during the pause, so the guard refuses a jump of the sender's clock."""
    made = collect_until_first_pose(tmp_path)
    problem = problem_after(made, 0.08)
    assert made[2].guard.refusal_code == Status.REFUSAL_CLOCK_JUMP
    assert "too slow" in problem and "longest interval 81 ms" in problem and "jump" not in problem


def test_refusal_without_pause_is_reported(tmp_path):
    made = collect_until_first_pose(tmp_path)
    collector, controller, arm = made
    while not collector.finished:
        status, time = arm.status(), PERIOD * arm.ticks
        command = controller.answer(status, time, collector.update(status, time))
        command.utime -= 10**6
        arm.step(command)
    problem = problem_after(made, 0.0)
    assert "last refused command: jump of the sender's clock" in problem


def test_earlier_refusal_is_not_reported():
    before, status = Status(), Status()
    for of in (before, status):
        of.num_refused, of.refusal_code = 3, Status.REFUSAL_OTHER_SENDER
    status.guard_state = Status.STATE_HOLD
    assert takeover_reason(status, before, AnswerTimes()) == "its state is hold"
    status.num_refused += 1
    assert takeover_reason(status, before, AnswerTimes()) == "last refused command: sent by a second sender"
    status.num_refused, status.num_ignored, status.ignored_code = 3, 1, Status.REFUSAL_NOT_AUTHENTIC
    problem = takeover_reason(status, before, AnswerTimes())
    assert problem == "the arm ignores messages: not signed with the arm's key (--key)"
    status.num_expired = 3
    assert takeover_reason(status, before, AnswerTimes()) == "commands arrived too late (use --realtime)"


# Poses that are taught by hand.


class Hand:
    """Operator that moves the arm of a Teacher to given poses."""

    def __init__(self, path, at_rest=False):
        self.controller = SimpleNamespace(arm=load_arm("mtml"), ramped=True)
        self.lines, self.enter, self.time = [], False, 0.0
        self.teacher = Teacher(
            self.controller, path, at_rest=at_rest, requested=self.requested, report=self.lines.append, writer=Disk()
        )

    def requested(self):
        enter, self.enter = self.enter, False
        return enter

    def at(self, pose, seconds, enter=False):
        """Holds the arm at a pose. With `enter`, presses the key first."""
        self.enter, end = enter, self.time + seconds
        while self.time < end:
            self.time += 0.01
            self.teacher.update(SimpleNamespace(position=list(pose)), self.time)


def test_enter_records_a_pose(tmp_path):
    path, arm = tmp_path / "p.yaml", load_arm("mtml")
    hand, poses = Hand(path), near_poses()
    hand.controller.ramped = False
    hand.at(poses[0], 0.1)
    hand.enter = True
    hand.at(poses[0], 0.1)
    assert not path.exists()  # the efforts are not applied yet
    hand.controller.ramped = True
    hand.at(poses[0], 3.0)
    assert not path.exists()  # Enter was not pressed
    hand.at(poses[0], 0.1, enter=True)
    np.testing.assert_array_equal(load_poses(path, arm), poses[:1])
    hand.at(poses[0] + 1e-3, 0.1, enter=True)
    hand.at([1.2, *poses[0, 1:]], 0.1, enter=True)
    hand.at(poses[1], 0.1, enter=True)
    hand.teacher.close()
    assert hand.lines[0] == "pose 1 recorded"
    assert hand.lines[1] == "not recorded: same as pose 1"
    assert hand.lines[2].startswith("not recorded: outer_yaw = 1.2 is outside")
    assert hand.lines[3] == "pose 2 recorded"
    np.testing.assert_array_equal(load_poses(path, arm), poses[:2])
    again = Hand(path)
    again.at(poses[2], 0.1, enter=True)
    np.testing.assert_array_equal(load_poses(path, arm), poses)


def test_rest_records_a_pose_once(tmp_path):
    path, arm = tmp_path / "p.yaml", load_arm("mtml")
    hand, poses = Hand(path, at_rest=True), near_poses()
    hand.at(poses[0], 0.9)
    hand.at(poses[1], 3.0)
    hand.at([1.2, *poses[0, 1:]], 3.0)  # outside the limits: not recorded and not reported repeatedly
    hand.at(poses[2], 0.9)
    hand.at(poses[1], 3.0)
    hand.at(poses[2], 3.0)
    hand.teacher.close()
    np.testing.assert_array_equal(load_poses(path, arm), poses[1:])
    assert hand.lines == ["pose 1 recorded", "pose 2 recorded"]


def test_unwritable_pose_file_is_an_error(tmp_path):
    (tmp_path / "folder").mkdir()
    hand = Hand(tmp_path / "folder" / "p.yaml")
    (tmp_path / "folder").rmdir()
    assert_refused(DvrkDrakeError, "cannot be written", hand.at, near_poses()[0], 0.1, enter=True)


def test_last_pose_is_reported_at_the_end(tmp_path):
    """The operator may end the command while the file is written."""
    hand, broken = (Hand(tmp_path / folder / "p.yaml") for folder in (".", "missing"))
    for one in (hand, broken):
        one.at(near_poses()[0], 0.01, enter=True)
        assert one.lines == []
    hand.teacher.close()
    assert hand.lines == ["pose 1 recorded"]
    assert_refused(DvrkDrakeError, "cannot be written", broken.teacher.close)


def test_enter_key_does_not_block():
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


def test_background_process_does_not_read_its_terminal(monkeypatch):
    """The system would stop a background process, e.g. a bridge, that reads from its terminal."""
    master, slave = pty.openpty()
    foreground = os.getpgrp() + 1
    monkeypatch.setattr(os, "tcgetpgrp", lambda descriptor: foreground)
    with open(slave) as stream:
        key = EnterKey(stream)
        os.write(master, b"\n")
        assert not key() and not key()
        foreground = os.getpgrp()
        assert key()
    os.close(master)


def test_closed_terminal_ends_no_process(monkeypatch):
    master, slave = pty.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda descriptor: os.getpgrp())
    with open(slave) as stream:
        key = EnterKey(stream)
        os.write(master, b"\n")
        assert key() and not key()
        os.close(master)
        assert not key() and not key()
