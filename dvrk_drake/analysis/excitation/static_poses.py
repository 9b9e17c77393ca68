"""Chooses static poses that give the most information about the holding efforts of an arm, within all limits."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.pose_effects import MIN_TORQUE, StaticProblem, candidate_effects
from dvrk_drake.analysis.excitation.information import ExpectedError, middle_pose
from dvrk_drake.analysis.excitation.motion_limits import PATH_STEP, ROUNDING, CollisionDetector, MotionLimits
from dvrk_drake.analysis.excitation.pose_file import approach_offset, offset_pose, save_poses
from dvrk_drake.analysis.excitation.predicted_effort import PredictedEffort
from dvrk_drake.analysis.observations.static_poses import MIN_POSES
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.files import Reportable, refuse_existing
from dvrk_drake.models.plant import inverse_dynamics
from dvrk_drake.progress import Progress, step_progress

#: Number of random poses from which the poses are selected, largest number of random poses that are drawn for this
#: pool, and largest number of selected poses. If 5 % of the drawn poses meet all limits, the pool is complete. With
#: half the pool, the expected error for 30 poses of an MTML is 7.7 % instead of 7.6 %; with twice the pool, 7.5 %.
POOL, MAX_DRAWN, MAX_POSES = 1500, 30_000, 300
#: Number of drawn poses after which the search ends if none of them meets all limits. Then, at most 0.075 % of all
#: poses meet them (95 % confidence, three divided by the number).
_MAX_FAILED = 4000
#: Margin of the default limits, as for random poses of `collect`: there is room to approach a pose from both sides.
MARGIN = 0.1
#: Smallest share of an approach offset of a joint that must remain inside the limits, on both sides. Of `APPROACH`,
#: this is 3.2 % of the range of the joint, the shortest travel of the hysteresis that `TRAVELS` assumes between poses.
MIN_APPROACH = 0.4
#: Standard deviation of the error of a measured holding effort, as a share of the effort limit. The RMS residuals of
#: the public poses `mtm_2015_good72` are 0.8 % of it (wrist yaw) to 7 %. Most of them are errors of the model.
EFFORT_ERROR = 0.01
#: Number of random poses for which holding efforts are predicted, and number of random selections for the comparison.
#: Half or twice the first number changes the same expected error by less than 0.1 %.
NUM_TARGETS, NUM_RANDOM = 2000, 20
#: Smallest relative reduction of the squared expected error by an exchange. Half or twice the value gives the same
#: expected error for 30 poses of an MTML.
_MIN_REDUCTION = 1e-6


@dataclass(frozen=True, eq=False)
class StaticPoseDesign(Reportable):
    """Static poses for `collect` and the information that they give.

    Attributes:
        arm: Arm of the poses.
        poses: Poses (m, n) in the order of a short path [rad, m].
        environment: Fixed objects that the paths avoid.
        expected_error: Expected RMS error of the holding efforts that an identified model predicts at random poses of
            the workspace, relative to the RMS holding efforts, see `PoseInformation.expected_error`.
        random_error: Median expected error after as many random poses within the same limits.
        known_parameters: Number of base parameters of gravity with a standard error of at most 10 %.
        num_parameters: Number of base parameters of gravity.
    """

    arm: Arm
    poses: NDArray[np.float64]
    environment: Environment
    expected_error: float
    random_error: float
    known_parameters: int
    num_parameters: int

    def __repr__(self) -> str:
        return (
            f"<StaticPoseDesign of {self.arm.name}: {len(self.poses)} poses, expected error "
            f"{100 * self.expected_error:.1f} %>"
        )

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes the poses to a pose file of `collect`.

        Raises:
            DvrkDrakeError: The file exists and `overwrite` is False, or the file cannot be written.
        """
        refuse_existing(path, overwrite)
        save_poses(self.poses, self.arm, path, self.environment)


