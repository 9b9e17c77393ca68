"""Maximum-a-posteriori fit of an arm's dynamics to a recording, to compare hypotheses about its channels."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.columns import DIRECTION_WIDTH, BaseColumns, base_columns, named_effects
from dvrk_drake.analysis.dynamic.normal_equations import NonNegativeFit, NormalEquations
from dvrk_drake.analysis.signals.low_pass import low_pass, resample
from dvrk_drake.analysis.signals.motion_grid import GRID_RATE, MotionGrid, default_settings, motion_grid
from dvrk_drake.analysis.signals.repetition import period_of
from dvrk_drake.analysis.signals.true_time import TrueTime
from dvrk_drake.dynamics.actuator_effects import POSITION_KINDS, ActuatorEffect
from dvrk_drake.dynamics.dynamic_model import effect_shapes
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.physical_consistency import LinkScale
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.recordings.recording import REST_SPEED, Recording

#: Prior standard deviations. Of links' parameters, and of the effects that the arm's file states: as shares of their
#: size. Of simple friction, and of offsets, springs and cables of unknown size: as shares of the RMS effort.
LINK_DEVIATION, EFFECT_DEVIATION, FRICTION_DEVIATION, POSITION_DEVIATION = 0.3, 0.5, 0.1, 1.0
#: Of the base's tilt [rad], and of a position offset [rad], [m]; the least of a rotor's inertia [kg m^2; kg].
TILT_DEVIATION, OFFSET_DEVIATION, MIN_ROTOR_DEVIATION = 0.05, (0.1, 0.01), 3e-6
#: Final samples in a period of the effort's cut-off frequency; time left out at each end, where filters swing in [s].
OVERSAMPLING, ENDS = 2.5, 1.0
#: Independent measurements of an effort that count at most: errors of the model do not average out.
MAX_INDEPENDENT = 220.0
#: The error of an actuator is not taken for less than this share of its effort.
MIN_ERROR = 0.02
#: A joint that covers less over poses at rest is left out [rad], [m].
MIN_RANGE = 0.1, 0.01
#: Directions of the rigid body's parameters are left out where a prior deviation along them changes the efforts by less
#: than this share, squared.
MIN_INFORMATION = 1e-6
#: Step of the derivative with respect to a position [rad, m].
_STEP = 1e-3


class ChannelFit:
    """Linear model of a recording's efforts with priors: rigid bodies, base tilt and drive effects of the arm's files.

    Everything is in actuator coordinates. A motion is low-passed at the arm's `effort_cut_off` and sampled as coarsely
    as that allows, so that a fit takes milliseconds. Gravity, springs, cables and offsets explain poses at rest.

    Attributes:
        recording, arm: what is fitted.
        clock: times of a motion's rows.
        moves: whether it is a motion.
        used: (k,) indices of the actuators that move and have an effort; the model explains these.
        resting: (l,) indices of those with an effort that do not move: a constant explains it.
        log_likelihood: of the recording as it is, up to a constant.
    """

    def __init__(self, recording: Recording, arm: Arm, clock: TrueTime | None = None) -> None:
        """Prepares the columns and fits them.

        Args:
            recording, arm: what to fit.
            clock: `true_time` of the recording in actuator coordinates, if it is known.

        Raises:
            RecordingError: the recording does not fit the arm, or is a motion that is too short or too coarse.
        """
        self.recording, self.arm, self.clock = recording, arm, clock
        self._to_joint = arm.transmission.inverse
        self._regressor, self._tilted, self._base = _regressors(arm)
        self.moves = bool(recording.motion(arm))
        if self.moves:
            grid = motion_grid(recording, arm, default_settings(arm), clock)
            self.clock = grid.clock
            self._cut_off = min(arm.identification.effort_cut_off, 0.4 * grid.rate)
            self._half_step = max(int(GRID_RATE / (2 * OVERSAMPLING * self._cut_off)), 1)
            self._q, self._v, self._vd = grid.q, grid.v, grid.vd
            self._tau = self._sampled_efforts(grid)
            duration = float(grid.t[-1] - grid.t[0]) - 2 * ENDS
            independent = 2 * self._cut_off * min(duration, period_of(grid) or duration)
            moves = np.sqrt(np.mean(arm.transmission.velocity(grid.v) ** 2, axis=0)) > arm.per_joint(*REST_SPEED)
        else:
            recording.check_fits(arm)
            self._half_step = 1
            self._q = recording.in_joint_coordinates(arm).q
            self._v = self._vd = np.zeros_like(self._q)
            self._tau = recording.in_actuator_coordinates(arm).measured_effort()
            independent = len(recording)
            moves = np.ptp(arm.transmission.position(self._q), axis=0) > arm.per_joint(*MIN_RANGE)
        self._independent = min(independent, MAX_INDEPENDENT)
        measured = np.any(self._tau != 0, axis=0)
        self.used, self.resting = np.flatnonzero(moves & measured), np.flatnonzero(~moves & measured)
        self.log_likelihood = 0.0
        if len(self.used):
            self._make_columns()
            self.log_likelihood, self._x, _ = self._fit(self._tau)

    def in_actuators(self, transform: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, n) transform of the actuators' efforts for one of the recording's effort channels."""
        if self.recording.coordinates == "actuator":
            return transform
        J = self.arm.transmission.matrix
        return np.asarray(np.linalg.inv(J.T) @ transform @ J.T)

    def gain(self, transform: NDArray[np.float64]) -> float:
        """Increase of the log-likelihood if the actuators' true efforts are `transform` (n, n) times the recorded."""
        volume = self._independent * float(np.log(abs(np.linalg.det(transform))))
        return self._fit(self._tau @ transform.T)[0] + volume - self.log_likelihood

    def position_offset(self, channel: int) -> tuple[float, float]:
        """Estimated offset of a position channel of the recording and its standard error [rad, m]."""
        deviation = float(self.arm.per_joint(*OFFSET_DEVIATION)[channel])
        _, x, precision = self._fit(self._tau, deviation * self._offset_column(channel))
        return deviation * float(x[-1]), deviation * float(np.sqrt(np.linalg.inv(precision)[-1, -1]))

    def dissipation(self) -> NDArray[np.float64]:
        """(n,) power that actuators dissipate over that of the friction in the arm's file; nan where it states none.

        What the fitted links, springs and cables carry is subtracted first: their power over a motion is not zero.
        """
        v = self._sampled(self.arm.transmission.velocity(self._v))
        friction = np.array([effect.kind not in POSITION_KINDS for effect in self._drive.effects])
        carrying = np.append(self._x[: self._num_rigid], np.where(friction, 0.0, self._x[self._num_rigid :]))
        stated = np.where(friction, self._drive.mean, 0.0)
        power = np.full(self.arm.num_joints, np.nan)
        for i in self.used:
            if expected := float(self._effect_columns[i] @ stated @ v[:, i]):
                own, columns = self._columns[i]
                left = self._tau[:, i] - self._nominal[:, i] - columns @ carrying[own]
                power[i] = float(left @ v[:, i]) / expected
        return power

    def _sampled_efforts(self, grid: MotionGrid) -> NDArray[np.float64]:
        tau = self.recording.in_actuator_coordinates(self.arm).measured_effort()
        # Rows that repeat the one before have its time.
        times, rows = np.unique(grid.row_times, return_index=True)
        return self._sampled(resample(times, low_pass(tau, grid.rate, self._cut_off)[rows], grid.t))

    def _make_columns(self) -> None:
        regressor = self._regressor
        q, v, vd = (x[:: self._half_step] for x in (self._q, self._v, self._vd))
        num_links = 10 * len(regressor.links)
        prior = regressor.values[: self._base.base.shape[1]]
        deviations = [LINK_DEVIATION * LinkScale.of(link).deviations for link in regressor.links]
        rotors = np.maximum(LINK_DEVIATION * prior[num_links:], MIN_ROTOR_DEVIATION)
        deviation = np.concatenate([*deviations, rotors])
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
        directions = vectors[:, values > MIN_INFORMATION]
        self._to_parameters = deviation[:, None] * directions
        tilts = TILT_DEVIATION * np.linalg.norm(self.arm.gravity) * self._weights_of_unit_gravity(q)
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
        self._mean = np.append(np.zeros(self._num_rigid), drive.mean)
        self._precision = np.append(np.ones(self._num_rigid), spread**-2.0)
        dissipative = [effect.dissipative for effect in drive.effects]
        self._non_negative = np.append(np.zeros(self._num_rigid, dtype=bool), dissipative)

    def _fit(
        self, tau: NDArray[np.float64], column: NDArray[np.float64] | None = None
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """Fits efforts tau (r, n), with one more `column` (r, n) of deviation 1 if given.

        Returns:
            The log-likelihood, the unknowns x (k,) and their precision (k, k).
        """
        extra = 0 if column is None else 1
        precision, mean = np.append(self._precision, np.ones(extra)), np.append(self._mean, np.zeros(extra))
        non_negative = np.append(self._non_negative, np.zeros(extra, dtype=bool))
        columns, size = [self._columns[i] for i in self.used], len(mean)
        if column is not None:
            columns = [
                (np.append(own, size - 1), np.column_stack([X, column[:, i]]))
                for i, (own, X) in zip(self.used, columns, strict=True)
            ]
        total = NormalEquations.of(columns, size, (tau - self._nominal)[:, self.used]).total
        # The priors' means are one more measurement of all unknowns.
        prior = np.zeros((size + 1, size + 1))
        prior[:-1, -1] = prior[-1, :-1] = precision * mean
        efforts = np.sum(tau[:, self.used] ** 2, axis=0)
        weights = self._independent / (0.1**2 * efforts)
        for _ in range(4):
            x = NonNegativeFit(total.weighted(weights) + prior, precision, non_negative, np.arange(size)).solve()
            errors = np.maximum(total.squared_errors(x), MIN_ERROR**2 * efforts)
            weights = self._independent / errors
        at_rest = tau[:, self.resting]
        constants = np.sum((at_rest - np.mean(at_rest, axis=0)) ** 2, axis=0)
        errors = np.append(errors, np.maximum(constants, MIN_ERROR**2 * np.sum(at_rest**2, axis=0)))
        likelihood = -0.5 * self._independent * float(np.sum(np.log(errors)))
        likelihood -= 0.5 * float(np.sum(precision * (x - mean) ** 2))
        return likelihood, x, total.weighted(weights)[:-1, :-1] + np.diag(precision)

    def _offset_column(self, channel: int) -> NDArray[np.float64]:
        """(r, n) change of the fitted efforts per unit by which a position channel is too large."""
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

    def _weights_of_unit_gravity(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """(r, n, 2) holding efforts under a gravity of 1 m/s^2 along the base's x and y."""
        weights, rest = [], np.zeros_like(q)
        for regressor in self._tilted:
            torque = regressor.torque(q, rest, rest, regressor.values)
            weights.append(self._filtered(self._to_joint.pull_back_effort(torque)))
        return np.stack(weights, axis=2)

    def _sampled(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """x on the motion's grid at the final samples."""
        return self._inner(x[:: self._half_step]) if self.moves else x

    def _filtered(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """x (m, ...) at twice the rate of the final samples, low-passed, at the final samples."""
        if not self.moves:
            return x
        flat = low_pass(x.reshape(len(x), -1), GRID_RATE / self._half_step, self._cut_off)
        return self._inner(flat.reshape(x.shape))

    def _inner(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        ends = int(ENDS * GRID_RATE / self._half_step)
        return x[ends : len(x) - ends : 2]


@cache
def _regressors(arm: Arm) -> tuple[DynamicRegressor, list[DynamicRegressor], BaseColumns]:
    """The arm's regressor, those under a gravity of 1 m/s^2 along the base's x and y, and its base columns."""
    regressor = DynamicRegressor(arm)
    lying = [regressor.with_gravity(axis) for axis in ([1.0, 0, 0], [0, 1.0, 0])]
    return regressor, lying, base_columns([regressor])


class _DriveEffects(NamedTuple):
    """Effects of the drives with priors of their coefficients.

    Attributes:
        effects: the e effects.
        mean: (e,) expected coefficients.
        deviation: (e,) their standard deviation, 0 where `share` states it.
        share: (e,) the same as a share of the RMS effort that the effect acts on.
    """

    effects: list[ActuatorEffect]
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]
    share: NDArray[np.float64]


def _drive_effects(arm: Arm, q: NDArray[np.float64], v: NDArray[np.float64], moves: bool) -> _DriveEffects:
    """Effects that the arm's file states, springs and cables that it names without a size, and simple friction.

    Without friction if the arm is at rest.
    """
    stated: list[DriveEffect] = [*(arm.effects.friction if moves else ()), *arm.effects.cables, *arm.effects.springs]
    sized = {effect.coordinate for effect in stated if effect.kind in POSITION_KINDS}
    others = [ActuatorEffect(f"actuator.{name}", "offset") for name in arm.joint_names]
    others += [effect for effect in named_effects(arm, q) if effect.coordinate not in sized]
    for name, speed in zip(arm.joint_names, np.std(arm.transmission.velocity(v), axis=0), strict=True):
        if moves:
            others.append(ActuatorEffect(f"actuator.{name}", "viscous"))
            others.append(ActuatorEffect(f"actuator.{name}", "coulomb", DIRECTION_WIDTH * float(speed) or 1.0))
    effects = [*map(ActuatorEffect.of, stated), *others]
    mean = np.array([e.coefficient for e in stated] + [0.0] * len(others))
    share = [POSITION_DEVIATION if e.kind in POSITION_KINDS else FRICTION_DEVIATION for e in effects]
    return _DriveEffects(effects, mean, EFFECT_DEVIATION * np.abs(mean), np.array(share))
