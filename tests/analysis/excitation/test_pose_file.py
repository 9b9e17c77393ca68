"""Tests pose files: exact round trip, and error messages of one line."""

import numpy as np
import pytest
from sticky_arm import random_poses

from dvrk_drake.analysis.excitation.pose_file import load_poses, save_poses
from dvrk_drake.cli import main
from dvrk_drake.errors import CollectionError
from dvrk_drake.models.arm_files import load_arm

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
    with pytest.raises(CollectionError, match=r"pose 1: .*millimetres"):
        load_poses(tmp_path / "p.yaml", load_arm("psm"))