def design_poses(
    arm: Arm,
    count: int = 40,
    *,
    limits: MotionLimits | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> StaticPoseDesign:
    """Chooses static poses for `identify`, each with room for the approaches from below and from above.

    The poses are selected from random poses within the limits. They minimise the expected error of the holding efforts
    that the identified model predicts at random poses of the workspace (V-optimality), see `PoseInformation`. The
    selection adds one pose at a time, and then exchanges single poses until no exchange reduces the error. The order
    makes the path short. Collisions are checked along all straight paths of a collection in this order.

    Args:
        arm: Arm to move.
        count: Number of poses, 8 to 300.
        limits: Limits of the poses. The limits of speed, acceleration and jerk are not used. None: the defaults of
            `MotionLimits` with a margin of 10 %, as for random poses of `collect`.
        seed: Seed of the random poses.
        progress: Callback that receives the name of the step ("selecting poses") and the finished share (0 to 1).

    Raises:
        ExcitationError: An argument is out of range, or too few poses meet the limits.

    Example:
        >>> import dvrk_drake as dvrk
        >>> design = dvrk.design_poses(dvrk.load_arm("mtml"), 8)
        >>> design.poses.shape
        (8, 7)
        >>> design.expected_error < design.random_error
        True
        >>> design.save("poses.yaml")
    """
    if not MIN_POSES <= count <= MAX_POSES:
        raise ExcitationError(f"the number of poses is {count}; allowed: {MIN_POSES} to {MAX_POSES}")
    limits = limits or MotionLimits(margin=MARGIN)
    share = step_progress(progress, "selecting poses")
    share(0.0)
    checker = PoseChecker(arm, limits)
    pool = checker.random_poses(max(POOL, 4 * count), count, np.random.default_rng(seed))
    share(0.2)
    information = PoseInformation(arm, pool)
    usable = np.ones(len(pool), bool)
    chosen = information.select(count, usable)
    random = np.random.default_rng([seed, 1])
    errors = [information.expected_error(random.permutation(len(pool))[:count]) for _ in range(NUM_RANDOM)]
    while True:
        share(0.6)
        chosen, excluded = _ordered(checker, pool, chosen)
        if not excluded:
            break
        usable[excluded] = False
        if usable.sum() < count:
            raise ExcitationError(
                f"{arm.name}: only {usable.sum()} of {len(pool)} random poses can be reached on straight paths, but "
                f"{count} poses are required. Reduce the number of poses, or widen the limits"
            )
        chosen = information.select(count, usable, [k for k in chosen if usable[k]])
    share(1.0)
    return StaticPoseDesign(
        arm=arm,
        poses=pool[chosen],
        environment=limits.environment,
        expected_error=information.expected_error(chosen),
        random_error=float(np.median(errors)),
        known_parameters=information.known_parameters(chosen),
        num_parameters=information.num_base,
    )


#: Indices of poses in a pool.
Indices = list[int] | NDArray[np.int_]


@dataclass(frozen=True, eq=False)
class PoseInformation:
    """Linear model of the holding efforts of an arm, with the priors of `identify` for static poses.

    The unknowns are the base parameters of gravity and all candidate effects: offsets, cables and springs. `identify`
    selects some of these effects after the measurement. Each effort is the average of two approaches, so Coulomb
    friction is not included.

    Attributes:
        arm: Arm to identify.
        pool: Poses (k, n) that can be measured [rad, m].
    """

    arm: Arm
    pool: NDArray[np.float64]

    @cached_property
    def _targets(self) -> NDArray[np.float64]:
        return self.arm.sample_poses(NUM_TARGETS, np.random.default_rng(1))

    @cached_property
    def _problem(self) -> StaticProblem:
        return _without_efforts(self.arm, self.pool)

    @cached_property
    def effort(self) -> NDArray[np.float64]:
        """RMS holding efforts (n,) at random poses of the workspace, according to the SDF.

        The value is at least `MIN_TORQUE` times the effort limit.
        """
        zero = np.zeros_like(self._targets)
        rms = np.sqrt(np.mean(inverse_dynamics(self.arm, self._targets, zero, zero) ** 2, axis=0))
        return np.asarray(np.maximum(rms, MIN_TORQUE * self.arm.effort_limits))

    @cached_property
    def _effects(self) -> list[ActuatorEffect]:
        return [effect for group in candidate_effects(self._problem) for effect in group]

    @cached_property
    def num_base(self) -> int:
        """Number of base parameters of gravity."""
        return len(self._problem.base_model.gravity.base.names)

    @cached_property
    def _deviations(self) -> NDArray[np.float64]:
        """Prior standard deviations (p,) of the unknowns."""
        return np.asarray(self._problem.prior_precision(self._effects) ** -0.5)

    @cached_property
    def columns(self) -> NDArray[np.float64]:
        """Regressor (k, n, p) of the pool.

        The unknowns are divided by their prior standard deviations, the efforts by their measurement errors.
        """
        return np.asarray(
            self._problem.regressor(self._effects) * self._deviations / (EFFORT_ERROR * self.arm.effort_limits[:, None])
        )

    @cached_property
    def _criterion(self) -> ExpectedError:
        """Expected error of the holding efforts at random poses of the workspace."""
        X = _without_efforts(self.arm, self._targets).regressor(self._effects)
        X = (X * self._deviations / self.effort[:, None]).reshape(-1, len(self._deviations))
        values = self._problem.base_model.gravity.base_values / self._deviations[: self.num_base]
        return ExpectedError(np.eye(X.shape[1]), X.T @ X / len(X), values)

    def _information(self, chosen: Indices) -> NDArray[np.float64]:
        """Returns the information (p, p) of some poses of the pool, see `ExpectedError`."""
        X = self.columns[chosen].reshape(-1, len(self._deviations))
        return np.asarray(X.T @ X)

    def covariance(self, chosen: Indices) -> NDArray[np.float64]:
        """Returns the covariance (p, p) of the scaled unknowns after the measurement of some poses of the pool."""
        return self._criterion.covariance(self._information(chosen))

    def expected_error(self, chosen: Indices) -> float:
        """Returns the expected RMS error of predicted holding efforts, relative to the RMS holding efforts [1].

        The square is the mean over the joints and over random poses of the workspace.

        Args:
            chosen: Indices of the measured poses in the pool.
        """
        return self._criterion.after(self._information(chosen))

    def known_parameters(self, chosen: Indices) -> int:
        """Returns the number of base parameters whose standard error is at most 10 % of their absolute value."""
        return self._criterion.known_parameters(self._information(chosen))

    def reductions(self, C: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the reduction (k,) of the squared expected error by the measurement of each pose of the pool.

        With the rows X of a pose, the new covariance is C - C X' (1 + X C X')^-1 X C.

        Args:
            C: Covariance (p, p) before the measurement.
        """
        X = self.columns
        XC = (X.reshape(-1, len(C)) @ C).reshape(X.shape)
        inner = np.eye(X.shape[1]) + XC @ X.transpose(0, 2, 1)
        outer = (XC.reshape(-1, len(C)) @ self._criterion.target).reshape(X.shape) @ XC.transpose(0, 2, 1)
        return np.asarray(np.trace(np.linalg.solve(inner, outer), axis1=1, axis2=2))

    def select(self, count: int, usable: NDArray[np.bool_], start: list[int] | None = None) -> list[int]:
        """Returns the indices of poses that minimise the expected error: greedy selection, followed by exchanges.

        No exchange of a single pose with another usable pose of the pool reduces the squared error by more than
        `_MIN_REDUCTION`.

        Args:
            count: Number of poses.
            usable: Mask (k,) of the poses that can be selected.
            start: Indices of the poses with which the selection begins.
        """
        chosen = list(start or [])
        while len(chosen) < count:
            chosen.append(self._best(chosen, usable)[0])
        unchanged, i = 0, 0
        while unchanged < count:
            rest = chosen[:i] + chosen[i + 1 :]
            best, reductions = self._best(rest, usable)
            least = _MIN_REDUCTION * self.expected_error(chosen) ** 2
            if reductions[best] > reductions[chosen[i]] + least:
                chosen[i], unchanged = best, 0
            else:
                unchanged += 1
            i = (i + 1) % count
        return chosen

    def _best(self, chosen: list[int], usable: NDArray[np.bool_]) -> tuple[int, NDArray[np.float64]]:
        """Returns the index of the best pose in addition to `chosen`, and the reductions (k,) by all poses."""
        reductions = self.reductions(self.covariance(chosen))
        allowed = usable.copy()
        allowed[chosen] = False
        return int(np.argmax(np.where(allowed, reductions, -np.inf))), reductions


class PoseChecker:
    """Checks poses and the straight paths of a collection."""

    def __init__(self, arm: Arm, limits: MotionLimits) -> None:
        """Constructs the checker for an arm and the limits of its poses."""
        self._arm, self._limits, self._joints = arm, limits, limits.of_arm(arm)
        self._detector, self._predicted = CollisionDetector(arm, limits.environment), PredictedEffort(arm)
        self._middle = middle_pose(arm, limits, np.random.default_rng(0))
        self._offset = approach_offset(arm)
        self._span = arm.position_upper - arm.position_lower

    def random_poses(self, size: int, least: int, generator: np.random.Generator) -> NDArray[np.float64]:
        """Returns up to `size` random poses (k, n) that meet all limits.

        Raises:
            ExcitationError: Fewer than `least` poses meet all limits.
        """
        n, drawn = self._arm.num_joints, 0
        poses, reasons = np.empty((0, n)), Counter[str]()
        while len(poses) < size and drawn < (MAX_DRAWN if len(poses) else _MAX_FAILED):
            q = generator.uniform(self._joints.lower[:n], self._joints.upper[:n], (size, n))
            drawn += size
            found = self.violations(q)
            reasons.update(found)
            poses = np.vstack([poses, q[[not reason for reason in found]]])
        if len(poses) < least:
            del reasons[""]
            reason, times = reasons.most_common(1)[0]
            raise ExcitationError(
                f"{self._arm.name}: only {len(poses)} of {drawn} random poses meet all limits, but {least} poses are "
                f"required. Most frequent reason ({times} poses): {reason}"
            )
        return poses[:size]

    def violations(self, q: NDArray[np.float64]) -> list[str]:
        """Returns the limit that each of the poses (m, n) or its approaches exceed, or "" if there is none."""
        arm, joints, n = self._arm, self._joints, self._arm.num_joints
        value = joints.positions(q, 0 * q)
        outside = np.any((value < joints.lower) | (value > joints.upper), axis=1)
        own = [arm.joint_names.index(name) for name in self._limits.positions]
        reasons = []
        for pose, is_outside in zip(q, outside, strict=True):
            if is_outside:
                reasons.append("coupled limit")
                continue
            begins = [self.start(pose, side) for side in (-1, 1)]
            if any(np.any(np.abs(begin - pose) < MIN_APPROACH * self._offset) for begin in begins):
                reasons.append("no room to approach the pose from both sides")
            elif any(np.any((x < joints.lower[:n])[own] | (x > joints.upper[:n])[own]) for x in begins):
                reasons.append("position limit at the start of an approach")
            elif not self._can_hold(self._path(self._middle, pose)):
                reasons.append("effort limit")
            elif obstacle := self._obstacle(pose):
                reasons.append(obstacle)
            else:
                is_free = all(self.is_free(begin, pose) for begin in begins)
                reasons.append("" if is_free else "collision or effort limit on an approach")
        return reasons

    def _obstacle(self, pose: NDArray[np.float64]) -> str:
        if self._limits.tip_box is not None:
            lower, upper = self._limits.tip_box
            tip = self._detector.tip(pose)
            if np.any((tip < lower) | (tip > upper)):
                return "tip position"
        return self._detector.collision(pose)

    def start(self, pose: NDArray[np.float64], side: int) -> NDArray[np.float64]:
        """Returns the pose (n,) at which the approach of `pose` from below (-1) or above (1) begins."""
        return offset_pose(self._arm, pose, side * self._offset)

    def _path(self, begin: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns poses (m, n) on the straight path between two poses (n,)."""
        steps = int(np.ceil(np.max(np.abs(end - begin) / self._span) / PATH_STEP - ROUNDING))
        return np.asarray(begin + (np.arange(steps + 1) / max(steps, 1))[:, None] * (end - begin))

    def _can_hold(self, q: NDArray[np.float64]) -> bool:
        """Returns whether the holding efforts plus the dry friction meet the limits at all poses (m, n)."""
        effort = np.abs(self._predicted.holding(q)) + self._predicted.dry_friction
        return bool(np.all(effort <= self._joints.effort))

    def is_free(self, begin: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
        """Returns whether the straight path between two poses (n,) has no collision and meets the effort limits."""
        path = self._path(begin, end)
        return self._can_hold(path) and not any(self._obstacle(pose) for pose in path)

    def can_follow(self, pose: NDArray[np.float64], following: NDArray[np.float64]) -> bool:
        """Returns whether the paths from a pose (n,) to the next pose and to its approaches are free of collisions."""
        return all(self.is_free(pose, goal) for goal in (following, self.start(following, -1)))

    def travel(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the travel (m, m) from each pose to the first approach of each other pose.

        The unit is the position range of the joint that needs the longest time, because the speed of each joint in a
        collection is proportional to its range.
        """
        goals = np.array([self.start(pose, -1) for pose in poses])
        return np.asarray(np.max(np.abs(poses[:, None] - goals) / self._span, axis=2))


def _without_efforts(arm: Arm, q: NDArray[np.float64]) -> StaticProblem:
    return StaticProblem(arm, q, np.zeros_like(q), np.ones(q.shape, bool))


def _ordered(checker: PoseChecker, pool: NDArray[np.float64], chosen: list[int]) -> tuple[list[int], list[int]]:
    """Returns the chosen poses in the order of a short path without collisions, and the poses that it does not reach.

    Each pose is inserted where it lengthens the path least, among the places with free paths to its neighbours.

    Args:
        checker: Checker of the paths.
        pool: Poses (k, n).
        chosen: Indices of the chosen poses.
    """
    travel = checker.travel(pool[chosen])

    @cache
    def is_free(a: int, b: int) -> bool:
        return checker.can_follow(pool[chosen[a]], pool[chosen[b]])

    order: list[int] = []
    excluded: list[int] = []
    for k in range(len(chosen)):
        places = []
        for i in range(len(order) + 1):
            before, after = order[max(i - 1, 0) : i], order[i : i + 1]
            links = [*((a, k) for a in before), *((k, b) for b in after)]
            replaced = sum(travel[a, b] for a in before for b in after)
            places.append((sum(travel[link] for link in links) - replaced, i, links))
        place = next((i for _, i, links in sorted(places) if all(is_free(*link) for link in links)), None)
        if place is None:
            excluded.append(k)
        else:
            order.insert(place, k)
    if len(excluded) > len(order):  # the first poses are isolated from all others
        order, excluded = excluded, order
    return [chosen[k] for k in order], [chosen[k] for k in excluded]
