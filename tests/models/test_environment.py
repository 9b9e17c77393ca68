"""Fixed objects around an arm: another arm at known distances, and refused directives."""

import numpy as np
import pytest
from command_output import refusal
from models_in_directives import OTHER_ARM

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.collisions import CollisionDetector, first_collision
from dvrk_drake.analysis.excitation.motion_limits import motion_violations
from dvrk_drake.cli import main
from dvrk_drake.errors import ExcitationError
from dvrk_drake.recordings.periodic_motion import PeriodicMotion


@pytest.fixture(scope="module")
def arm():
    return dvrk.load_arm("mtml")


def test_collision_with_another_arm_ends_at_a_distance(arm):
    """Two equal arms at the same pose have a distance of 0 at no offset, and no collision beyond their width."""
    q = np.zeros((1, arm.num_joints))
    assert first_collision(arm, q) is None
    found = [first_collision(arm, q, dvrk.Environment(directives=OTHER_ARM.format(x=x))) for x in (0.02, 0.1, 0.5, 2.0)]
    assert found[0] and found[0][1].startswith("collision of ") and " and other::" in found[0][1]
    assert found[-1] is None
    touches = [entry is not None for entry in found]
    assert touches == sorted(touches, reverse=True)


def test_objects_may_touch_each_other_and_the_base(arm):
    """The base link of the other arm is at the same position as the own base."""
    environment = dvrk.Environment(table=0.0, directives=OTHER_ARM.format(x=0.0))
    q = arm.sample_poses(20, np.random.default_rng(0))
    for pose in q:
        assert "collision of base_link and" not in CollisionDetector(arm, environment).collision(pose)


def test_motion_keeps_its_distance_from_another_arm(arm, tmp_path):
    environment = dvrk.Environment(directives=OTHER_ARM.format(x=-0.27))
    limits = dvrk.MotionLimits(traverse_time=2.0, environment=environment)
    options = {"duration": 4.0, "period": 4.0, "harmonics": 2, "starts": 1}
    free = dvrk.design_excitation(arm, **options).motion
    assert any(" and other::" in line for line in motion_violations(free, arm, limits))
    motion = dvrk.design_excitation(arm, limits=limits, **options).motion
    assert motion_violations(motion, arm, limits) == []
    motion.save(tmp_path / "motion.yaml")
    assert PeriodicMotion.load(tmp_path / "motion.yaml", arm).environment == environment


@pytest.mark.parametrize(
    ("directives", "message"),
    [
        ("nonsense", "Drake cannot load the directives"),
        ("directives:\n- add_model:\n    name: a\n    file: package://none/a.sdf\n", "unknown package"),
        (OTHER_ARM.format(x=0).split("- add_weld")[0], "is not welded to the world; use add_weld"),
        (
            "directives:\n- add_frame:\n    name: f\n    X_PF: {base_frame: world}\n",
            "has a collision shape",
        ),
    ],
)
def test_wrong_directives_are_refused(directives, message, tmp_path, capsys):
    with pytest.raises(ExcitationError) as error:
        dvrk.Environment(directives=directives)
    assert message in str(error.value)
    path, output = tmp_path / "lab.dmd.yaml", tmp_path / "motion.yaml"
    path.write_text(directives)
    assert main(["excite", "--arm", "mtml", "--environment", str(path), "--output", str(output)]) == 2
    assert f"error: {path}: environment: " in refusal(capsys.readouterr().err) and not output.exists()
