"""Maximum-a-posteriori fit of an arm's dynamics to a recording, used to compare hypotheses about its channels."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.effort_lag import NUM_INDEPENDENT
from dvrk_drake.analysis.estimation.estimator import (
    ASSUMED_ERROR,
    EFFECT_DEVIATION,
    KNOWN_SHARE,
    MIN_ERROR,
    TILT_DEVIATION,
    Estimator,
    Prior,
    rigid_deviations,
)
from dvrk_drake.analysis.estimation.motion_columns import DIRECTION_WIDTH, BaseColumns, base_columns, named_effects
from dvrk_drake.analysis.estimation.motion_problem import MIN_INFORMATION
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations
from dvrk_drake.analysis.observations.motion_grid import GRID_RATE, MotionGrid, ends_of
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.signals import low_pass, resample
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_model import effect_shapes
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, POSITION_KINDS, DriveEffect
from dvrk_drake.recordings.recording import MIN_RANGE, REST_SPEED

#: Prior standard deviation of a position offset [rad], [m]. An offset of a joint is reported only if one of this size
#: would be significant. It is the offset of benchmarks/damaged_recordings.py.
OFFSET_DEVIATION = 0.1, 0.01
#: Number of samples of the fit per period of the effort's cut-off frequency. The gain of the low-pass filter is 0.06 at
#: half the rate of the samples.
OVERSAMPLING = 2.5
#: Largest assumed number of independent measurements of an effort in poses, see `NUM_INDEPENDENT`. It is that of the
#: largest public recording of poses (`mtm_2015_good72`), for which the limits of the gain at rest are set.
MAX_INDEPENDENT_POSES = 72.0
#: Step of the numerical derivative with respect to a position [rad, m]. Efforts are sines and cosines of positions, so
#: the relative error of the derivative is about half the step.
_STEP = 1e-3


class ChannelFit:
    """Linear model of a recording's efforts, with priors for its parameters.

    The parameters are those of the rigid bodies, of the base tilt, and of the drive effects in the arm file. All
    quantities are in actuator coordinates. A motion is low-pass filtered at the arm's `effort_cut_off` and sampled at a
    low rate (`OVERSAMPLING`), so that a fit takes milliseconds. The model of poses at rest has gravity, springs, cables
    and offsets only.

    Attributes:
        observations: Recording that is fitted.
        recording, arm: Recording and arm of the observations.
        moves: True for a motion, False for poses at rest.
        used: Indices (k,) of the actuators that move and have an effort. The model is fitted to these efforts.
        resting: Indices (l,) of the actuators that have an effort and do not move. These efforts are modelled as
            constants.
        num_independent: Effective number of independent measurements of each effort.
        log_likelihood: Log-likelihood of the unmodified recording, up to a constant.
    """

    def __init__(self, observations: Observations) -> None:
        """Computes the columns of the model and fits them.

        Raises:
            RecordingError: The recording does not match the arm, or is a motion that is too short or sampled too
                coarsely.
        """
        self.observations = observations
        recording, arm = self.recording, self.arm = observations.recording, observations.arm
        self._to_joint = arm.transmission.inverse
        self._regressor, self._tilted, self._base = _regressors(arm)
        self.moves = bool(recording.motion(arm))
        if self.moves:
            grid = observations.grid
            self._cut_off = min(arm.identification.effort_cut_off, grid.rate / OVERSAMPLING)
            self._half_step = max(int(GRID_RATE / (2 * OVERSAMPLING * self._cut_off)), 1)
            self._q, self._v, self._vd = grid.q, grid.v, grid.vd
            self._tau = self._sampled_efforts(grid)
            duration = float(grid.t[-1] - grid.t[0])
            duration -= 2 * ends_of(duration)
            independent = 2 * self._cut_off * min(duration, observations.period or duration)
            moves = np.sqrt(np.mean(arm.transmission.velocity(grid.v) ** 2, axis=0)) > arm.per_joint(*REST_SPEED)
        else:
            recording.check_fits(arm)
            self._half_step = 1
            self._q = recording.in_joint_coordinates(arm).q
            self._v = self._vd = np.zeros_like(self._q)
            self._tau = observations.tau
            independent = min(len(recording), MAX_INDEPENDENT_POSES)
            moves = np.ptp(arm.transmission.position(self._q), axis=0) > arm.per_joint(*MIN_RANGE)
        self.num_independent = min(independent, NUM_INDEPENDENT)
        measured = np.any(recording.measured_actuators(arm).measured_effort() != 0, axis=0)
        self.used, self.resting = np.flatnonzero(moves & measured), np.flatnonzero(~moves & measured)
        self.log_likelihood = 0.0
        if len(self.used):
            self._make_columns()
            self.log_likelihood, self._x, _ = self._fit(self._tau)

    def gain(self, transform: NDArray[np.float64]) -> float:
        """Returns the gain in log-likelihood if `transform` (n, n) is applied to the recorded effort channels."""
        if self.recording.coordinates != "actuator":
            J = self.arm.transmission.matrix
            transform = np.linalg.inv(J.T) @ transform @ J.T
        volume = self.num_independent * float(np.log(abs(np.linalg.det(transform))))
        return self._fit(self._tau @ transform.T)[0] + volume - self.log_likelihood

    def position_offset(self, channel: int) -> tuple[float, float]:
        """Returns the estimated offset of a recorded position channel and its standard error, in rad or m."""
        deviation = float(self.arm.per_joint(*OFFSET_DEVIATION)[channel])
        _, x, precision = self._fit(self._tau, deviation * self._offset_column(channel))
        return deviation * float(x[-1]), deviation * float(np.sqrt(np.linalg.inv(precision)[-1, -1]))

    def dissipation(self) -> NDArray[np.float64]:
        """Returns the ratio (n,) of the dissipated friction power to the power expected from the arm file.

        The power of the fitted links, springs and cables is subtracted first, because its mean over a motion is not
        zero. The ratio is nan for actuators without friction in the arm file.
        """
        v = self._sampled(self.arm.transmission.velocity(self._v))
        friction = np.array([effect.kind not in POSITION_KINDS for effect in self._drive.effects])
        without_friction = np.append(self._x[: self._num_rigid], np.where(friction, 0.0, self._x[self._num_rigid :]))
        expected_friction = np.where(friction, self._drive.mean, 0.0)
        ratios = np.full(self.arm.num_joints, np.nan)
        for i in self.used:
            if expected := float(self._effect_columns[i] @ expected_friction @ v[:, i]):
                own, columns = self._columns[i]
                residual = self._tau[:, i] - self._nominal[:, i] - columns @ without_friction[own]
                ratios[i] = float(residual @ v[:, i]) / expected
        return ratios

    @property
    def samples(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Measured efforts and velocities (r, n) of the actuators at the samples of the fit."""
        return self._tau, self._sampled(self.arm.transmission.velocity(self._v))

    def holding_efforts(self, gravity: NDArray[np.float64], offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the holding efforts (r, n) of the nominal links for a gravity vector and offsets of the positions.

        Args:
            gravity: Gravity vector (3,) in the base frame [m/s^2].
            offsets: Differences (n,) between the positions in the model and the recorded positions [rad, m].
        """
        return self._rigid_efforts(self._regressor.with_gravity(gravity.tolist()), offsets, moves=False)

    def efforts_of_motion(self) -> NDArray[np.float64]:
        """Returns the efforts (r, n) of the nominal links without gravity."""
        whole = self._rigid_efforts(self._regressor, np.zeros(self.arm.num_joints), moves=True)
        return whole - self.holding_efforts(self.arm.gravity, np.zeros(self.arm.num_joints))

    def _rigid_efforts(
        self, regressor: DynamicRegressor, offsets: NDArray[np.float64], moves: bool
    ) -> NDArray[np.float64]:
        q, v, vd = (x[:: self._half_step] for x in (self._q + offsets, moves * self._v, moves * self._vd))
        return self._filtered(self._to_joint.pull_back_effort(regressor.torque(q, v, vd, regressor.values)))

    def _sampled_efforts(self, grid: MotionGrid) -> NDArray[np.float64]:
        tau = self.observations.tau
        # A repeated row has the time of the previous row.
        times, rows = np.unique(grid.row_times, return_index=True)
        return self._sampled(resample(times, low_pass(tau, grid.rate, self._cut_off)[rows], grid.t))

    def _make_columns(self) -> None:
        regressor = self._regressor
        q, v, vd = (x[:: self._half_step] for x in (self._q, self._v, self._vd))
        prior = regressor.values[: self._base.base.shape[1]]
        deviation = rigid_deviations(regressor, len(prior))
        Y = regressor.regressor(q, v, vd)
        effort = np.sqrt(np.mean(self._tau**2, axis=0))
        rigid, information = {}, np.zeros((len(prior), len(prior)))
        self._nominal = np.zeros_like(self._tau)
        for i in self.used:
            own, columns = self._base.of_actuator(Y, self._to_joint.matrix[:, i])
            filtered, to_base = self._filtered(columns), self._base.base[own]
            rigid[i] = filtered, to_base
            self._nominal[:, i] = filtered @ (to_base @ prior)
            scaled = to_base * deviation
            information += scaled.T @ (filtered.T @ filtered) @ scaled / (len(filtered) * effort[i] ** 2)
        values, vectors = np.linalg.eigh(information)
        directions = vectors[:, self.num_independent * values > MIN_INFORMATION * ASSUMED_ERROR**2]
        self._to_parameters = deviation[:, None] * directions
        tilts = TILT_DEVIATION * np.linalg.norm(self.arm.gravity) * self._unit_gravity_efforts(q)
        self._drive = drive = _drive_effects(self.arm, self._q, self._v, self.moves)
        self._rows = np.array([self.arm.effect_coordinates[effect.coordinate] for effect in drive.effects])
        shapes = np.column_stack(list(effect_shapes(regressor, drive.effects, self._q, self._v)))
        shapes = self._sampled(low_pass(shapes, GRID_RATE, self._cut_off) if self.moves else shapes)
        self._effect_columns = {i: shapes * self._rows[:, i] for i in self.used}
        size = sum(np.mean(self._effect_columns[i] ** 2, axis=0) / effort[i] ** 2 for i in self.used)
        share = drive.share / np.sqrt(np.maximum(np.asarray(size), np.finfo(float).tiny))
        spread = np.where(drive.deviation > 0, drive.deviation, share)
        self._columns = {}
        for i, (filtered, to_base) in rigid.items():
            columns = np.hstack([filtered @ (to_base @ self._to_parameters), tilts[:, i], self._effect_columns[i]])
            own = np.flatnonzero(np.any(columns, axis=0))
            self._columns[i] = own, columns[:, own]
        self._num_rigid = directions.shape[1] + tilts.shape[2]
        dissipative = [effect.dissipative for effect in drive.effects]
        self._prior = Prior(
            mean=np.append(np.zeros(self._num_rigid), drive.mean),
            precision=np.append(np.ones(self._num_rigid), spread**-2.0),
            non_negative=np.append(np.zeros(self._num_rigid, dtype=bool), dissipative),
        )

    def _fit(
        self, tau: NDArray[np.float64], column: NDArray[np.float64] | None = None
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """Fits the model to efforts tau (r, n). An additional `column` (r, n) has prior standard deviation 1.

        Returns:
            Log-likelihood, coefficients x (k,) and their precision (k, k).
        """
        prior, columns = self._prior, [self._columns[i] for i in self.used]
        if column is not None:
            prior = Prior(*(np.append(values, value) for values, value in zip(prior, (0.0, 1.0, False), strict=True)))
        size = len(prior.mean)
        if column is not None:
            columns = [
                (np.append(own, size - 1), np.column_stack([X, column[:, i]]))
                for i, (own, X) in zip(self.used, columns, strict=True)
            ]
        efforts = np.sum(tau[:, self.used] ** 2, axis=0)
        equations = NormalEquations.of(columns, size, (tau - self._nominal)[:, self.used])
        estimator = Estimator(equations, prior, efforts[None], np.full((1, len(efforts)), self.num_independent))
        x = estimator.fit(estimator.all)
        errors = np.maximum(estimator.squared_errors(x)[0], MIN_ERROR**2 * efforts)
        at_rest = tau[:, self.resting]
        constants = np.sum((at_rest - np.mean(at_rest, axis=0)) ** 2, axis=0)
        errors = np.append(errors, np.maximum(constants, MIN_ERROR**2 * np.sum(at_rest**2, axis=0)))
        likelihood = -0.5 * self.num_independent * float(np.sum(np.log(errors)))
        likelihood -= 0.5 * float(np.sum(prior.precision * (x - prior.mean) ** 2))
        return likelihood, x, estimator.information()

    def _offset_column(self, channel: int) -> NDArray[np.float64]:
        """Returns the change (r, n) of the fitted efforts per unit of position offset of a channel."""
        step = _STEP * np.eye(self.arm.num_joints)[channel]
        if self.recording.coordinates == "actuator":
            step = self._to_joint.velocity(step)
        phi = self._regressor.values.copy()
        num_directions = self._to_parameters.shape[1]
        phi[: len(self._to_parameters)] += self._to_parameters @ self._x[:num_directions]
        q, v, vd = (x[:: self._half_step] for x in (self._q, self._v, self._vd))
        rigid = self._regressor.torque(q - step, v, vd, phi) - self._regressor.torque(q, v, vd, phi)
        change = self._filtered(self._to_joint.pull_back_effort(rigid))
        chosen = [k for k, effect in enumerate(self._drive.effects) if effect.kind in POSITION_KINDS]
        if chosen:
            effects, rest = [self._drive.effects[k] for k in chosen], np.zeros_like(q)
            at, shifted = (
                np.column_stack(list(effect_shapes(self._regressor, effects, pose, rest))) for pose in (q, q - step)
            )
            coefficients = self._x[self._num_rigid + np.array(chosen)]
            change += self._filtered(shifted - at) @ (self._rows[chosen] * coefficients[:, None])
        return np.asarray(change / _STEP)

    def _unit_gravity_efforts(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the holding efforts (r, n, 2) for gravity of 1 m/s^2 along the x- and y-axis of the base."""
        efforts, zero = [], np.zeros_like(q)
        for regressor in self._tilted:
            torque = regressor.torque(q, zero, zero, regressor.values)
            efforts.append(self._filtered(self._to_joint.pull_back_effort(torque)))
        return np.stack(efforts, axis=2)

    def _sampled(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Selects the values of x at the samples of the fit. x is given on the grid of the motion."""
        return self._inner(x[:: self._half_step]) if self.moves else x

    def _filtered(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Filters x (m, ...) at twice the rate of the fit and returns the values at the samples of the fit."""
        if not self.moves:
            return x
        flat = low_pass(x.reshape(len(x), -1), GRID_RATE / self._half_step, self._cut_off)
        return self._inner(flat.reshape(x.shape))

    def _inner(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        rate = GRID_RATE / self._half_step
        ends = int(ends_of(len(x) / rate) * rate)
        return x[ends : len(x) - ends : 2]


@cache
def _regressors(arm: Arm) -> tuple[DynamicRegressor, list[DynamicRegressor], BaseColumns]:
    """Returns the regressor, two regressors for unit gravity along the base x- and y-axes, and the base columns."""
    regressor = DynamicRegressor(arm)
    tilted = [regressor.with_gravity(axis) for axis in ([1.0, 0, 0], [0, 1.0, 0])]
    return regressor, tilted, base_columns([regressor])


class _DriveEffects(NamedTuple):
    """Drive effects with priors of their coefficients.

    Attributes:
        effects: List of e effects.
        mean: Prior means (e,) of the coefficients.
        deviation: Prior standard deviations (e,) of the coefficients, 0 if `share` applies instead.
        share: Prior standard deviations (e,) of the efforts of the effects, as shares of the RMS effort.
    """

    effects: list[ActuatorEffect]
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]
    share: NDArray[np.float64]


def _drive_effects(arm: Arm, q: NDArray[np.float64], v: NDArray[np.float64], moves: bool) -> _DriveEffects:
    """Returns additional friction and the effects of the arm file. Their coefficients are unknowns of the fit.

    The additional friction is viscous and Coulomb friction of each actuator. Friction is omitted if the arm is at rest.
    """
    known: list[DriveEffect] = [*(arm.effects.friction if moves else ()), *arm.effects.cables, *arm.effects.springs]
    with_coefficient = {effect.coordinate for effect in known if effect.kind in POSITION_KINDS}
    others = [ActuatorEffect(f"actuator.{name}", "offset") for name in arm.joint_names]
    others += [effect for effect in named_effects(arm, q) if effect.coordinate not in with_coefficient]
    for name, speed in zip(arm.joint_names, np.std(arm.transmission.velocity(v), axis=0), strict=True):
        if moves:
            others.append(ActuatorEffect(f"actuator.{name}", "viscous"))
            others.append(ActuatorEffect(f"actuator.{name}", "coulomb", DIRECTION_WIDTH * float(speed) or 1.0))
    effects = [*map(ActuatorEffect.of, known), *others]
    mean = np.array([e.coefficient for e in known] + [0.0] * len(others))
    share = [KNOWN_SHARE if e.kind in POSITION_KINDS else EFFECT_KINDS[e.kind].prior_share for e in effects]
    return _DriveEffects(effects, mean, EFFECT_DEVIATION * np.abs(mean), np.array(share))
