"""Finds the direction of gravity and the joint zeros with which the links of an arm explain a recording.

A model file does not state how a robot is mounted. Its joint zeros may differ from those of the robot's controller, in
most cases by multiples of 90 degrees. Other differences above `SNAP_ANGLE` are estimated if gravity shows them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from dvrk_drake.analysis.check.channel_check import MIN_GAIN, segments_of
from dvrk_drake.analysis.check.channel_fit import ChannelFit
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.static_poses import MIN_POSES
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import has_converted_model, is_from_model_file
from dvrk_drake.models.arm_schema import ANGLES, ArmDescription, Gains

#: Smallest gain in log-likelihood of another direction of gravity or another joint zero in the `ChannelFit` that
#: confirms the result. Its priors contain more of a wrong mounting than the search, whose smallest gain is `MIN_GAIN`.
#: The gain of the true hypotheses is 260 to 1960 on recordings of two robots and 14 on a simulated one with three
#: joints. That of all other hypotheses is at most 6 on recordings of five robots.
MIN_CONFIRMED_GAIN = 10.0
#: Relative error of an effort that is due to the nominal links, and is no evidence for another mounting.
NOMINAL_ERROR = 0.05
#: Smallest angle of a reported direction from the stated one [rad]. Smaller angles are tilts of the base, which the
#: identification estimates (`base_may_tilt`).
MIN_ANGLE = np.deg2rad(30.0)
#: Largest angle between an estimated direction and an axis of the base at which the axis is used, and between an
#: estimated joint zero and a multiple of 90 degrees at which the multiple is used [rad]. Robots are mounted at right
#: angles, and the estimate contains the errors of the nominal masses.
SNAP_ANGLE = np.deg2rad(10.0)
#: Smallest difference of a joint zero that is used [rad], that of a quarter turn and its refinement. Smaller ones are
#: only reported, because an inaccurate centre of mass in the model file has the same effect.
MIN_USED_OFFSET = np.pi / 4
#: Differences of the joint zeros of a model and of a controller [rad].
QUARTER_TURNS = (np.pi / 2, -np.pi / 2, np.pi)
#: Largest factor between measured and nominal gravity efforts that may be due to inaccurate masses. Currents in A are
#: about 10 times smaller than torques (10.6 to 14.9 N m/A for a UR10e).
MAX_SCALE = 4.0
#: Smallest correlation between measured and nominal gravity efforts for a statement on their ratio. It is above 0.9 for
#: three robots, and low if the gravity efforts hardly change during the motion.
MIN_SIMILARITY = 0.8
#: Advice if a recording does not determine the mounting.
_STATE_MOUNTING = (
    "Write an arm file with dvrk-drake arm-file, and state in it what is known: gravity (vector in the base frame "
    "[m/s^2]) or position_offsets (position in the model minus recorded position of each joint [rad, m])."
)
#: Number of combinations of joint zeros to which another change is added.
_NUM_KEPT = 3
#: Number of reweighted fits for the direction of gravity, after which it changes by less than 1 degree.
_ITERATIONS = 5


def is_assumed(arm: Arm) -> bool:
    """Returns whether the mounting of an arm is that of its model file, because nobody stated another one."""
    is_unchanged = not arm.position_offsets and np.array_equal(arm.gravity, ArmDescription().gravity)
    return is_from_model_file(arm) and is_unchanged


def find_mounting(observations: Observations) -> tuple[Arm, list[Finding]]:
    """Returns the arm with the mounting that explains a recording, and findings on the differences.

    Joint zeros are changed one after the other, as long as a change makes the efforts much more likely: once with the
    stated gravity, and once with the best gravity for each change, which must make the efforts still more likely. The
    mounting is used if the one of the arm is only assumed (`is_assumed`). Otherwise, the returned arm is unchanged, and
    the findings advise to correct the arm file.
    """
    arm = observations.arm
    if not observations.recording.motion(arm) and len(observations.recording) < MIN_POSES:
        return arm, []
    try:
        own = segments_of(Observations(observations.recording, _with_wide_limits(arm)).longest)[0]
        fit = ChannelFit(own)
    except RecordingError:
        return arm, []  # `check_channels` omits the same recordings.
    if not len(fit.used):
        return arm, []
    search = _Search(fit)
    # Another gravity can hide a zero that is no multiple of 90 degrees, so the stated gravity is also tried.
    (gravity, offsets), free = (_centred(own, arm, *search.best(is_free)) for is_free in (False, True))
    found, gain = _with_gain(own, fit, arm, gravity, offsets)
    if not np.array_equal(free[0], gravity):
        with_free, free_gain = _with_gain(own, fit, arm, *free)
        if free_gain - gain > MIN_CONFIRMED_GAIN:
            (gravity, offsets), found, gain = free, with_free, free_gain
    scale = list(_scale_findings(arm, search.scale(gravity, offsets))) if has_converted_model(arm) else []
    if found is arm:
        return arm, scale
    is_used = is_assumed(arm)
    # Opposite gravity and opposite efforts differ by friction and inertia. `check_channels` reports the latter.
    opposite = fit.gain(-np.eye(arm.num_joints)) if fit.moves else 0.0
    if gain < max(MIN_CONFIRMED_GAIN, opposite):
        what = "the efforts do not determine how the robot is mounted. Gravity and joint zeros of the model are used"
        unknown = [Finding("warning", "mounting", arm.name, what, _STATE_MOUNTING)]
        return arm, [*(unknown if is_used and opposite < MIN_CONFIRMED_GAIN else []), *scale]
    used = _arm_with(arm, gravity, np.where(np.abs(offsets) < MIN_USED_OFFSET, 0.0, offsets)) if is_used else arm
    findings = [*_findings(arm, gravity, offsets, is_used)]
    if len({finding.kind for finding in findings}) > 1 and not _is_square(gravity, offsets):
        what = (
            "gravity and joint zeros both differ from the model, and the efforts do not determine both: other "
            "directions of gravity with other zeros have almost the same efforts"
        )
        findings.append(Finding("warning", "mounting", arm.name, what, _STATE_MOUNTING))
    return used, [*findings, *scale]


def _centred(
    own: Observations, arm: Arm, gravity: NDArray[np.float64], offsets: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns gravity, and offsets of which those near a half turn move the positions to the middle of the limits."""
    middle = np.mean(own.recording.in_joint_coordinates(arm).q, axis=0) + offsets
    middle -= (arm.position_lower + arm.position_upper) / 2
    is_half = np.abs(offsets) > 3 / 4 * np.pi
    return gravity, np.where(is_half, offsets - 2 * np.pi * np.round(middle / (2 * np.pi)), offsets)


