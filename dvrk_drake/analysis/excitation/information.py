"""Random motions, the information that a motion gives about an arm, and the expected error of predicted efforts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.estimator import ASSUMED_ERROR, KNOWN_SHARE, rigid_deviations
from dvrk_drake.analysis.estimation.motion_columns import COULOMB_WIDTHS, BaseColumns, base_columns
from dvrk_drake.analysis.excitation.motion_limits import MotionLimits
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.analysis.excitation.predicted_effort import PredictedEffort
from dvrk_drake.analysis.observations.repetition import CORRELATION_TIME
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor, derive_base_parameters
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS

#: Number of times per harmonic at which the limits are imposed. Between the times, the highest harmonic grows by at
#: most 2.5 % of its amplitude.
LIMIT_TIMES = 14
#: Share of the limits that random and optimised motions use. Between the times, a motion may exceed a limit slightly:
#: the highest harmonic, by 2.5 % of its amplitude, is a part of the motion.
USED = 0.98


def random_motion(
    arm: Arm,
    limits: MotionLimits,
    period: float,
    harmonics: int,
    generator: np.random.Generator,
    model: IdentifiedModel | None = None,
) -> PeriodicMotion:
    """Returns a random Fourier motion that nearly reaches the limits.

    The velocities of all harmonics have the same distribution. Each joint is scaled to its own limits. Then all joints
    are scaled by one factor until the coupled limits and the effort limits are met.
    """
    basis = FourierBasis.of(period, harmonics)
    center = middle_pose(arm, limits, generator)
    k = np.arange(1, harmonics + 1)
    sine, cosine = generator.normal(size=(2, arm.num_joints, harmonics)) / k
    weights = np.hstack([sine @ basis.sines[:, : harmonics - 1], cosine @ basis.cosines[:, harmonics - 1 :]])
    coefficients = np.column_stack([center, weights])
    coefficients[:, 1:] *= _joint_scales(coefficients, basis, arm, limits)[:, None]
    coefficients[:, 1:] *= _largest_scale(coefficients, basis, PredictedEffort(arm, model), limits)
    return PeriodicMotion.of_coefficients(arm, basis, coefficients, 1)


def state_of(motion: PeriodicMotion, count: int) -> NDArray[np.float64]:
    """Returns the states (3, count, n) of one period of a motion: q, v and vd."""
    return np.array(motion.evaluate(np.arange(count) * motion.period / count)[:3])


def middle_pose(arm: Arm, limits: MotionLimits, generator: np.random.Generator) -> NDArray[np.float64]:
    """Returns the mean of random poses (n,), moved into the additional position limits."""
    center = arm.sample_poses(200, generator, max(limits.margin, 0.2)).mean(axis=0)
    if not limits.positions:
        return center
    joints, n = limits.of_arm(arm), arm.num_joints
    middle, half = (joints.lower[:n] + joints.upper[:n]) / 2, (joints.upper[:n] - joints.lower[:n]) / 2
    return np.asarray(np.clip(center, middle - 0.5 * half, middle + 0.5 * half))


def sample_times(basis: FourierBasis, per_harmonic: int) -> NDArray[np.float64]:
    """Returns evenly spaced times (m,) in one period of a basis [s]."""
    count = per_harmonic * len(basis.rates)
    return np.arange(count) * 2 * np.pi / basis.rates[0] / count


def states_at(values: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the states (3, m, n) for values (3, m, 2h - 1) and coefficients (n, 2h - 1), see `FourierBasis`."""
    return np.asarray(values @ coefficients.T)


def effort_without_friction(predicted: PredictedEffort, limits: MotionLimits) -> NDArray[np.float64]:
    """Returns the largest joint efforts (n,) without dry friction [N m, N].

    Raises:
        ExcitationError: The dry friction of a joint exceeds the limit.
    """
    allowed = limits.of_arm(predicted.arm).effort - predicted.dry_friction
    if np.any(allowed <= 0):
        name = predicted.arm.joint_names[int(np.argmin(allowed))]
        raise ExcitationError(f"{name}: the dry friction exceeds {100 * limits.effort:g} % of the effort limit")
    return np.asarray(allowed)


