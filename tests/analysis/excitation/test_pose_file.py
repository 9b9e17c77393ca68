"""Pose files and collection files: round trip, errors of one line, and interrupted collections."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from command_output import assert_refused
from sticky_arm import random_poses

from dvrk_drake.analysis.excitation.pose_file import CollectionFile, load_poses, save_poses
from dvrk_drake.cli import main
from dvrk_drake.errors import CollectionError, RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording

ARMS = ("mtml", "psm")


@pytest.mark.parametrize("name", ARMS)
def test_pose_file_round_trip_is_exact(name, tmp_path):
    arm = load_arm(name)
    poses = random_poses(arm, 30)
    save_poses(poses, arm, tmp_path / "p.yaml")
    np.testing.assert_array_equal(load_poses(tmp_path / "p.yaml", arm), poses)


GOOD = "0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; allowed in a pose file: format, arm, environment, poses"),
        ("just words", 'must have keys and values, not "just words"'),
        ("arm: MTML\nposes: []", "has no poses"),
        (f"arm: MTMR\nposes:\n- [{GOOD}]", 'arm is "MTMR", but the selected arm is MTML'),
        (f"poses:\n- [{GOOD}]", 'arm is "", but the selected arm is MTML'),
        (f"format: other\narm: MTML\nposes:\n- [{GOOD}]", 'format is "other"'),
        ("arm: MTML\nposes: 3", "poses is 3; allowed: a list of lists of numbers"),
        ("arm: MTML\nposes:\n- [a, b]", r'poses\[0\]\[0\] is "a"; allowed: a number'),
        (f"arm: MTML\nspeed: 3\nposes:\n- [{GOOD}]", 'key "speed" is unknown; allowed in a pose file'),
        ("arm: MTML\nposes: [[", "p.yaml: invalid YAML: line 2: "),
        (f"arm: MTML\nposes:\n- [{GOOD}]\n- [0.1, 0.2]", "pose 2: 2 numbers, but MTML has 7 joints: outer_yaw"),
        (f"arm: MTML\nposes:\n- [{GOOD[:-3]}.nan]", r"poses\[0\]\[6\] is nan; allowed: a finite number"),
        (f"arm: MTML\nposes:\n- [{GOOD[:-3]}.inf]", r"poses\[0\]\[6\] is inf; allowed: a finite number"),
        (f"arm: MTML\nposes:\n- [{GOOD}]\n- [0.101, {GOOD[5:]}]", "pose 2: equal to pose 1"),
        ("arm: MTML\nposes:\n- [5.7, 22.9, -14.3, 34.4, 51.6, 5.7, 28.6]", "pose 1: .*degrees"),
        (f"arm: MTML\nposes:\n- [{GOOD}]\n- [1.2, {GOOD[5:]}]", "pose 2: outer_yaw = 1.2 is outside"),
        ("arm: MTML\nposes:\n- [0.1, 0.7, 0.3, 0, 0, 0, 0]", "pose 1: parallelogram = 1 is outside"),
    ],
)
def test_invalid_pose_files_are_refused_in_one_line(text, message, tmp_path, capsys):
    path, output = tmp_path / "p.yaml", tmp_path / "o.csv"
    path.write_text(text)
    assert_refused(CollectionError, message, load_poses, path, load_arm("mtml"))
    # The commands refuse the file before they connect to an arm.
    for task in (["poses", str(path), "--output", str(output)], ["teach", str(path)]):
        assert main(["collect", *task, "--arm", "mtml"]) == 2
        error = capsys.readouterr().err
        assert error.startswith("dvrk-drake: error: ") and error.count("\n") == 1
        assert str(path) in error
    assert path.read_text() == text
    assert not output.exists()


def test_poses_in_millimetres_are_refused(tmp_path):
    (tmp_path / "p.yaml").write_text("arm: PSM\nposes:\n- [0.1, 0.1, 120.0, 0, 0, 0, 0.2]")
    assert_refused(CollectionError, r"pose 1: .*millimetres", load_poses, tmp_path / "p.yaml", load_arm("psm"))


# Tests that a collection file always has complete rows and can be continued after an interruption.


def append_all(path, arm, poses, both_sides=True):
    file = CollectionFile(path, arm, both_sides)
    for pose in poses:
        friction = (0.1 * pose,) if both_sides else ()
        file.append(pose, pose + 1e-3, 2 * pose, *friction)
    file.close()


@pytest.mark.parametrize("both_sides", [True, False])
@pytest.mark.parametrize("name", ARMS)
def test_collection_is_a_recording_and_can_be_continued(name, both_sides, tmp_path):
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
def test_incomplete_last_row_is_measured_again(cut, tmp_path):
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


@pytest.mark.parametrize("transport", ["lcm", "ros"])
@pytest.mark.parametrize("name", ["o.mcap", "o.yaml", "o"])
def test_output_must_be_a_csv(name, transport, tmp_path, capsys):
    arm, poses, output = load_arm("mtml"), tmp_path / "p.yaml", tmp_path / name
    save_poses(random_poses(arm, 2), arm, poses)
    for content in (None, b"\x89MCAP0\r\n"):
        if content is not None:
            output.write_bytes(content)
        # The command ends before it searches for the arm.
        command = ["collect", "poses", str(poses), "--arm", "mtml", "--output", str(output), "--transport", transport]
        assert main(command) == 2
        captured = capsys.readouterr()
        expected = f"dvrk-drake: error: {output}: a collection is a table; the file name must end in .csv\n"
        assert (captured.out, captured.err) == ("", expected)
    assert output.read_bytes() == content


def test_other_existing_output_is_refused_and_unchanged(tmp_path):
    arm, path = load_arm("mtml"), tmp_path / "o.csv"
    poses = random_poses(arm, 3)
    append_all(path, arm, poses)
    before = path.read_bytes()
    with pytest.raises(CollectionError, match=r"o.csv, line 2: the requested pose of this row is not in the pose file"):
        CollectionFile(path, arm, True).finished(poses[1:])
    with pytest.raises(CollectionError, match=r"o.csv, line 2: the row is of MTML, not of MTMR"):
        CollectionFile(path, load_arm("mtmr"), True)
    assert_refused(CollectionError, r"was collected from both sides \(--both-sides\)", CollectionFile, path, arm, False)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[-1] + ",1"]) + "\n")
    with pytest.raises(RecordingError, match=r"o.csv, line 5: the row has 32 cells, the header has 31"):
        CollectionFile(path, arm, True)
    path.write_text("q1,tau1\n1,2\n")
    assert_refused(CollectionError, "already exists and is not a collection of MTML", CollectionFile, path, arm, True)
    path.write_bytes(before)


def test_written_rows_survive_kill(tmp_path):
    """Kills a process that appends rows. The written rows are complete, in order and without gaps."""
    code = (
        "import sys\nfrom dvrk_drake.models.files import GrowingFile\n"
        "file, k = GrowingFile(sys.argv[1], sync=True), 0\n"
        "while True:\n    file.append(b'%d,%s\\n' % (k, b'x' * 4000)); k += 1\n    print(k, flush=True)\n"
    )
    path = tmp_path / "f.csv"
    process = subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE, text=True)
    last_row = [int(process.stdout.readline()) for _ in range(50)][-1]
    process.send_signal(signal.SIGKILL)
    last_row = max([last_row, *map(int, process.stdout.read().split())])
    process.wait()
    rows = path.read_text().split("\n")
    assert rows.pop() == ""
    assert [int(row.split(",")[0]) for row in rows] == list(range(len(rows)))
    assert {len(row.split(",")[1]) for row in rows} == {4000}
    assert len(rows) >= last_row


def test_full_disk_leaves_complete_rows(tmp_path):
    code = (
        "import resource, signal, sys\nfrom dvrk_drake.models.files import GrowingFile\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1050, 1050))\n"
        "file = GrowingFile(sys.argv[1], sync=True)\n"
        "while True:\n    file.append(b'x' * 99 + b'\\n')\n"
    )
    path = tmp_path / "f.csv"
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
    assert "RecordingError: " in done.stderr and "cannot be written: no space left" in done.stderr
    assert path.read_bytes() == 10 * (b"x" * 99 + b"\n")
