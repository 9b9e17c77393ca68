"""Motions without a network: path, recording, pauses, interruptions and errors."""

import itertools

import numpy as np
import pytest
from command_output import assert_refused
from sticky_arm import PERIOD, Disk, StickyArm, random_poses, run_collector

from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.analysis.excitation.pose_file import offset_pose
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import CollectionError, RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes import motion_parts, motion_player
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.motion_parts import MotionPartFile, begin_of_rest, next_part, recorded_parts, useful
from dvrk_drake.processes.motion_player import MotionPlayer
from dvrk_drake.processes.teacher import RestDetector
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

ARM = load_arm("mtml")
MIDDLE = np.array([0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5])


@pytest.fixture(scope="module")
def motion():
    basis = FourierBasis.of(2.0, 3)
    weights = 0.04 * np.random.default_rng(0).normal(size=(7, 4)) * (ARM.position_upper - ARM.position_lower)[:, None]
    return PeriodicMotion.of_coefficients(ARM, basis, np.column_stack([MIDDLE, 0.3 * weights]), 2)


@pytest.fixture(autouse=True)
def short_parts(monkeypatch):
    monkeypatch.setattr(motion_parts, "MIN_PART", 1.0)
    monkeypatch.setattr(motion_parts, "OVERLAP", 0.4)


def make_player(motion, path=None, *, q=MIDDLE, friction=None, **options):
    model = IdentifiedModel.from_arm(ARM)
    controller = ArmController(ARM, model, "hold", PERIOD)
    sticky = StickyArm(ARM, model, np.zeros(7) if friction is None else friction, np.array(q, float))
    create = None if path is None else lambda: MotionPartFile(path, ARM, motion)
    player = MotionPlayer(motion, controller, sticky.q.copy(), output=create, **{"writer": Disk()} | options)
    return player, controller, sticky


def distance_from_path(motion, q):
    path = motion.evaluate(np.linspace(0, motion.period, 4000)).q / (ARM.position_upper - ARM.position_lower)
    return np.array([np.abs(path - x / (ARM.position_upper - ARM.position_lower)).max(axis=1).min() for x in q])


def test_recording_follows_the_motion_from_rest_to_rest(tmp_path, motion):
    path = tmp_path / "m.csv"
    player, *others = make_player(motion, path)
    run_collector(player, *others, 30.0)
    player.close()
    assert player.finished and player.problem is None
    recording = read_recording(path, ARM)
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    wanted = motion.evaluate(table["motion_time"])
    np.testing.assert_allclose(recording.q, wanted.q, atol=0.02)
    assert recording.tau.shape == (len(table), 7)
    assert np.abs(np.array(recording.qd)[[0, -1]]).max() < 0.02
    assert table["motion_time"][-1] == motion.duration
    assert np.all(np.diff(table["motion_time"]) >= 0) and np.all(np.diff(recording.t) > 0)
    assert np.all(player.largest_error >= np.abs(recording.q - wanted.q).max(axis=0) - 1e-12)


def test_rehearsal_is_slow_and_not_recorded(motion):
    player, controller, sticky = make_player(motion, end=motion.period, speed=0.2)
    fastest, full_speed = 0.0, np.abs(motion.evaluate(np.linspace(0, motion.period, 200)).v).max(axis=0)

    def is_fast():
        nonlocal fastest
        if player._is_playing:
            fastest = max(fastest, float(np.max(np.abs(sticky.v) / full_speed)))
        return False

    run_collector(player, controller, sticky, 40.0, is_fast)
    assert player.finished and player.problem is None and player.motion_time == motion.period
    assert 0.15 < fastest < 0.3