def _joint_scales(
    coefficients: NDArray[np.float64], basis: FourierBasis, arm: Arm, limits: MotionLimits
) -> NDArray[np.float64]:
    """Returns the largest factors (n,) with which the amplitude of each joint meets its own limits."""
    joints, n = limits.of_arm(arm), arm.num_joints
    values = basis.values(sample_times(basis, LIMIT_TIMES))
    moves = [v[:, 1:] @ coefficients[:, 1:].T for v in values]
    walls = slice(len(joints.A) // 2, len(joints.A) // 2 + n)
    x = np.abs([moves[0] + joints.look_ahead[walls] * moves[1], *moves]).max(axis=1)
    center = coefficients[:, 0]
    rooms = [np.minimum(joints.upper[k] - center, center - joints.lower[k]) for k in (walls, slice(n))]
    allowed = np.array([*rooms, joints.speed, joints.acceleration, joints.jerk])
    return np.asarray(USED * np.min(allowed / x, axis=0))


def _largest_scale(
    coefficients: NDArray[np.float64], basis: FourierBasis, predicted: PredictedEffort, limits: MotionLimits
) -> float:
    """Returns the largest factor up to 1 with which the motion meets the coupled limits and the effort limits."""
    arm = predicted.arm
    joints, values = limits.of_arm(arm), basis.values(sample_times(basis, LIMIT_TIMES))
    allowed = effort_without_friction(predicted, limits)
    for scale in 0.95 ** np.arange(100):
        scaled = np.column_stack([coefficients[:, 0], scale * coefficients[:, 1:]])
        q, v, vd = states_at(values[:3], scaled)
        positions = joints.positions(q, v)
        tau = predicted.without_dry_friction(q, v, vd)
        if np.all((positions >= joints.lower) & (positions <= joints.upper)) and np.all(np.abs(tau) <= allowed):
            return float(scale)
    j = int(np.argmax(np.abs(tau).max(axis=0) / allowed))
    reason = "the middle of the motion exceeds a position limit"
    if np.abs(tau[:, j]).max() > allowed[j]:
        reason = (
            f"the effort of {arm.joint_names[j]} in the middle of the motion, including dry friction, exceeds "
            f"{100 * limits.effort:g} % of the effort limit"
        )
    raise ExcitationError(f"{arm.name}: no motion meets all limits: {reason}")


#: Number, period [s] and number of harmonics of the random motions for which the expected error is computed, and number
#: of states per motion. The period and the harmonics state the task: speeds up to 0.6 Hz. Half or twice the number of
#: motions changes the expected errors of random motions of an MTML by 4 %, half or twice the states by 0.2 %.
NUM_MOTIONS, MOTION_PERIOD, MOTION_HARMONICS, STATES_PER_MOTION = 20, 10.0, 6, 50
#: Acceleration below which presliding is smoothed, as a share of the RMS acceleration of the random motions. Half or
#: twice the value changes these errors by 7 %, but their ratio, which selects a motion, by 2 %.
SMOOTHED_ACCELERATION = 0.2
#: Step of the forward differences with respect to positions, velocities and accelerations, relative to their limits.
#: Near the square root of the machine precision, the truncation and the rounding error of a difference are similar.
STEP = 1e-7


@dataclass(frozen=True, eq=False)
class ExpectedError:
    """Expected error of the efforts that a linear model predicts after a measurement (V-optimality).

    The `information` of a measurement is the sum (k, k) of x x' / sigma^2 over its independent efforts, with the
    regressor rows x (k,) and the standard deviation sigma of each effort.

    Attributes:
        prior: Precision (k, k) of the unknowns before the measurement.
        target: Mean (k, k) of x x' / s^2 over the efforts to predict, with their regressor rows x and RMS values s.
        base_values: Expected values (b,) of the base parameters, which are the first unknowns.
    """

    prior: NDArray[np.float64]
    target: NDArray[np.float64]
    base_values: NDArray[np.float64]

    def covariance(self, information: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the covariance (k, k) of the unknowns after a measurement."""
        H = self.prior + information
        unit = 1 / np.sqrt(np.diag(H))
        factor = scipy.linalg.cho_factor(H * np.outer(unit, unit), lower=True)
        return np.asarray(scipy.linalg.cho_solve(factor, np.diag(unit)) * unit[:, None])

    def after(self, information: NDArray[np.float64]) -> float:
        """Returns the expected RMS error of the efforts to predict, relative to their RMS values [1].

        Errors that a larger number of unknowns would explain are not included.
        """
        return float(np.sqrt(np.sum(self.target * self.covariance(information))))

    def known_parameters(self, information: NDArray[np.float64]) -> int:
        """Returns the number of base parameters whose standard error is at most 10 % of their absolute value."""
        errors = np.sqrt(np.diag(self.covariance(information))[: len(self.base_values)])
        return int(np.sum(errors <= 0.1 * np.abs(self.base_values)))


@dataclass(frozen=True, eq=False)
class MotionInformation:
    """Linear model of the efforts of an arm, with the priors of `identify`.

    The unknowns are the base parameters, and for each actuator the viscous friction, the Coulomb friction with several
    widths, the presliding friction with several travels, and the offset. The state of presliding is that after a
    reversal of the velocity with constant acceleration. Cables and springs are not included.

    Attributes:
        arm: Arm to identify.
        limits: Limits of the motion. The states for which efforts are predicted are those of random motions within
            these limits.
        model: Earlier model of the arm, or None. If it has dynamics, the standard errors of its base parameters are
            used as those of independent measurements. Its friction and offsets are not used, because they can differ
            between recordings.
    """

    arm: Arm
    limits: MotionLimits
    model: IdentifiedModel | None = None

    @cached_property
    def predicted(self) -> PredictedEffort:
        """Predicted efforts of the arm."""
        return PredictedEffort(self.arm, self.model)

    @property
    def _regressor(self) -> DynamicRegressor:
        return self.predicted.regressor

    @cached_property
    def _base(self) -> BaseColumns:
        return base_columns([self._regressor])

    @cached_property
    def num_base(self) -> int:
        """Number of base parameters."""
        return len(self._base.independent)

    @cached_property
    def scales(self) -> NDArray[np.float64]:
        """Typical sizes (3, n) of positions, velocities and accelerations: half the range, and the limits."""
        joints = self.limits.of_arm(self.arm)
        return np.array([0.5 * (self.arm.position_upper - self.arm.position_lower), joints.speed, joints.acceleration])

    @cached_property
    def states(self) -> NDArray[np.float64]:
        """States (3, m, n) for which efforts are predicted: q, v and vd."""
        generator, shape = np.random.default_rng(1), (MOTION_PERIOD, MOTION_HARMONICS)
        motions = [random_motion(self.arm, self.limits, *shape, generator, self.model) for _ in range(NUM_MOTIONS)]
        return np.concatenate([state_of(motion, STATES_PER_MOTION) for motion in motions], axis=1)

    @cached_property
    def effort(self) -> NDArray[np.float64]:
        """RMS efforts (n,) of the actuators in `states`, see `rms_effort`."""
        return self.rms_effort(self.states)

    def rms_effort(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the RMS efforts (n,) of the actuators in states (3, m, n), including dry friction."""
        return np.sqrt(self._mean_squares(self._efforts(state)))

    def _efforts(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the efforts (m, n) of the actuators in states (3, m, n), without dry friction."""
        return self.arm.transmission.inverse.pull_back_effort(self.predicted.without_dry_friction(*state))

    def _mean_squares(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the mean squares (n,) of efforts (m, n) of the actuators plus their dry friction."""
        friction = self.arm.transmission.inverse.pull_back_effort(self.predicted.dry_friction[None])[0]
        return np.asarray(np.mean(tau**2, axis=0) + friction**2)

    @cached_property
    def _typical(self) -> NDArray[np.float64]:
        """Standard deviations (3, n) of positions, velocities and accelerations of the actuators in `states`."""
        J, (q, v, vd) = self.arm.transmission, self.states
        return np.array([x.std(axis=0) for x in (J.position(q), J.velocity(v), J.velocity(vd))])

    @property
    def _travels(self) -> NDArray[np.float64]:
        return np.array(self.arm.identification.presliding_travels)

    def columns(self, state: NDArray[np.float64]) -> list[tuple[NDArray[np.int_], NDArray[np.float64]]]:
        """Returns indices (c,) and values (m, c) of the nonzero regressor columns of each actuator for (3, m, n)."""
        arm, count = self.arm, state.shape[1]
        q, v, vd = state
        Y = self._regressor.regressor(q, v, vd)
        a_dot, a_ddot = (arm.transmission.velocity(x) / y for x, y in zip((v, vd), self._typical[1:], strict=True))
        columns = []
        for i in range(arm.num_joints):
            own, of_base = self._base.of_actuator(Y, arm.transmission.inverse.matrix[:, i])
            u = a_dot[:, i, None]
            coulomb = np.tanh(u / COULOMB_WIDTHS)
            travels = self._typical[0, i] * self._typical[2, i] / self._typical[1, i] ** 2 * self._travels
            presliding = _presliding(u, a_ddot[:, i, None], travels)
            effects = np.hstack([u, coulomb, presliding, np.ones((count, 1))]) * self.effort[i]
            first, size = self.num_base + effects.shape[1] * i, effects.shape[1]
            columns.append((np.append(own, first + np.arange(size)), np.hstack([of_base, effects])))
        return columns

    @cached_property
    def _prior(self) -> NDArray[np.float64]:
        """Precision (k, k) of the unknowns before the motion: of the prior of `identify`, and of `model`."""
        scaled = self._base.base * rigid_deviations(self._regressor, self._base.base.shape[1])
        num_friction = 1 + len(COULOMB_WIDTHS) + len(self._travels)
        of_actuator = [*[EFFECT_KINDS["coulomb"].prior_share] * num_friction, KNOWN_SHARE]
        effects = np.diag(np.tile(of_actuator, self.arm.num_joints) ** -2.0)
        return np.asarray(scipy.linalg.block_diag(np.linalg.inv(scaled @ scaled.T) + self._earlier, effects))

    @property
    def _earlier(self) -> NDArray[np.float64]:
        """Precision (b, b) that the standard errors in `model` add to that of the prior."""
        earlier = np.zeros((self.num_base, self.num_base))
        if self.model is None or self.model.dynamics is None:
            return earlier
        section = self.model.dynamics
        regressor = self._regressor.with_gravity(section.gravity_expected or section.gravity)
        derived = derive_base_parameters(regressor)
        row_of = dict(zip(derived.base.names, derived.combination @ np.linalg.pinv(self._base.base), strict=True))
        for estimate in section.base_parameters:
            if estimate.standard_error > 0 and estimate.name in row_of:
                # The variance is (1 - identifiability) times that of the prior.
                row = row_of[estimate.name]
                earlier += estimate.identifiability / estimate.standard_error**2 * np.outer(row, row)
        return earlier

    @cached_property
    def criterion(self) -> ExpectedError:
        """Expected error of the efforts in `states`."""
        target = np.zeros_like(self._prior)
        for (own, X), size in zip(self.columns(self.states), self.effort, strict=True):
            target[own[:, None], own] += X.T @ X / (len(X) * size**2 * len(self.effort))
        values = self._base.base @ self.predicted.parameters[: self._base.base.shape[1]]
        return ExpectedError(self._prior, target, values)

    def weight(self, period: float, rows: int) -> float:
        """Returns the information per row, for rows that are evenly spread over a period [s].

        It is the number of independent measurements, divided by the squared relative error of the model.
        """
        return period / (CORRELATION_TIME * rows * ASSUMED_ERROR**2)

    def matrix(self, state: NDArray[np.float64], period: float) -> NDArray[np.float64]:
        """Returns the information (k, k) of a motion with states (3, m, n) and a period [s], see `ExpectedError`."""
        H, weight = np.zeros_like(self._prior), self.weight(period, state.shape[1])
        for (own, X), size in zip(self.columns(state), self.rms_effort(state), strict=True):
            H[own[:, None], own] += weight / size**2 * (X.T @ X)
        return H

    def expected_error(self, state: NDArray[np.float64], period: float) -> float:
        """Returns the expected RMS error of efforts in `states`, relative to the RMS efforts [1], see `matrix`."""
        return self.criterion.after(self.matrix(state, period))

    def known_parameters(self, state: NDArray[np.float64], period: float) -> int:
        """Returns the number of base parameters with a standard error of at most 10 %, see `matrix`."""
        return self.criterion.known_parameters(self.matrix(state, period))

    def log_error_gradient(self, state: NDArray[np.float64], period: float) -> tuple[float, NDArray[np.float64]]:
        """Returns the logarithm of the expected error and its derivatives (3, m, n) with respect to the states."""
        C, target = self.criterion.covariance(self.matrix(state, period)), self.criterion.target
        square = float(np.sum(target * C))
        weight = self.weight(period, state.shape[1])
        D = -weight / square * (C @ target @ C)
        tau = self._efforts(state)
        squares = self._mean_squares(tau)
        # Derivatives of log(error) with respect to the columns X of an actuator (X D / s^2), and to the efforts, on
        # which the RMS effort s of the motion depends.
        G, by_effort, columns = [], np.empty_like(tau), self.columns(state)
        for i, (own, X) in enumerate(columns):
            G.append(X @ D[own[:, None], own] / squares[i])
            by_effort[:, i] = -np.sum(G[i] * X) / squares[i] * tau[:, i] / len(tau)
        gradient = np.empty_like(state)
        for k in range(3):
            for j in range(state.shape[2]):
                step = STEP * self.scales[k, j]
                ahead = state.copy()
                ahead[k, :, j] += step
                change = np.sum(by_effort * (self._efforts(ahead) - tau), axis=1)
                for g, (_, Z), (_, X) in zip(G, self.columns(ahead), columns, strict=True):
                    change += np.sum(g * (Z - X), axis=1)
                gradient[k, :, j] = change / step
        return 0.5 * float(np.log(square)), gradient

    def condition_number(self, state: NDArray[np.float64]) -> float:
        """Returns the condition number of the base parameters' columns, divided by the efforts and column norms."""
        H = np.zeros((self.num_base, self.num_base))
        for (own, X), size in zip(self.columns(state), self.rms_effort(state), strict=True):
            of_base = own < self.num_base
            H[own[of_base][:, None], own[of_base]] += X[:, of_base].T @ X[:, of_base] / size**2
        norms = np.sqrt(np.diag(H))
        if not np.all(norms > 0):
            return float("inf")
        values = np.linalg.eigvalsh(H / np.outer(norms, norms))
        return float(np.sqrt(values[-1] / max(values[0], np.finfo(float).tiny)))


def _presliding(v: NDArray[np.float64], vd: NDArray[np.float64], travels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the states (m, d) of presliding elements after a reversal of the velocity with constant acceleration.

    After a reversal, an element with the travel d changes from -sign(v) to sign(v) over a distance of 2 d. The arm has
    moved by v^2 / (2 |vd|) since the reversal.

    Args:
        v, vd: Velocities and accelerations (m, 1), in units of their standard deviations.
        travels: Travels (d,) of the elements, in consistent units.
    """
    sign = np.where(v < 0, -1.0, 1.0)
    x = vd * sign - v**2 / (4 * travels)
    return np.asarray(sign * (1 - (x + np.hypot(x, SMOOTHED_ACCELERATION)) / np.hypot(vd, SMOOTHED_ACCELERATION)))
