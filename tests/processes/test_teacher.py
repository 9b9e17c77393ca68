"""Poses that are taught by hand."""

import os
import pty
from types import SimpleNamespace

import numpy as np
import pytest
from sticky_arm import Disk, near_poses

from dvrk_drake.analysis.excitation.pose_file import load_poses
from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.teacher import EnterKey, Teacher


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
    with pytest.raises(DvrkDrakeError, match="cannot be written"):
        hand.at(near_poses()[0], 0.1, enter=True)


def test_last_pose_is_reported_at_the_end(tmp_path):
    """The operator may end the command while the file is written."""
    hand, broken = (Hand(tmp_path / folder / "p.yaml") for folder in (".", "missing"))
    for one in (hand, broken):
        one.at(near_poses()[0], 0.01, enter=True)
        assert one.lines == []
    hand.teacher.close()
    assert hand.lines == ["pose 1 recorded"]
    with pytest.raises(DvrkDrakeError, match="cannot be written"):
        broken.teacher.close()


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