def test_pause_stops_on_the_path_and_continues(tmp_path, motion):
    pressed = []
    player, controller, sticky = make_player(motion, tmp_path / "m.csv", enter=lambda: bool(pressed and pressed.pop()))
    run_collector(player, controller, sticky, 20.0, lambda: player.motion_time > 1.0)
    pressed.append(True)
    run_collector(player, controller, sticky, 2.0)
    stopped_at = player.motion_time
    assert player.paused and not player.finished and "Enter continues" in player.describe()
    assert np.abs(sticky.v).max() < 0.02
    assert distance_from_path(motion, [sticky.q]).max() < 0.01
    run_collector(player, controller, sticky, 1.0)
    assert player.motion_time == stopped_at
    pressed.append(True)
    run_collector(player, controller, sticky, 20.0)
    player.close()
    assert player.problem is None and player.motion_time == motion.duration
    assert np.diff(read_recording(tmp_path / "m.csv", ARM).t).max() < 1.5 * PERIOD


def test_long_pause_ends_the_motion(monkeypatch, motion):
    monkeypatch.setattr(motion_player, "MAX_PAUSE", 1.0)
    pressed = []
    player, controller, sticky = make_player(motion, enter=lambda: bool(pressed and pressed.pop()))
    run_collector(player, controller, sticky, 20.0, lambda: player.motion_time > 1.0)
    pressed.append(True)
    run_collector(player, controller, sticky, 10.0)
    assert player.finished and player.problem is None and player.motion_time < motion.duration


def test_missing_part_is_recorded_after_a_stop(tmp_path, motion):
    path, stop = tmp_path / "m.csv", []
    player, controller, sticky = make_player(motion, path, stopped=lambda: bool(stop))
    run_collector(player, controller, sticky, 20.0, lambda: player.motion_time > 1.5)
    stop.append(True)
    stopped_at = sticky.ticks
    run_collector(player, controller, sticky, 2.0)
    player.close()
    assert player.finished and player.problem is None
    assert PERIOD * (sticky.ticks - stopped_at) < 0.6
    assert distance_from_path(motion, read_recording(path, ARM).q).max() < 0.01
    first = path.read_bytes()
    path.write_bytes(first + b"0.5,0.3")  # killed while writing a row

    parts = recorded_parts(path, ARM, motion)
    begin = begin_of_rest(parts, motion.duration)
    assert begin == pytest.approx(parts[0].end - 0.4) and next_part(path, parts) == tmp_path / "m_2.csv"
    player, controller, sticky = make_player(motion, tmp_path / "m_2.csv", begin=begin, q=sticky.q)
    run_collector(player, controller, sticky, 20.0)
    player.close()
    parts = recorded_parts(path, ARM, motion)
    assert begin_of_rest(parts, motion.duration) is None and len(useful(parts, motion.duration)) == 2
    second = read_recording(tmp_path / "m_2.csv", ARM)
    assert np.abs(np.array(second.qd)[0]).max() < 0.02
    assert distance_from_path(motion, second.q).max() < 0.01
    path.unlink()  # a new first part would be joined to the old second part
    assert_refused(CollectionError, r"m_2\.csv exists, but .*m\.csv does not", recorded_parts, path, ARM, motion)


def test_short_part_is_recorded_again(tmp_path, motion):
    path = tmp_path / "m.csv"
    stop = []
    player, controller, sticky = make_player(motion, path, stopped=lambda: bool(stop))
    run_collector(player, controller, sticky, 20.0, lambda: player.motion_time > 0.3)
    stop.append(True)
    run_collector(player, controller, sticky, 2.0)
    player.close()
    parts = recorded_parts(path, ARM, motion)
    assert len(parts) == 1 and not useful(parts, motion.duration) and begin_of_rest(parts, motion.duration) == 0.0


def test_part_of_another_motion_is_refused(tmp_path, motion):
    MotionPartFile(tmp_path / "m.csv", ARM, motion).close()
    assert begin_of_rest(recorded_parts(tmp_path / "m.csv", ARM, motion), motion.duration) == 0.0
    header = (tmp_path / "m.csv").read_text()
    cells = ["0"] * (header.count(",") - 1) + [ARM.name, "another motion"]
    (tmp_path / "m.csv").write_text(header + ",".join(cells) + "\n")
    assert_refused(CollectionError, "is a recording of another motion", recorded_parts, tmp_path / "m.csv", ARM, motion)
    (tmp_path / "m.csv").write_text("a,b\n1,2\n")
    with pytest.raises(CollectionError, match="is not a motion of MTML recorded by collect"):
        recorded_parts(tmp_path / "m.csv", ARM, motion)