def _is_square(gravity: NDArray[np.float64], offsets: NDArray[np.float64]) -> bool:
    """Returns whether gravity is along an axis of the base, and all zeros differ by multiples of 90 degrees."""
    return np.count_nonzero(gravity) == 1 and np.allclose(np.remainder(offsets + 0.1, np.pi / 2), 0.1, atol=1e-6)


def _with_wide_limits(arm: Arm) -> Arm:
    """Returns the arm with joint limits that contain the recorded positions also if zeros differ by a half turn."""
    width = arm.per_joint(np.pi, 0.0)
    return replace(
        arm,
        position_lower=np.maximum(arm.position_lower - width, ANGLES.low),
        position_upper=np.minimum(arm.position_upper + width, ANGLES.high),
        coupled_limits=(),
        gains=Gains(),
    )


def _arm_with(arm: Arm, gravity: NDArray[np.float64], offsets: NDArray[np.float64]) -> Arm:
    if np.any(offsets):
        total = {n: arm.position_offsets.get(n, 0.0) + float(x) for n, x in zip(arm.joint_names, offsets, strict=True)}
        arm = arm.with_position_offsets(total)
    return arm if np.array_equal(gravity, arm.gravity) else arm.with_gravity(gravity.tolist())


def _with_gain(
    own: Observations, fit: ChannelFit, arm: Arm, gravity: NDArray[np.float64], offsets: NDArray[np.float64]
) -> tuple[Arm, float]:
    """Returns the arm with another mounting, or `arm` if it is the same, and its gain in log-likelihood over `fit`."""
    other = _arm_with(arm, gravity, offsets)
    if other is arm:
        return arm, 0.0
    return other, ChannelFit(Observations(own.recording, _with_wide_limits(other))).log_likelihood - fit.log_likelihood


