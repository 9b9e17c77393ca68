"""Static poses: expected errors, optimality of the selection, limits, order, and the command."""

from itertools import pairwise, permutations

import numpy as np
import pytest
from command_output import refused

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation import static_poses
from dvrk_drake.analysis.excitation.motion_limits import CollisionDetector, MotionLimits, first_collision, tip_positions
from dvrk_drake.analysis.excitation.pose_file import approach_offset, load_poses, offset_pose
from dvrk_drake.analysis.excitation.static_poses import MARGIN, MIN_APPROACH, PoseChecker, PoseInformation, _ordered
from dvrk_drake.cli import main
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.environment import Environment
from dvrk_drake.processes.arm_controller import MotionStyle
from dvrk_drake.processes.collector import CollectionSettings, approaches


@pytest.fixture(scope="module", autouse=True)
def small_pool():
    """Selects from 150 instead of 1500 random poses."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(static_poses, "POOL", 150)
        yield


@pytest.fixture(scope="module", params=["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def information(request):
    arm = dvrk.load_arm(request.param)
    checker = PoseChecker(arm, MotionLimits(margin=MARGIN))
    return PoseInformation(arm, checker.random_poses(200, 20, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def design(information):
    return dvrk.design_poses(information.arm, 12, seed=3)


def test_expected_error_is_that_of_simulated_estimates(information):
    """Parameters from the prior and measurements with noise give maximum-a-posteriori estimates with this error."""
    generator, chosen = np.random.default_rng(0), np.arange(15)
    X = information.columns[chosen].reshape(-1, information.columns.shape[2])
    C = information.covariance(chosen)
    target = np.linalg.cholesky(information._criterion.target + 1e-12 * np.eye(len(C)))
    squares = []
    for _ in range(2000):
        x = generator.normal(size=len(C))
        estimate = C @ X.T @ (X @ x + generator.normal(size=len(X)))
        squares.append(np.sum((target.T @ (estimate - x)) ** 2))
    assert np.sqrt(np.mean(squares)) == pytest.approx(information.expected_error(chosen), rel=0.05)


def test_reduction_is_the_difference_of_errors(information):
    chosen = [3, 5, 7, 11]
    before = information.expected_error(chosen) ** 2
    reductions = information.reductions(information.covariance(chosen))
    for k in (0, 20, 199):
        assert before - information.expected_error([*chosen, k]) ** 2 == pytest.approx(reductions[k], rel=1e-6)
    assert np.all(reductions > 0)


def test_no_exchange_of_one_pose_helps(information):
    usable = np.ones(200, bool)
    usable[50:60] = False
    chosen = information.select(8, usable)
    assert len(set(chosen)) == 8 and not set(chosen) & set(range(50, 60))
    least = information.expected_error(chosen)
    for i in range(8):
        rest = chosen[:i] + chosen[i + 1 :]
        for k in set(np.flatnonzero(usable)) - set(chosen):
            assert information.expected_error([*rest, k]) > least * (1 - 1e-6)


def test_selected_poses_beat_random_poses(information, design):
    assert design.expected_error < 0.9 * design.random_error
    assert 0 <= design.known_parameters <= design.num_parameters == information.num_base
    more = dvrk.design_poses(information.arm, 24, seed=3)
    assert more.expected_error < design.expected_error


def test_poses_and_approaches_meet_the_limits(information, design):
    arm = information.arm
    joints = MotionLimits(margin=MARGIN).of_arm(arm)
    value = design.poses @ joints.A.T
    assert np.all((value >= joints.lower) & (value <= joints.upper))
    for pose in design.poses:
        for side in (-1, 1):
            begin = offset_pose(arm, pose, side * approach_offset(arm))
            assert not arm.limit_violations(begin, 1e-9)
            assert np.all(side * (begin - pose) >= MIN_APPROACH * approach_offset(arm) - 1e-12)
    assert first_collision(arm, design.poses) is None


@pytest.mark.slow
def test_path_above_a_table_has_no_collision():
    arm = dvrk.load_arm("psm")
    limits = MotionLimits(margin=MARGIN, positions={"insertion": (0.05, 0.2)}, environment=Environment(-0.15))
    design = dvrk.design_poses(arm, 10, limits=limits)
    points = []
    for pose in design.poses:
        for begin in approaches(arm, pose, CollectionSettings(), MotionStyle.of_goals(arm)):
            points += [begin, pose]
    assert np.min(points, axis=0)[2] >= 0.05 and np.max(points, axis=0)[2] <= 0.2
    path = [a + s * (b - a) for a, b in pairwise(points) for s in np.linspace(0, 1, 23)]
    assert first_collision(arm, np.array(path), Environment(-0.15)) is None
    assert tip_positions(arm, design.poses)[:, 2].min() > -0.15


def test_tip_stays_in_the_box():
    arm = dvrk.load_arm("psm")
    limits = MotionLimits(margin=MARGIN, tip_box=((-0.1, -0.1, -0.2), (0.1, 0.1, 0.0)))
    poses = PoseChecker(arm, limits).random_poses(20, 5, np.random.default_rng(0))
    tip = tip_positions(arm, poses)
    assert np.all((tip >= limits.tip_box[0]) & (tip <= limits.tip_box[1]))
    np.testing.assert_allclose(CollisionDetector(arm).tip(poses[3]), tip[3], atol=1e-12)


class BlockedPaths:
    """Checker of points in a plane that blocks some paths."""

    def __init__(self, blocked=()):
        self.blocked = blocked

    def travel(self, poses):
        return np.abs(poses[:, None] - poses).max(axis=2)

    def can_follow(self, pose, following):
        return (pose[0], following[0]) not in self.blocked


def test_order_is_short():
    """The path is at most half longer than the shortest one."""
    generator = np.random.default_rng(0)
    for _ in range(20):
        pool = generator.uniform(size=(6, 2))
        travel = BlockedPaths().travel(pool)
        order, excluded = _ordered(BlockedPaths(), pool, list(range(6)))
        shortest = min(travel[path[:-1], path[1:]].sum() for path in map(list, permutations(range(6))))
        assert sorted(order) == list(range(6)) and not excluded
        assert travel[order[:-1], order[1:]].sum() < 1.5 * shortest


def test_order_avoids_blocked_paths():
    pool = np.arange(5.0)[:, None]
    order, excluded = _ordered(BlockedPaths({(1.0, 2.0), (2.0, 1.0)}), pool, [0, 1, 2, 3, 4])
    pairs = list(pairwise(order))
    assert not excluded and sorted(order) == [0, 1, 2, 3, 4] and not {(1, 2), (2, 1)} & set(pairs)


@pytest.mark.parametrize("isolated", [0, 3])
def test_isolated_poses_are_excluded(isolated):
    blocked = {(a, b) for a in range(5) for b in range(5) if (a == isolated) != (b == isolated)}
    assert _ordered(BlockedPaths(blocked), np.arange(5.0)[:, None], [0, 1, 2, 3, 4])[1] == [isolated]


@pytest.mark.parametrize(
    ("count", "limits", "message"),
    [
        (7, None, "the number of poses is 7; allowed: 8 to 300"),
        (301, None, "the number of poses is 301"),
        (10, MotionLimits(environment=Environment(0.0)), "only 0 of 4050 random poses meet all limits, but 10 poses"),
        (10, MotionLimits(positions={"roll": (0.0, 0.1)}), "position limit at the start of an approach"),
        (10, MotionLimits(positions={"rol": (0.0, 0.1)}), 'unknown joint "rol"'),
    ],
)
def test_wrong_arguments_are_rejected(count, limits, message):
    with pytest.raises(ExcitationError) as error:
        dvrk.design_poses(dvrk.load_arm("psm"), count, limits=limits)
    assert message in str(error.value)


def test_command_writes_a_pose_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["excite", "--arm", "mtml", "--static", "8", "--seed", "2"]
    (tmp_path / "p.yaml").write_text("mine")
    assert main([*command, "--output", "p.yaml", "--overwrite"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "MTML: 8 static poses. Expected error of predicted holding efforts:" in out
    assert "% with 8 random poses" in out
    assert "Next: dvrk-drake collect poses p.yaml --arm mtml --output p.csv" in out
    assert "gravity parameters known to 10 %" in out
    assert load_poses("p.yaml", dvrk.load_arm("mtml")).shape == (8, 7)
    for options, message in (
        (["--output", "p.yaml"], "p.yaml already exists"),
        (["--output", "n.yaml", "--csv", "n.csv"], "--csv cannot be used with --static"),
        (["--output", "n.yaml", "--period", "15", "--starts", "4"], "--period and --starts cannot be used with"),
        (["--output", "n.yaml", "--traverse-time", "2"], "--traverse-time cannot be used with --static"),
    ):
        assert message in refused(capsys, *command, *options)
    assert "the number of poses is 3; allowed: 8 to 300" in refused(capsys, *command[:4], "3", "--output", "n.yaml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.yaml"]