def test_ends_when_arm_is_blocked(motion):
    player, controller, sticky = make_player(motion, speed=1.0)
    run_collector(player, controller, sticky, 20.0, lambda: player.motion_time > 0.2)
    move = sticky.move
    held = sticky.q.copy()

    def blocked(effort):
        move(effort)
        sticky.q = held + np.array([0, 0, 0, 0, 0, 0, 5.0])

    sticky.move = blocked
    run_collector(player, controller, sticky, 10.0)
    assert player.finished and "does not follow" in str(player.problem)


def test_last_seconds_before_a_tracking_error_are_removed(tmp_path, motion, monkeypatch):
    monkeypatch.setattr(motion_player, "_REMOVED", 0.5)
    path = tmp_path / "m.csv"
    player, controller, sticky = make_player(motion, path)
    run_collector(player, controller, sticky, 20.0, lambda: player.motion_time > 2.0)
    sticky.q = sticky.q + np.array([0, 0, 0, 0, 0, 0, 5.0])
    run_collector(player, controller, sticky, 10.0)
    failed_at = player.motion_time
    player.close()
    assert "does not follow" in str(player.problem)
    (part,) = recorded_parts(path, ARM, motion)
    assert failed_at - 0.8 < part.end < failed_at - 0.4
    assert path.read_bytes().endswith(f"{motion.digest()}\n".encode())


def test_repeated_and_invalid_statuses_are_not_recorded(tmp_path, motion):
    statuses = [make_player(motion)[2].status() for _ in range(5)]
    for k, status in enumerate(statuses):
        status.utime = 1_000_000 + 1000 * k
    statuses[1].utime = statuses[0].utime
    statuses[2].effort_measured = [float("nan")] * 7
    statuses[3].guard_state = statuses[3].STATE_OFF
    file = MotionPartFile(tmp_path / "m.csv", ARM, motion)
    file.append([(status, 0.1 * k) for k, status in enumerate(statuses)])
    file.close()
    assert read_recording(tmp_path / "m.csv", ARM).t.tolist() == [0.0, pytest.approx(0.004)]


def test_interrupted_header_is_an_empty_part(tmp_path, motion):
    path = tmp_path / "m.csv"
    for content in (b"", b"t [s],q1 [rad]"):
        path.write_bytes(content)
        (part,) = recorded_parts(path, ARM, motion)
        assert part.end == 0.0


def test_ends_when_position_is_not_finite(motion):
    player, controller, sticky = make_player(motion)
    run_collector(player, controller, sticky, 20.0, lambda: player.motion_time > 0.2)
    status = sticky.status()
    status.position = [float("nan")] * 7
    player.update(status, 0.0)
    assert player.finished and "does not follow" in str(player.problem)


def test_ends_when_arm_moved_after_the_check(motion):
    player, controller, sticky = make_player(motion)
    player._q_checked = player._q_checked + 0.06
    run_collector(player, controller, sticky, 10.0)
    assert "moved before the control started" in str(player.problem)


def test_full_disk_ends_the_motion(tmp_path, motion):
    class Full(MotionPartFile):
        def append(self, rows):
            raise RecordingError("no space left")

    player, controller, sticky = make_player(motion, tmp_path / "m.csv")
    player._create = lambda: Full(tmp_path / "m.csv", ARM, motion)
    run_collector(player, controller, sticky, 10.0)
    player.close()
    assert player.finished and "no space left" in str(player.problem)


def test_changed_motion_must_be_rehearsed_again(tmp_path, motion):
    path = tmp_path / "motion.yaml"
    motion.save(path)
    assert not motion_parts.is_rehearsed(path, ARM, motion)
    rehearsal = motion_parts.Rehearsal(arm=ARM.name, motion=motion.digest(), speed=0.2, tracking_error=[0.01] * 7)
    assert rehearsal.save(path) == tmp_path / "motion_rehearsal.yaml"
    loaded = PeriodicMotion.load(path, ARM)
    assert motion_parts.is_rehearsed(path, ARM, loaded)
    assert not motion_parts.is_rehearsed(path, load_arm("mtmr"), loaded)
    loaded.center[0] += 1e-9
    assert not motion_parts.is_rehearsed(path, ARM, loaded)


