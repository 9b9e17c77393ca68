"""An identified model on another day: friction and offsets of its drive from a short recording, all else as it was."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from dvrk_drake.analysis.check.recording_check import require_usable
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

#: Parts of the motion, cut by its phase where it repeats, each predicted from the others to decide what is kept.
FOLDS = 4
#: A friction scale may well differ from 1 by this, an offset by this share of the RMS effort.
SCALE_DEVIATION, OFFSET_DEVIATION = 0.5, 0.3
#: Relative error that the efforts are weighed with.
_RELATIVE_ERROR = 0.1
#: An actuator must move in both directions for at least this share of the time.
MIN_SHARE = 0.1
#: A recording that leaves a larger share of the efforts unexplained, on average, is of another arm.
MAX_ERROR = 0.7


@dataclass(frozen=True)
class RecalibratedActuator:
    """One actuator, errors as |tau_f - tau_hat| / |tau_f|.

    Attributes:
        name: of the joint whose actuator it is.
        before: error of the model as it was.
        after: error of parts of the motion that are predicted with friction and offset from the other parts.
        kept: whether the new model has them.
        reason: why not, or "".
        dry, viscous: scales of the actuator's own friction, from the whole recording; None where it has none.
        offset: change of the offset [N m, N].
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
    """A model with new friction.

    Attributes:
        actuators: in the arm's order.
        shared: scales of friction at places that several actuators move, e.g. "finger_1 dry".
        seconds: of the motion that were used, a second at each end left out.
    """

    actuators: list[RecalibratedActuator]
    shared: dict[str, float]
    seconds: float


def recalibrate(model: IdentifiedModel, recording: Recording, *, progress: Progress | None = None) -> Recalibration:
    """Checks a short motion and refits a model's friction and offsets to it: what `dvrk-drake recalibrate` does.

    The gain is for motions like that one; at other positions and speeds it can be much smaller.

    Args:
        model: identified from a motion.
        recording: a motion with efforts (m, n), in joint or actuator coordinates, of another day.
        progress: called with the step, "checking the recording" or "refitting friction", and its finished share 0..1.

    Returns:
        The new model as `model`, each actuator's error before and after as `actuators`, and `warnings`.

    Raises:
        RecordingError: `check` refuses the recording, it is of another arm, or no actuator moves both ways.
        ModelError: the model has no dynamics.

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
    report = require_usable(recording, dynamics.arm, progress)
    share = step_progress(progress, "refitting friction")
    share(0.0)
    result = refit_friction(model, recording)
    share(1.0)
    return replace(result, warnings=report.warnings)


def refit_friction(model: IdentifiedModel, recording: Recording) -> Recalibration:
    """Fits one scale of dry and one of viscous friction at every coordinate of the drive, and an offset an actuator.

    Rigid bodies, springs and cables stay. Each of `FOLDS` parts of the motion is predicted from the others: where an
    actuator's error does not fall, its offset and friction, and those that it shares, stay as they were, and the others
    are fitted again; what is kept is then fitted to all of the recording.

    Raises:
        RecordingError: it is no motion of this arm, it is of another arm, efforts have the wrong sign, or no actuator
            moves both ways.
        ModelError: the model has no dynamics.
    """
    fit = _Fit(model.dynamic_model, recording)
    excited = fit.excited
    if not np.any(excited):
        raise RecordingError(
            f"{recording.source or 'recording'}: no actuator moves both ways for {MIN_SHARE:.0%} of the time at "
            f"{REST_SPEED[0]:g} rad/s, {REST_SPEED[1]:g} m/s RMS or more; friction shows only in such a motion"
        )
    refuse_opposite_efforts(recording, fit.names, fit.tau, fit.expected)
    before = fit.error(fit.nothing)
    first = fit.left_out_error(excited)
    free, after = excited.copy(), first
    while np.any(worse := free & ~(after < before)):
        free &= ~worse
        after = fit.left_out_error(free)
    if not np.mean(np.minimum(before, after)) < MAX_ERROR:
        raise RecordingError(
            f"{recording.source or 'recording'}: efforts differ from the model's by {np.mean(before):.0%} on average "
            f"over the actuators, and by {np.mean(after):.0%} with its friction fitted; {MAX_ERROR:.0%} is "
            "allowed: is it of this arm, in these coordinates?"
        )
    x = fit.solve(free, np.ones(len(fit.tau), dtype=bool))
    actuators = []
    for i, name in enumerate(fit.names):
        reason = "" if free[i] else "gains nothing" if excited[i] else "does not move both ways"
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


def predict_other_phases(
    model: IdentifiedModel, recording: Recording, parts: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Relative errors (n,) of the model, and with the friction of each part of the motion refitted to the other parts.

    The parts are cut by the phase of a motion that repeats, so no refit has seen a phase that it is judged on. All
    actuators that move both ways are refitted.

    Raises:
        RecordingError: it is no motion of this arm.
        ModelError: the model has no dynamics.
    """
    fit = _Fit(model.dynamic_model, recording, parts)
    return fit.error(fit.nothing), fit.left_out_error(fit.excited)


