"""Refits the friction and offsets of an identified model to a short motion, without changing other parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.estimation.estimator import EFFECT_DEVIATION, Estimator, Prior
from dvrk_drake.analysis.estimation.motion_estimates import MAX_CORRELATION_TIME
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations, fold_sums
from dvrk_drake.analysis.observations.motion_difference import (
    FrictionPart,
    drive_efforts,
    refuse_opposite_efforts,
)
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import CORRELATION_TIME, correlation_of, phase_folds
from dvrk_drake.analysis.results import ModelResult
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics, DynamicSection
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.effects_schema import EFFECT_KINDS, DriveEffect
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import REST_SPEED, Recording

#: Number of folds for cross-validation. The folds of a periodic motion are intervals of its phase. Half or twice as
#: many folds lower the mean errors of `psm_one_no_weight` and `mtm_earlier_day` by at most 0.6 percentage points.
FOLDS = 4
#: Smallest share of the time during which an actuator must move in each direction. Otherwise, its friction is not
#: fitted. Half or twice the value changes no result of these two recordings.
MIN_SHARE = 0.1
#: Largest accepted relative error after the refit, as the mean over the actuators. It is 0.11 to 0.12 for these two
#: recordings, and at most 0.14 for motions of a PSM with the model of another PSM.
MAX_ERROR = 0.7


@dataclass(frozen=True)
class RecalibratedActuator:
    """Recalibration of one actuator.

    A relative error is |tau_f - tau_hat| / |tau_f|, where tau_f is the low-pass filtered measured effort and tau_hat is
    the predicted effort after the same filter.

    Attributes:
        name: Name of the joint of the actuator.
        before: Relative error of the model before recalibration [1].
        after: Cross-validated relative error of the new model [1]. It equals `before` if `kept` is False.
        kept: True if the new model has the refitted friction and offset.
        reason: Reason why the new model has the earlier friction and offset, "" if `kept` is True.
        dry: Factor by which the dry friction of the actuator changes [1], None if the model has no such friction.
        viscous: Factor by which the viscous friction of the actuator changes [1], None if the model has no such
            friction.
        offset: Change of the offset [N m, N].
    """

    name: str
    before: float
    after: float
    kept: bool
    reason: str
    dry: float | None
    viscous: float | None
    offset: float


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Recalibration(ModelResult):
    """Result of `recalibrate`: a model with refitted friction and offsets.

    Attributes:
        actuators: Recalibration of the actuators, in the arm's order.
        shared: Factors by which the friction changes at coordinates that several actuators move [1]. An example of a
            key is "finger_1 dry".
        seconds: Duration of the motion without both ends (`MotionGrid.inner`) [s].
    """

    actuators: list[RecalibratedActuator]
    shared: dict[str, float]
    seconds: float


def recalibrate(model: IdentifiedModel, recording: Recording, *, progress: Progress | None = None) -> Recalibration:
    """Checks a short motion and refits a model's friction and offsets to it, as `dvrk-drake identify recalibrate` does.

    The model error decreases for motions similar to the recording. For other positions and speeds, the model error can
    decrease much less.

    Args:
        model: Model identified from a motion.
        recording: Motion with efforts (m, n), recorded after the motion of the identification, in joint or actuator
            coordinates.
        progress: Callback that receives the name of the step ("checking the recording" or "refitting friction") and the
            finished share of the step (0 to 1).

    Returns:
        Result with the new model as `model`, the errors of each actuator before and after the refit as `actuators`, and
        `warnings`.

    Raises:
        RecordingError: `check` rejects the recording, efforts have the wrong sign, the model error remains too large,
            or no actuator moves in both directions.
        ModelError: The model has no dynamics.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("psm")
        >>> model, today = (dvrk.IdentifiedModel.from_arm(arm, dynamics=True) for _ in range(2))
        >>> for effect in today.dynamics.effects:
        ...     effect.coefficient *= 1.5 if effect.kind == "presliding" else 1.0
        >>> t, w, reach = np.arange(0, 12, 0.01)[:, None], 1 + 0.25 * np.arange(7), 0.3 * arm.position_upper
        >>> q, v, vd = reach * (1 + np.sin(w * t)), reach * w * np.cos(w * t), -reach * w**2 * np.sin(w * t)
        >>> tau = arm.transmission.pull_back_effort(today.dynamic_model.effort(q, v, vd))
        >>> result = dvrk.recalibrate(model, dvrk.Recording(q=q, qd=v, tau=tau, t=t[:, 0]))
        >>> round(result.actuators[0].dry, 2), bool(result.actuators[0].after < 0.1 * result.actuators[0].before)
        (1.5, True)
    """
    dynamics = model.dynamic_model
    recording, dropped = with_power(recording, dynamics.arm)
    observations = Observations.for_model(recording, model)
    report = require_usable(observations, progress)
    share = step_progress(progress, "refitting friction")
    share(0.0)
    result = refit_friction(model, observations)
    share(1.0)
    return replace(result, warnings=(*dropped, *report.warnings))


def refit_friction(model: IdentifiedModel, observations: Observations) -> Recalibration:
    """Fits factors of the dry and viscous friction at every coordinate, and a change of the offset of every actuator.

    Rigid bodies, springs and cables do not change. The errors are cross-validated over `FOLDS` folds of the motion. If
    the error of an actuator does not decrease, the offset of this actuator and the friction at all of its coordinates
    keep their values. The remaining factors and offsets are fitted again. The last fit uses the whole recording. The
    errors, standard errors and prediction intervals of the new model are those of this fit on the recording.

    Raises:
        RecordingError: The recording is not a motion of this arm, efforts have the wrong sign, no actuator moves in
            both directions, or the model error remains too large.
        ModelError: The model has no dynamics.
    """
    recording, fit = observations.recording, _Fit(model.dynamic_model, observations)
    excited = fit.excited
    if not np.any(excited):
        raise RecordingError(
            f"{recording.source or 'recording'}: no actuator moves in both directions. Required: each direction for at "
            f"least {100 * MIN_SHARE:.0f} % of the time, and an RMS speed of at least {REST_SPEED[0]:g} rad/s "
            f"({REST_SPEED[1]:g} m/s)."
        )
    refuse_opposite_efforts(recording, fit.names, fit.tau, fit.expected)
    before = fit.error(fit.unchanged)
    free = excited.copy()
    after = fit.relative(held_out := fit.held_out_residuals(free))
    while np.any(worse := free & ~(after < before)):
        free &= ~worse
        after = fit.relative(held_out := fit.held_out_residuals(free))
    if not np.mean(after[fit.measured]) < MAX_ERROR:
        raise RecordingError(
            f"{recording.source or 'recording'}: the mean relative error over the actuators is "
            f"{100 * np.mean(after):.0f} % with fitted friction ({100 * np.mean(before):.0f} % before); at most "
            f"{100 * MAX_ERROR:.0f} % is allowed. Check the arm and the coordinates of the recording."
        )
    x = fit.solve(free)
    actuators = []
    for i, name in enumerate(fit.names):
        reason = "" if free[i] else "error not reduced" if excited[i] else "no motion in both directions"
        reason = reason if fit.measured[i] else "effort not measured"
        actuators.append(
            RecalibratedActuator(
                name=name,
                before=float(before[i]),
                after=float(after[i]),
                kept=bool(free[i]),
                reason=reason,
                dry=fit.scale(x, f"actuator.{name}", "dry"),
                viscous=fit.scale(x, f"actuator.{name}", "viscous"),
                offset=float(x[len(fit.keys) + i]),
            )
        )
    shared = {
        f"{coordinate} {part}": float(x[k])
        for k, (coordinate, part) in enumerate(fit.keys)
        if not coordinate.startswith("actuator.")
    }
    section = _section(model.dynamic_model.section, fit, x, fit.standard_errors(free, held_out))
    section.actuators, section.error_correlation = fit.statistics(x, held_out), correlation_of(held_out).tolist()
    return Recalibration(
        model=model.recalibrated(section, recording.source),
        actuators=actuators,
        shared=shared,
        seconds=float(len(fit.tau) / fit.rate),
    )


def cross_validated_errors(
    model: IdentifiedModel, observations: Observations, folds: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the relative errors (n,) of the model, and the cross-validated errors (n,) after a refit of friction.

    The folds of a periodic motion are intervals of its phase, so that the fit for a fold does not use repetitions of
    this fold. The friction and offsets of all actuators that move in both directions are refitted.

    Raises:
        RecordingError: The recording is not a motion of this arm.
        ModelError: The model has no dynamics.
    """
    fit = _Fit(model.dynamic_model, observations, folds)
    return fit.error(fit.unchanged), fit.relative(fit.held_out_residuals(fit.excited))


