"""Tests pose files: exact round trip, and error messages of one line."""

import numpy as np
import pytest
from sticky_arm import random_poses

from dvrk_drake.cli import main
from dvrk_drake.errors import CollectionError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.pose_file import load_poses, save_poses

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
    with pytest.raises(CollectionError, match=message):
        load_poses(path, load_arm("mtml"))
    # With every option, the command refuses the file before it connects to an arm.
    for task in (["--output", str(output)], ["--teach"], ["--random", "2"]):
        assert main(["collect", "--arm", "mtml", "--poses", str(path), *task]) == 2
        error = capsys.readouterr().err
        assert error.startswith("dvrk-drake: error: ") and error.count("\n") == 1
        assert str(path) in error
    assert path.read_text() == text
    assert not output.exists()


def test_poses_in_millimetres_are_refused(tmp_path):
    (tmp_path / "p.yaml").write_text("arm: PSM\nposes:\n- [0.1, 0.1, 120.0, 0, 0, 0, 0.2]")
    with pytest.raises(CollectionError, match=r"pose 1: .*millimetres"):
        load_poses(tmp_path / "p.yaml", load_arm("psm"))


def test_random_poses_are_appended_and_depend_on_the_seed(tmp_path, capsys):
    path, arm = tmp_path / "p.yaml", load_arm("psm")
    command = ["collect", "--arm", "psm", "--poses", str(path), "--random"]
    assert main([*command, "5", "--seed", "3"]) == 0
    assert capsys.readouterr().out == f"wrote {path}: 5 poses of PSM\n"
    first = load_poses(path, arm)
    assert main([*command, "4", "--seed", "4"]) == 0
    assert capsys.readouterr().out == f"added 4 poses; {path} has 9 poses of PSM\n"
    both = load_poses(path, arm)
    np.testing.assert_array_equal(both[:5], first)
    np.testing.assert_array_equal(both[5:], random_poses(arm, 4, seed=[4, 5]))  # another seed than for an empty file
    assert main([*command, "0"]) == 2
    np.testing.assert_array_equal(load_poses(path, arm), both)
    assert main([*command, "4", "--seed", "4"]) == 0
    assert len(load_poses(path, arm)) == 13
    assert [p.name for p in tmp_path.iterdir()] == ["p.yaml"]