class _Fit:
    """Least squares for friction scales and offsets about what the model has: x is (scales - 0 ... , offsets)."""

    def __init__(self, model: DynamicModel, recording: Recording, folds: int = FOLDS) -> None:
        grid = motion_grid(recording, model.arm, model.section.signals)
        self.names = model.arm.joint_names
        self.rate = grid.rate
        expected = drive_efforts(model, grid)
        self.tau = grid.behind_filter(recording.in_actuator_coordinates(model.arm).measured_effort())
        self.other = expected.other
        self.keys = list(expected.friction)
        self.friction = np.stack([expected.friction[key] for key in self.keys], axis=2)
        rows = model.arm.effect_coordinates
        self._loads = np.array([rows[coordinate] != 0 for coordinate, _ in self.keys])
        self.expected = expected.total()
        self._folds = folds
        self._fold, self._edge = phase_folds(grid, period_of(grid), folds)
        self.excited = _moves_both_ways(model, grid)
        self.nothing = np.concatenate([np.ones(len(self.keys)), np.zeros(len(self.names))])

    def error(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) relative error."""
        return self._relative(np.sum(self._left(x) ** 2, axis=0))

    def left_out_error(self, free: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(n,) relative error of parts of the motion that are predicted from the others, less what is beside them."""
        squares = np.zeros(len(self.names))
        for fold in range(self._folds):
            own = self._fold == fold
            beside = (self._edge[:, 0] & (self._fold == (fold + 1) % self._folds)) | (
                self._edge[:, 1] & (self._fold == (fold - 1) % self._folds)
            )
            squares += np.sum(self._left(self.solve(free, ~own & ~beside))[own] ** 2, axis=0)
        return self._relative(squares)

    def _left(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        k = len(self.keys)
        return np.asarray(self.tau - self.other - self.friction @ x[:k] - x[k:])

    def _relative(self, squares: NDArray[np.float64]) -> NDArray[np.float64]:
        size = np.sum(self.tau**2, axis=0)
        return np.asarray(np.sqrt(squares / np.maximum(size, np.finfo(float).tiny)))

    def solve(self, free: NDArray[np.bool_], rows: NDArray[np.bool_]) -> NDArray[np.float64]:
        """x (k + n,); friction and offsets of actuators that are not free stay, and friction that they share."""
        k, n = len(self.keys), len(self.names)
        known = np.concatenate([np.any(self._loads & ~free, axis=1), ~free])
        size = np.sqrt(np.mean(self.tau**2, axis=0))
        deviation = np.concatenate([np.full(k, SCALE_DEVIATION), OFFSET_DEVIATION * size])
        H, b = np.diag(deviation**-2.0), self.nothing / deviation**2
        for i in range(n):
            X = np.hstack([self.friction[rows, i], np.tile(np.eye(n)[i], (int(np.sum(rows)), 1))])
            # A row is not an independent measurement: what friction does not explain stays for a while.
            weight = 1 / (_RELATIVE_ERROR * size[i]) ** 2 / (self.rate * 0.1)
            H += weight * X.T @ X
            b += weight * X.T @ (self.tau - self.other)[rows, i]
        x = self.nothing.copy()
        R = np.linalg.cholesky(H[np.ix_(~known, ~known)]).T
        right = b[~known] - H[np.ix_(~known, known)] @ x[known]
        lower = np.concatenate([np.zeros(k), np.full(n, -np.inf)])[~known]
        x[~known] = lsq_linear(R, np.linalg.solve(R.T, right), bounds=(lower, np.inf)).x if len(right) else []
        return x

    def scale(self, x: NDArray[np.float64], coordinate: str, part: FrictionPart) -> float | None:
        """Of one part of the friction at a coordinate, None if the model has none there."""
        return float(x[self.keys.index((coordinate, part))]) if (coordinate, part) in self.keys else None


def _moves_both_ways(model: DynamicModel, grid: MotionGrid) -> NDArray[np.bool_]:
    """(n,) which actuators do, for long and fast enough."""
    v = model.arm.transmission.velocity(grid.v)
    share = np.minimum(np.mean(v > 0, axis=0), np.mean(v < 0, axis=0))
    speed = np.sqrt(np.mean(v**2, axis=0))
    return np.asarray((share >= MIN_SHARE) & (speed >= model.arm.per_joint(*REST_SPEED)))


def _section(section: DynamicSection, fit: _Fit, x: NDArray[np.float64]) -> DynamicSection:
    """The section with its friction scaled, and with the offsets' changes added."""
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