class _Fit:
    """Least-squares fit of x (k + n,): k friction factors, then the changes of the n offsets.

    The prior means are the values of the model.
    """

    def __init__(self, model: DynamicModel, observations: Observations, folds: int = FOLDS) -> None:
        grid, recording = observations.grid, observations.recording
        self.names = model.arm.joint_names
        self.rate, self.day_deviation = grid.rate, np.array(model.arm.identification.day_deviation)
        expected = drive_efforts(model, grid)
        self.tau = grid.filter_efforts(recording.measured_actuators(model.arm).measured_effort())
        self.measured = np.any(self.tau, axis=0)
        self.other = expected.other
        self.keys = list(expected.friction)
        self.friction = np.stack([expected.friction[key] for key in self.keys], axis=2)
        rows = model.arm.effect_coordinates
        self._loads = np.array([rows[coordinate] != 0 for coordinate, _ in self.keys])
        self.expected = expected.total()
        self._folds = folds
        self._fold, self._edge = phase_folds(grid, observations.period, folds)
        self.excited = _moves_in_both_directions(model, grid) & self.measured
        self.unchanged = np.concatenate([np.ones(len(self.keys)), np.zeros(len(self.names))])
        k, n = len(self.keys), len(self.names)
        size = np.where(self.measured, np.sqrt(np.mean(self.tau**2, axis=0)), 1.0)
        self._deviation = np.concatenate([np.full(k, EFFECT_DEVIATION), EFFECT_KINDS["offset"].prior_share * size])
        columns = []
        for i in range(n):
            own = np.flatnonzero(self._loads[:, i])
            columns.append((np.append(own, k + i), np.column_stack([self.friction[:, i, own], np.ones(len(self.tau))])))
        # Rows within the correlation time are not independent.
        independent = np.full(self.tau.shape, 1 / (self.rate * CORRELATION_TIME))
        self._estimator = Estimator(
            NormalEquations.of(columns, k + n, self.tau - self.other, self._fold, self._edge),
            Prior(self.unchanged, self._deviation**-2.0, np.arange(k + n) < k),
            fold_sums(self.tau**2, self._fold),
            fold_sums(independent, self._fold),
        )

    def error(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the relative errors (n,) for x (k + n,)."""
        return self.relative(self._residuals(x))

    def held_out_residuals(self, free: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Returns the residuals (r, n) of held-out folds [N m, N].

        The fit that predicts a fold does not use the rows next to this fold.
        """
        residuals = np.empty_like(self.tau)
        for fold in range(self._folds):
            held_out = self._fold == fold
            residuals[held_out] = self._residuals(self.solve(free, fold))[held_out]
        return residuals

    def _residuals(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        k = len(self.keys)
        return np.asarray(self.tau - self.other - self.friction @ x[:k] - x[k:])

    def relative(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the relative RMS values (n,) of residuals (r, n) [1]."""
        size = np.sum(self.tau**2, axis=0)
        squares = np.sum(residuals**2, axis=0)
        return np.sqrt(np.divide(squares, size, out=np.zeros_like(size), where=size > 0))

    def statistics(self, x: NDArray[np.float64], held_out: NDArray[np.float64]) -> list[ActuatorStatistics]:
        """Returns the statistics of the actuators for the fit x (k + n,) and its held-out residuals (r, n)."""
        rms = [np.sqrt(np.mean(values**2, axis=0)) for values in (self.tau, self._residuals(x), held_out)]
        of_fit = zip(self.names, *rms, rms[0] * self.day_deviation, strict=True)
        return [
            ActuatorStatistics(name, float(effort), float(fit), float(error), rms_between_days=float(day))
            for name, effort, fit, error, day in of_fit
        ]

    def standard_errors(self, free: NDArray[np.bool_], held_out: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the standard errors (k + n,) of x, 0 for the values that are not fitted.

        They are those of a jackknife over blocks of `MAX_CORRELATION_TIME` (cluster-robust covariance), because the
        residuals are correlated.

        Args:
            free: See `solve`.
            held_out: Residuals (r, n) of held-out folds [N m, N].
        """
        k, fixed = len(self.keys), self._fixed(free)
        H, P = self._estimator.information(), np.diag(self._deviation**-2.0)
        block, weighted = self._blocks(), self._estimator.weights[0] * held_out
        scores = np.hstack([np.einsum("rik,ri->rk", self.friction, weighted), weighted])
        of_blocks = fold_sums(scores, block)
        A = np.linalg.inv(H[np.ix_(~fixed, ~fixed)])
        middle = (of_blocks.T @ of_blocks + P)[np.ix_(~fixed, ~fixed)]
        errors = np.zeros(k + len(self.names))
        errors[~fixed] = np.sqrt(np.diag(A @ middle @ A))
        return errors

    def _blocks(self) -> NDArray[np.int_]:
        return np.arange(len(self.tau)) // max(int(MAX_CORRELATION_TIME * self.rate), 1)

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of `standard_errors`: the number of blocks minus 1."""
        return float(max(self._blocks()[-1], 1))

    def _fixed(self, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.concatenate([np.any(self._loads & ~free, axis=1), ~free])

    def solve(self, free: NDArray[np.bool_], without_fold: int | None = None) -> NDArray[np.float64]:
        """Returns x (k + n,), fitted to all rows, or to those outside a fold.

        Args:
            free: Mask (n,) of the actuators whose friction and offset are fitted. The friction at a coordinate is
                fitted only if all actuators that move the coordinate are in the mask.
            without_fold: Index of the fold that is not used.
        """
        return self._estimator.solve(np.flatnonzero(~self._fixed(free)), without_fold)

    def scale(self, x: NDArray[np.float64], coordinate: str, part: FrictionPart) -> float | None:
        """Returns the factor of the dry or viscous friction of a coordinate, None if the model has no such friction."""
        return float(x[self.keys.index((coordinate, part))]) if (coordinate, part) in self.keys else None


def _moves_in_both_directions(model: DynamicModel, grid: MotionGrid) -> NDArray[np.bool_]:
    """Returns a mask (n,) of the actuators that move in both directions (limits: `MIN_SHARE` and `REST_SPEED`)."""
    v = model.arm.transmission.velocity(grid.v)
    share = np.minimum(np.mean(v > 0, axis=0), np.mean(v < 0, axis=0))
    speed = np.sqrt(np.mean(v**2, axis=0))
    return np.asarray((share >= MIN_SHARE) & (speed >= model.arm.per_joint(*REST_SPEED)))


def _section(section: DynamicSection, fit: _Fit, x: NDArray[np.float64], errors: NDArray[np.float64]) -> DynamicSection:
    """Returns the section of the model with the refitted friction and offsets.

    The error of one of several friction effects that share a factor contains the earlier error of its share.

    Args:
        section: Section before the refit.
        fit: Fit.
        x: Refitted factors and changes of offsets (k + n,).
        errors: Standard errors (k + n,) of x, 0 for values that were not fitted.
    """
    offsets = {f"actuator.{name}": i for i, name in enumerate(fit.names, start=len(fit.keys)) if errors[i]}
    parts = [(e.coordinate, EFFECT_KINDS[e.kind].role) for e in section.effects]
    effects = []
    for effect, part in zip(section.effects, parts, strict=True):
        coefficient, error = effect.coefficient, effect.standard_error
        if part in fit.keys and errors[i := fit.keys.index(part)]:
            coefficient, error = x[i] * coefficient, x[i] * error if parts.count(part) > 1 else 0.0
            error = np.hypot(error, errors[i] * effect.coefficient)
        elif effect.kind == "offset" and effect.coordinate in offsets:
            i = offsets.pop(effect.coordinate)
            coefficient, error = coefficient + x[i], errors[i]
        freedom = effect.degrees_of_freedom if error == effect.standard_error else fit.degrees_of_freedom
        new = replace(effect, coefficient=float(coefficient), standard_error=float(error), degrees_of_freedom=freedom)
        effects.append(new)
    effects += [
        DriveEffect(
            *(coordinate, "offset", 0.0, float(x[i])),
            standard_error=float(errors[i]),
            degrees_of_freedom=fit.degrees_of_freedom,
        )
        for coordinate, i in offsets.items()
    ]
    return replace(section, effects=effects)