# Trajectories between poses, and detection of rest.


ARMS = ("mtml", "psm")


@pytest.mark.parametrize("name", ARMS)
def test_trajectory_respects_speed_and_position_limits(name):
    arm = load_arm(name)
    speed = (arm.position_upper - arm.position_lower) / 5.0
    poses = random_poses(arm, 20, margin=0.0)
    for start, end in itertools.pairwise(poses):
        trajectory = CubicTrajectory.rest_to_rest(start, end, speed)
        states = np.array([trajectory.state(t) for t in np.linspace(-1.0, trajectory.duration + 1.0, 400)])
        q, v = np.split(states, 2, axis=1)
        assert np.all(np.abs(v) <= speed * (1 + 1e-9))
        if trajectory.duration > 0.3:  # the speed limit is used
            assert np.max(np.abs(v) / speed) > 0.99
        assert not any(arm.limit_violations(pose, 1e-9) for pose in q)
        np.testing.assert_allclose(q[0], start, atol=1e-12)
        np.testing.assert_allclose(q[-1], end, atol=1e-12)
        assert np.abs(v[[0, -1]]).max() < 1e-12


def test_braking_stays_on_the_path():
    """After a stop at any time, the arm comes to rest between both ends of the trajectory, with decreasing speed."""
    arm = load_arm("mtml")
    start, end = random_poses(arm, 2)
    trajectory = CubicTrajectory.rest_to_rest(start, end, np.full(7, 0.5))
    for t in np.linspace(0, trajectory.duration, 50):
        duration = min(0.3, max(trajectory.duration - t, 1e-3))
        stop = CubicTrajectory.braking(trajectory.state(t), duration)
        states = np.array([stop.state(s) for s in np.linspace(0, duration, 20)])
        share = (states[:, :7] - start) / (end - start)
        assert np.all((share >= -1e-9) & (share <= 1 + 1e-9))
        assert np.all(np.diff(np.abs(states[:, 7:]), axis=0) <= 1e-9)
        np.testing.assert_allclose(states[0], trajectory.state(t), atol=1e-12)
        assert np.abs(states[-1, 7:]).max() < 1e-12


@pytest.mark.parametrize("name", ARMS)
def test_approaches_start_inside_limits(name):
    arm = load_arm(name)
    offset = 0.3 * arm.effort_limits / np.array(arm.gains.kp)
    for pose in random_poses(arm, 200, margin=0.0):
        for side in (-1, 1):
            point = offset_pose(arm, pose, side * offset)
            assert not arm.limit_violations(point, 1e-9)
            assert np.all(side * (point - pose) >= 0)
    middle = random_poses(arm, 1, margin=0.3)[0]
    np.testing.assert_allclose(offset_pose(arm, middle, offset), middle + offset, atol=1e-12)


def test_rest_requires_all_joints_near_one_pose():
    detector = RestDetector(np.array([0.01, 0.001]), 0.5)
    times = np.arange(0, 3, 0.01)
    q = np.column_stack([np.where(times < 1.0, times, 1.0), np.where(times < 1.8, 0.0, 0.1)])
    q += 1e-4 * np.sin(50 * times)[:, None]
    at_rest = np.array([detector.is_at_rest(t, pose) for t, pose in zip(times, q, strict=True)])
    expected = ((times > 1.5) & (times < 1.795)) | (times > 2.3)
    assert np.count_nonzero(at_rest != expected) <= 4
    assert not detector.is_at_rest(9.0, np.array([np.nan, 0.1]))
    creeping = RestDetector(np.array([0.01]), 0.5)
    assert not any(creeping.is_at_rest(t, np.array([0.03 * t])) for t in times)