def _findings(arm: Arm, gravity: NDArray[np.float64], offsets: NDArray[np.float64], is_used: bool) -> Iterator[Finding]:
    def use(applies: bool) -> str:
        return "This is used" if applies else "It is not used"

    if not np.array_equal(gravity, arm.gravity):
        vector, stated = (" ".join(f"{x:.3g}" for x in g + 0.0) for g in (gravity, arm.gravity))
        what = f"gravity acts along ({vector}) m/s^2 in the base frame, not along ({stated}). {use(is_used)}"
        advice = f"State it with identify --gravity {vector}, or in the arm file."
        yield Finding("warning", "gravity direction", arm.name, what, advice)
    for j in np.flatnonzero(offsets):
        name, degrees = arm.joint_names[j], np.rad2deg(offsets[j])
        what = f"the zero of q{j + 1} differs by {degrees:+.0f} degrees from that of the model. "
        what += use(is_used and abs(offsets[j]) >= MIN_USED_OFFSET)
        advice = f"State it in the arm file: position_offsets: {{{name}: {offsets[j]:.4f}}}."
        yield Finding("warning", "joint zero", name, what, advice, (int(j),), float(offsets[j]))


def _scale_findings(arm: Arm, scale: float) -> Iterator[Finding]:
    if not 1 / MAX_SCALE < scale < MAX_SCALE:
        what = f"the efforts are about {scale:.2g} times the gravity efforts of the links in the model"
        advice = (
            "Check the unit. Give --effort-scale: for currents the torque constant times the gear ratio of each joint, "
            "for torques of motors the gear ratio."
        )
        yield Finding("warning", "effort scale", arm.name, what, advice, size=scale)


