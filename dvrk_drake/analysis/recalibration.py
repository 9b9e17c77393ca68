"""Refits the friction and offsets of an identified model to a short motion, without changing other parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.results import ModelResult
from dvrk_drake.analysis.signals.drive_efforts import (
    FRICTION_PARTS,
    FrictionPart,
    drive_efforts,
    refuse_opposite_efforts,
)
from dvrk_drake.analysis.signals.motion_grid import MotionGrid, motion_grid
from dvrk_drake.analysis.signals.repetition import period_of, phase_folds
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_section import DynamicSection
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import REST_SPEED, Recording

#: Number of folds for cross-validation. The folds of a periodic motion are intervals of its phase.
FOLDS = 4
#: Prior standard deviations. The first is that of a friction factor, with prior mean 1. The second is that of the
#: change of an offset, as a share of the RMS effort, with prior mean 0.
SCALE_DEVIATION, OFFSET_DEVIATION = 0.5, 0.3
#: Assumed RMS residual of the fit, as a share of the RMS effort.
_RELATIVE_ERROR = 0.1
#: Assumed correlation time of the residuals [s]. Residuals are correlated because they are mainly model errors.
_CORRELATION_TIME = 0.1
#: Smallest share of the time during which an actuator must move in each direction. Otherwise, its friction is not
#: fitted.
MIN_SHARE = 0.1
#: Largest accepted relative error after the refit, as the mean over the actuators.
MAX_ERROR = 0.7


@dataclass(frozen=True)
class RecalibratedActuator:
    """Recalibration of one actuator.

    A relative error is |tau_f - tau_hat| / |tau_f|, where tau_f is the low-pass filtered measured effort and tau_hat is
    the predicted effort after the same filter.

    Attributes:
        name: Name of the joint of the actuator.
        before: Relative error of the model before recalibration [1].
        after: Cross-validated relative error after refitting friction and offset [1].
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
        seconds: Duration of the motion without the first and the last second [s].
    """

    actuators: list[RecalibratedActuator]
    shared: dict[str, float]
    seconds: float


def recalibrate(model: IdentifiedModel, recording: Recording, *, progress: Progress | None = None) -> Recalibration:
    """Checks a short motion and refits a model's friction and offsets to it, as `dvrk-drake recalibrate` does.

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
    report = require_usable(recording, dynamics.arm, progress)
    share = step_progress(progress, "refitting friction")
    share(0.0)
    result = refit_friction(model, recording)
    share(1.0)
    return replace(result, warnings=(*dropped, *report.warnings))