class _Search:
    """Least squares of the efforts of each actuator for a direction of gravity and joint zeros.

    The columns are the efforts of gravity and of the motion, both of the nominal links and with free factors, since
    masses of model files are inaccurate, and viscous friction, Coulomb friction and an offset.
    """

    def __init__(self, fit: ChannelFit) -> None:
        self._fit, self._arm = fit, fit.arm
        self._tau, velocities = fit.samples
        # Offsets hardly change these efforts, compared with those of gravity.
        self._motion = fit.efforts_of_motion()
        scale = np.std(velocities, axis=0) + np.finfo(float).tiny
        self._friction = [
            np.column_stack([np.ones(len(v)), v / s, np.tanh(3 * v / s)]) if fit.moves else np.ones((len(v), 1))
            for v, s in zip(velocities.T, scale, strict=True)
        ]

    def best(self, gravity_is_free: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the gravity vector (3,) [m/s^2] and the joint offsets (n,) [rad, m].

        Gravity and the joint zeros can all differ from the model. A free gravity is estimated for each combination of
        zeros, because with wrong zeros its estimate is wrong too.
        """
        n = self._arm.num_joints
        best = (*self._best_gravity(np.zeros(n), gravity_is_free), np.zeros(n))
        kept = [best]
        for _ in range(n):
            turned = {
                tuple(offsets + turn * np.eye(n)[j])
                for *_, offsets in kept
                for j in np.flatnonzero(~self._arm.prismatic & (offsets == 0))
                for turn in QUARTER_TURNS
            }
            trials = [(*self._best_gravity(np.array(x), gravity_is_free), np.array(x)) for x in sorted(turned)]
            kept = sorted(trials, key=lambda trial: -trial[0])[:_NUM_KEPT]
            if not kept or kept[0][0] - best[0] < MIN_GAIN:
                break
            best = kept[0]
        _, gravity, offsets = best
        # The zeros of an arm of this package are checked by `check_channels`, with the priors of its links.
        joints = np.flatnonzero(~self._arm.prismatic if has_converted_model(self._arm) else offsets)
        for _ in joints:
            refined = [self._refined(gravity, offsets, int(j)) for j in joints]
            best_offsets = max(refined, key=lambda x: self._log_likelihood(self._fit.holding_efforts(gravity, x)))
            if np.array_equal(best_offsets, offsets):
                break
            offsets = best_offsets
        return gravity, offsets

    def _refined(self, gravity: NDArray[np.float64], offsets: NDArray[np.float64], joint: int) -> NDArray[np.float64]:
        """Returns offsets (n,) in which that of a joint is the best within 45 degrees of its own, or the same ones."""
        own = np.arange(len(offsets)) == joint
        turn = float(offsets[joint])

        def cost(offset: float) -> float:
            return -self._log_likelihood(self._fit.holding_efforts(gravity, np.where(own, offset, offsets)))

        best = minimize_scalar(cost, bounds=(turn - np.pi / 4, turn + np.pi / 4), method="bounded")
        is_better = cost(turn) - best.fun > MIN_GAIN and abs(best.x - turn) > SNAP_ANGLE
        return np.where(own, best.x, offsets) if is_better else offsets

    def scale(self, gravity: NDArray[np.float64], offsets: NDArray[np.float64]) -> float:
        """Returns the common ratio of measured and nominal gravity efforts, 1 if they are not similar."""
        holding, products = self._fit.holding_efforts(gravity, offsets), np.zeros((2, 2))
        for i in self._fit.used:
            X = self._friction[i]
            own = np.column_stack([self._tau[:, i], holding[:, i]])
            own -= X @ np.linalg.lstsq(X, own, rcond=None)[0]
            products += own.T @ own / self._arm.effort_limits[i] ** 2
        (measured, both), (_, nominal) = products
        is_similar = both > MIN_SIMILARITY * np.sqrt(measured * nominal) > 0
        return float(both / nominal) if is_similar else 1.0

    def _best_gravity(self, offsets: NDArray[np.float64], is_free: bool) -> tuple[float, NDArray[np.float64]]:
        """Returns the log-likelihood for offsets (n,), and the stated gravity (3,) or a much more likely one."""
        unit_efforts = np.stack([self._fit.holding_efforts(axis, offsets) for axis in np.eye(3)], axis=2)
        stated = self._log_likelihood(unit_efforts @ self._arm.gravity)
        if not is_free:
            return stated, self._arm.gravity
        estimate = self._estimated_gravity(unit_efforts)
        likelihood = self._log_likelihood(unit_efforts @ estimate)
        is_used = _angle(estimate, self._arm.gravity) > MIN_ANGLE and likelihood - stated > MIN_GAIN
        return (likelihood, estimate) if is_used else (stated, self._arm.gravity)

    def _estimated_gravity(self, unit_efforts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the gravity vector (3,) that best explains the efforts, with the magnitude of the arm's.

        Args:
            unit_efforts: Holding efforts (r, n, 3) for a gravity of 1 m/s^2 along each axis.
        """
        tau = self._tau - self._motion
        weights = 1 / (np.sqrt(np.mean(tau**2, axis=0)) + np.finfo(float).tiny)
        magnitude = float(np.linalg.norm(self._arm.gravity))
        for _ in range(_ITERATIONS):
            rows, efforts = [], []
            for i in self._fit.used:
                X = self._friction[i]
                # The friction is eliminated, so that only the three components remain.
                own = np.column_stack([unit_efforts[:, i], tau[:, i]])
                own = weights[i] * (own - X @ np.linalg.lstsq(X, own, rcond=None)[0])
                rows.append(own[:, :3])
                efforts.append(own[:, 3])
            g = np.linalg.lstsq(np.concatenate(rows), np.concatenate(efforts), rcond=1e-6)[0]
            errors = [e - r @ g for r, e in zip(rows, efforts, strict=True)]
            weights[self._fit.used] /= [np.sqrt(np.mean(e**2)) + 1e-9 for e in errors]
        if not np.any(g):
            return self._arm.gravity
        axis = np.sign(g[np.argmax(np.abs(g))]) * np.eye(3)[np.argmax(np.abs(g))]
        direction = axis if _angle(g, axis) < SNAP_ANGLE else g / np.linalg.norm(g)
        return magnitude * direction

    def _log_likelihood(self, holding: NDArray[np.float64]) -> float:
        """Returns the log-likelihood of the efforts for the holding efforts (r, n) of the links, up to a constant."""
        total = 0.0
        for i in self._fit.used:
            tau = self._tau[:, i]
            X = np.column_stack([holding[:, i], self._motion[:, i], self._friction[i]])
            x, *_ = np.linalg.lstsq(X, tau, rcond=1e-9)
            if x[0] < 0:  # Masses are positive.
                X = X[:, 1:]
                x, *_ = np.linalg.lstsq(X, tau, rcond=1e-9)
            error = max(float(np.mean((tau - X @ x) ** 2)), NOMINAL_ERROR**2 * float(np.mean(tau**2)))
            total -= 0.5 * self._fit.num_independent * np.log(error)
        return total


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Returns the angle between two vectors [rad]."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