def refit_friction(model: IdentifiedModel, recording: Recording) -> Recalibration:
    """Fits factors of the dry and viscous friction at every coordinate, and a change of the offset of every actuator.

    Rigid bodies, springs and cables do not change. The errors are cross-validated over `FOLDS` folds of the motion. If
    the error of an actuator does not decrease, the offset of this actuator and the friction at all of its coordinates
    keep their values. The remaining factors and offsets are fitted again. The last fit uses the whole recording.

    Raises:
        RecordingError: The recording is not a motion of this arm, efforts have the wrong sign, no actuator moves in
            both directions, or the model error remains too large.
        ModelError: The model has no dynamics.
    """
    fit = _Fit(model.dynamic_model, recording)
    excited = fit.excited
    if not np.any(excited):
        raise RecordingError(
            f"{recording.source or 'recording'}: no actuator moves in both directions. Required: each direction for at "
            f"least {100 * MIN_SHARE:.0f} % of the time, and an RMS speed of at least {REST_SPEED[0]:g} rad/s "
            f"({REST_SPEED[1]:g} m/s)."
        )
    refuse_opposite_efforts(recording, fit.names, fit.tau, fit.expected)
    before = fit.error(fit.unchanged)
    first = fit.cross_validated_error(excited)
    free, after = excited.copy(), first
    while np.any(worse := free & ~(after < before)):
        free &= ~worse
        after = fit.cross_validated_error(free)
    if not np.mean(np.minimum(before, after)[fit.measured]) < MAX_ERROR:
        raise RecordingError(
            f"{recording.source or 'recording'}: the mean relative error over the actuators is "
            f"{100 * np.mean(after):.0f} % with fitted friction ({100 * np.mean(before):.0f} % before); at most "
            f"{100 * MAX_ERROR:.0f} % is allowed. Check the arm and the coordinates of the recording."
        )
    x = fit.solve(free, np.ones(len(fit.tau), dtype=bool))
    actuators = []
    for i, name in enumerate(fit.names):
        reason = "" if free[i] else "error not reduced" if excited[i] else "no motion in both directions"
        reason = reason if fit.measured[i] else "effort not measured"
        actuators.append(
            RecalibratedActuator(
                name=name,
                before=float(before[i]),
                after=float(first[i]),
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
    section = _section(model.dynamic_model.section, fit, x)
    return Recalibration(
        model=_with_section(model, section, recording),
        actuators=actuators,
        shared=shared,
        seconds=float(len(fit.tau) / fit.rate),
    )


def cross_validated_errors(
    model: IdentifiedModel, recording: Recording, folds: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the relative errors (n,) of the model, and the cross-validated errors (n,) after a refit of friction.

    The folds of a periodic motion are intervals of its phase, so that the fit for a fold does not use repetitions of
    this fold. The friction and offsets of all actuators that move in both directions are refitted.

    Raises:
        RecordingError: The recording is not a motion of this arm.
        ModelError: The model has no dynamics.
    """
    fit = _Fit(model.dynamic_model, recording, folds)
    return fit.error(fit.unchanged), fit.cross_validated_error(fit.excited)


class _Fit:
    """Least-squares fit of x (k + n,): k friction factors, then the changes of the n offsets.

    The prior means are the values of the model.
    """

    def __init__(self, model: DynamicModel, recording: Recording, folds: int = FOLDS) -> None:
        grid = motion_grid(recording, model.arm, model.section.signals)
        self.names = model.arm.joint_names
        self.rate = grid.rate
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
        self._fold, self._edge = phase_folds(grid, period_of(grid), folds)
        self.excited = _moves_in_both_directions(model, grid) & self.measured
        self.unchanged = np.concatenate([np.ones(len(self.keys)), np.zeros(len(self.names))])

    def error(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the relative errors (n,) for x (k + n,)."""
        return self._relative(np.sum(self._residuals(x) ** 2, axis=0))

    def cross_validated_error(self, free: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Returns the relative errors (n,) on held-out folds.

        The fit that predicts a fold does not use the rows next to this fold.
        """
        squares = np.zeros(len(self.names))
        for fold in range(self._folds):
            held_out = self._fold == fold
            adjacent = (self._edge[:, 0] & (self._fold == (fold + 1) % self._folds)) | (
                self._edge[:, 1] & (self._fold == (fold - 1) % self._folds)
            )
            squares += np.sum(self._residuals(self.solve(free, ~held_out & ~adjacent))[held_out] ** 2, axis=0)
        return self._relative(squares)

    def _residuals(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        k = len(self.keys)
        return np.asarray(self.tau - self.other - self.friction @ x[:k] - x[k:])

    def _relative(self, squares: NDArray[np.float64]) -> NDArray[np.float64]:
        size = np.sum(self.tau**2, axis=0)
        return np.sqrt(np.divide(squares, size, out=np.zeros_like(size), where=size > 0))

    def solve(self, free: NDArray[np.bool_], rows: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Returns x (k + n,), fitted to some rows of the motion.

        Args:
            free: Mask (n,) of the actuators whose friction and offset are fitted. The friction at a coordinate is
                fitted only if all actuators that move the coordinate are in the mask.
            rows: Mask (r,) of the rows.
        """
        k, n = len(self.keys), len(self.names)
        fixed = np.concatenate([np.any(self._loads & ~free, axis=1), ~free])
        size = np.where(self.measured, np.sqrt(np.mean(self.tau**2, axis=0)), 1.0)
        deviation = np.concatenate([np.full(k, SCALE_DEVIATION), OFFSET_DEVIATION * size])
        H, b = np.diag(deviation**-2.0), self.unchanged / deviation**2
        for i in np.flatnonzero(self.measured):
            X = np.hstack([self.friction[rows, i], np.tile(np.eye(n)[i], (int(np.sum(rows)), 1))])
            # Rows within the correlation time are not independent.
            weight = 1 / (_RELATIVE_ERROR * size[i]) ** 2 / (self.rate * _CORRELATION_TIME)
            H += weight * X.T @ X
            b += weight * X.T @ (self.tau - self.other)[rows, i]
        x = self.unchanged.copy()
        R = np.linalg.cholesky(H[np.ix_(~fixed, ~fixed)]).T
        right = b[~fixed] - H[np.ix_(~fixed, fixed)] @ x[fixed]
        lower = np.concatenate([np.zeros(k), np.full(n, -np.inf)])[~fixed]
        x[~fixed] = lsq_linear(R, np.linalg.solve(R.T, right), bounds=(lower, np.inf)).x if len(right) else []
        return x

    def scale(self, x: NDArray[np.float64], coordinate: str, part: FrictionPart) -> float | None:
        """Returns the factor of the dry or viscous friction of a coordinate, None if the model has no such friction."""
        return float(x[self.keys.index((coordinate, part))]) if (coordinate, part) in self.keys else None


def _moves_in_both_directions(model: DynamicModel, grid: MotionGrid) -> NDArray[np.bool_]:
    """Returns a mask (n,) of the actuators that move in both directions (limits: `MIN_SHARE` and `REST_SPEED`)."""
    v = model.arm.transmission.velocity(grid.v)
    share = np.minimum(np.mean(v > 0, axis=0), np.mean(v < 0, axis=0))
    speed = np.sqrt(np.mean(v**2, axis=0))
    return np.asarray((share >= MIN_SHARE) & (speed >= model.arm.per_joint(*REST_SPEED)))


def _section(section: DynamicSection, fit: _Fit, x: NDArray[np.float64]) -> DynamicSection:
    """Returns the section of the model with the refitted friction and offsets x (k + n,)."""
    scales = dict(zip(fit.keys, x[: len(fit.keys)], strict=True))
    offsets = {f"actuator.{name}": float(c) for name, c in zip(fit.names, x[len(fit.keys) :], strict=True) if c}
    effects = []
    for effect in section.effects:
        coefficient, error = effect.coefficient, effect.standard_error
        if effect.kind in FRICTION_PARTS:
            scale = float(scales.get((effect.coordinate, FRICTION_PARTS[effect.kind]), 1.0))
            coefficient, error = scale * coefficient, scale * error
        elif effect.kind == "offset":
            coefficient += offsets.pop(effect.coordinate, 0.0)
        effects.append(replace(effect, coefficient=coefficient, standard_error=error))
    effects += [DriveEffect(coordinate, "offset", 0.0, c) for coordinate, c in offsets.items()]
    return replace(section, effects=effects)


def _with_section(model: IdentifiedModel, section: DynamicSection, recording: Recording) -> IdentifiedModel:
    provenance = replace(
        model.provenance, method=f"{model.provenance.method}, recalibrated on {recording.source or 'a recording'}"
    )
    return replace(model, dynamics=section, provenance=provenance, validation=None)
