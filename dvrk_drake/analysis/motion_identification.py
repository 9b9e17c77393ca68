"""Identifies the full dynamics of an arm from motions: physically consistent link parameters, rotors and effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.motion_columns import (
    DynamicColumns,
    RecordingEffect,
    drive_effects,
    dynamic_columns,
    optional_effects,
)
from dvrk_drake.analysis.estimation.motion_effects import common_delay, cross_validate, select_effects
from dvrk_drake.analysis.estimation.motion_estimates import (
    ParameterCovariance,
    ResidualSeries,
    base_parameter_estimates,
    dry_friction,
    link_estimates,
    motion_parameters,
    parameter_covariance,
)
from dvrk_drake.analysis.estimation.motion_problem import ConsistentFit, DynamicProblem
from dvrk_drake.analysis.observations.motion_grid import MotionGrid
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import (
    FOLDS,
    correlation_of,
    motion_floor,
    phase_folds,
)
from dvrk_drake.analysis.observations.true_time import MAX_ROWS
from dvrk_drake.analysis.results import Identification
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import (
    ActuatorStatistics,
    DynamicSection,
    RotorEstimate,
)
from dvrk_drake.dynamics.identified_model import IdentifiedModel, JointStatistics, Provenance
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import has_converted_model
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.recordings.recording import REST_SPEED, Recording

#: Smallest absolute coefficient of an effect that the model contains, in units of the prior standard deviation of this
#: coefficient. Twice the value omits one more effect of the public motion `psm_one`, and changes its errors on another
#: day by at most 0.001 percentage points.
MIN_EFFECT = 1e-4


@dataclass(frozen=True, eq=False)
class FittedMotion:
    """Efforts of one recording in an identification, at r rows, without both ends (`MotionGrid.inner`).

    Attributes:
        observations: Motion as recorded, and its preparation.
        grid: Resampled motion, thinned out if it is long.
        measured: Measured efforts (r, n) after low-pass filtering, see `MotionGrid.channels` [N m, N].
        predicted: Predicted efforts (r, n), after the same low-pass filter [N m, N].
        held_out: Efforts (r, n) that cross-validation predicts for the rows of each held-out fold [N m, N]. If there is
            more than one recording, the fold is the whole recording.
    """

    observations: Observations
    grid: MotionGrid
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]
    held_out: NDArray[np.float64]

    @property
    def recording(self) -> Recording:
        """Motion as recorded."""
        return self.observations.recording

    @property
    def period(self) -> float | None:
        """Period of the motion [s], or None if the motion does not repeat."""
        return self.observations.period

    @property
    def held_out_errors(self) -> NDArray[np.float64]:
        """Relative RMS errors (n,) of `held_out` [1], nan if the measured effort is 0."""
        squares = np.sum((self.measured - self.held_out) ** 2, axis=0), np.sum(self.measured**2, axis=0)
        return np.sqrt(np.divide(*squares, out=np.full(len(squares[0]), np.nan), where=squares[1] > 0))


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class DynamicIdentification(Identification):
    """Model identified from one or more motions.

    The model contains `dynamics`. The base parameters of gravity are computed from the identified link parameters.
    `recording` is the first recording.

    Attributes:
        motions: Efforts of each recording.
        dry_friction: Coordinate -> sum of its Coulomb and presliding friction, and standard error of this sum [N m, N].
    """

    motions: tuple[FittedMotion, ...]
    dry_friction: dict[str, tuple[float, float]]


def identify_dynamic(
    observations: Sequence[Observations], progress: Callable[[float], object] = lambda _: None
) -> DynamicIdentification:
    """Identifies the dynamics of an arm from one or more motions.

    Measured efforts and regressor columns are filtered with the same low-pass filter. The model includes the mandatory
    effects of `drive_effects`. These are an offset of every actuator, friction along every drive coordinate, and the
    springs, cables and asymmetric friction that the arm file lists. The friction model consists of viscous, smoothed
    Coulomb and presliding friction. Additional effects are selected by cross-validation over the phase of the motion.

    If the links are those of a model file and no delay of the efforts is stated, one delay is estimated for all of them
    (`common_delay`).

    The link parameters are physically consistent. For parameters that the recordings do not identify, the estimates
    are the values of the SDF (`consistent_parameters`). The direction of gravity is estimated if the arm file allows a
    base tilt. The cross-validated errors are prediction errors on held-out folds (`cross_validate`).

    All recordings have the same links, rotors and effects. Offsets and friction of the actuators differ between the
    recordings (`RecordingEffect`), and the model contains their means.

    Args:
        observations: Motions of the arm, with efforts.
        progress: Callback that receives the finished share, 0 to 1.

    Raises:
        RecordingError: A recording does not match the arm, has no efforts, or is not a motion.
        IdentificationError: The solver for consistent parameters did not converge, or the cross-validated RMS error of
            a moving actuator exceeds the RMS effort of this actuator.
    """
    arm, settings = observations[0].arm, observations[0].settings
    recordings = [own.recording for own in observations]
    problem = motion_problem(observations)
    if has_converted_model(arm) and not any(settings.effort_delay):
        settings = replace(settings, effort_delay=[common_delay(problem, observations)] * arm.num_joints)
        if any(settings.effort_delay):
            observations = [Observations(own.recording, arm, settings, own.clocks) for own in observations]
            problem = motion_problem(observations)
    progress(0.2)
    selection = select_effects(problem, lambda share: progress(0.2 + 0.3 * share))
    selection, fit = selection.consistent()
    problem, effects = selection.problem, selection.effects
    held_out = cross_validate(selection, fit.x[: problem.num_rigid], lambda share: progress(0.55 + 0.45 * share))
    measured = problem.columns.tau
    predicted = problem.predict(effects, fit.x)
    parts = [np.flatnonzero(problem.recording == i) for i in range(len(recordings))]
    rows = [slice(int(part[0]), int(part[-1]) + 1) for part in parts]
    motions = tuple(
        FittedMotion(observed, grid, measured[own], predicted[own], held_out[own])
        for observed, grid, own in zip(observations, problem.grids, rows, strict=True)
    )
    for motion in motions:
        _refuse_worse_than_zero(motion)
    series = []
    for own, motion in zip(rows, motions, strict=True):
        first, rate = own.start, motion.grid.rate / motion.grid.step
        for segment, _, _ in motion.grid.each_segment():
            series.append(ResidualSeries(slice(first, first + len(segment.inner_rows)), rate, motion.period))
            first += len(segment.inner_rows)
    covariance = parameter_covariance(problem, fit, measured - predicted, settings.effort_cut_off, series)
    fitted = problem, fit, covariance
    floors = [_repeatability(own.tau, motion) for own, motion in zip(observations, motions, strict=True)]
    section = _section(*fitted, measured - held_out, floors)
    section.links = link_estimates(*fitted)
    section.base_parameters, section.correlations = motion_parameters(*fitted)
    model = _model(recordings, arm, section, covariance.estimates)
    progress(1.0)
    return DynamicIdentification(
        model=model,
        recording=recordings[0],
        num_rows=sum(map(len, recordings)),
        motions=motions,
        dry_friction=dry_friction(*fitted),
    )


def thinned(grids: Sequence[MotionGrid]) -> tuple[MotionGrid, ...]:
    """Returns the motions with similar rates of their rows, and with at most about `MAX_ROWS` rows in total."""
    seconds = sum(len(grid.row_times) / grid.rate for grid in grids)
    rate = min(MAX_ROWS / seconds, *(grid.rate for grid in grids))
    return tuple(grid.thinned(max(1, round(grid.rate / rate))) for grid in grids)


def _refuse_worse_than_zero(motion: FittedMotion) -> None:
    """Raises IdentificationError if the cross-validated relative error of a moving actuator exceeds 1."""
    arm, recording, errors = motion.grid.arm, motion.recording, motion.held_out_errors
    moves = np.sqrt(np.mean(arm.transmission.velocity(motion.grid.v) ** 2, axis=0)) > arm.per_joint(*REST_SPEED)
    if len(bad := np.flatnonzero(moves & (errors > 1))):
        joints = ", ".join(f"{arm.joint_names[i]} ({100 * errors[i]:.0f} %)" for i in bad)
        raise IdentificationError(
            f"{recording.source or 'recording'}: no model was identified, because the cross-validated relative error "
            f"exceeds 100 % for {joints}. Check the arm, the coordinates, and the order, signs and units of the "
            "columns (dvrk-drake check)."
        )


def motion_problem(
    observations: Sequence[Observations], effects: Sequence[ActuatorEffect] | None = None
) -> DynamicProblem:
    """Returns the least-squares problem of one or more motions of an arm.

    Args:
        observations: Motions of the arm, with efforts. Long motions are thinned out (`thinned`).
        effects: Effects of the model, all of which are mandatory. If None, the effects of `drive_effects` are mandatory
            and those of `optional_effects` are candidates, without effects that do not act on a measured effort.
    """
    arm, grids = observations[0].arm, thinned([own.grid for own in observations])
    mandatory = effects if effects is not None else drive_effects(arm, grids)
    candidates = [] if effects is not None else optional_effects(arm, grids)
    regressor = DynamicRegressor(arm)
    columns = [
        dynamic_columns(grid, own.tau, regressor, [*mandatory, *candidates])
        for grid, own in zip(grids, observations, strict=True)
    ]
    whole = DynamicColumns.of_recordings(columns)
    num_mandatory = len(mandatory)
    if effects is None:
        # Without information, only the prior would bound their coefficients.
        acting = whole.acting
        num_mandatory = int(np.sum(acting[:num_mandatory]))
        whole = whole.with_effects(acting)
    num_folds = -(-FOLDS // len(grids))
    folds, edges = zip(
        *(phase_folds(grid, own.period, num_folds) for grid, own in zip(grids, observations, strict=True)), strict=True
    )
    # A low-pass filtered effort has two independent values per period of the cut-off frequency. Repetitions of the
    # motion do not add independent values.
    independent = 0.0
    for grid, own, observed in zip(grids, columns, observations, strict=True):
        duration = len(own.tau) * grid.step / grid.rate
        independent += 2 * grid.settings.effort_cut_off * min(duration, observed.period or duration)
    num_rows = [len(own.tau) for own in columns]
    return DynamicProblem(
        grids=grids,
        kept=np.ones(sum(num_rows), dtype=bool),
        recording=np.repeat(np.arange(len(grids)), num_rows),
        columns=whole,
        regressor=regressor,
        fold=np.concatenate([fold + num_folds * i for i, fold in enumerate(folds)]),
        edge=np.concatenate(edges),
        independent=min(independent, sum(num_rows)),
        num_mandatory=num_mandatory,
    )


def _repeatability(tau: NDArray[np.float64], motion: FittedMotion) -> NDArray[np.float64]:
    """Returns the RMS difference (n,) of the efforts tau (m, n) between periods [N m, N], nan without a period."""
    if motion.period is None:
        return np.full(tau.shape[1], np.nan)
    grid, size = motion.grid, np.sqrt(np.mean(motion.measured**2, axis=0))
    return np.nan_to_num(motion_floor(tau, grid, motion.period)) * size


def _section(
    problem: DynamicProblem,
    fit: ConsistentFit,
    covariance: ParameterCovariance,
    held_out: NDArray[np.float64],
    floors: Sequence[NDArray[np.float64]],
) -> DynamicSection:
    arm, p = problem.regressor.arm, problem.num_rigid
    sd, freedom = np.sqrt(np.diag(covariance.estimates)), covariance.degrees_of_freedom
    rotors = [
        RotorEstimate(name, float(fit.x[i]), float(sd[i]))
        for i, name in enumerate(arm.joint_names, start=p - arm.num_joints)
    ]
    effects = []
    for k, effect in enumerate(problem.columns.effects[c] for c in fit.effects):
        value = float(fit.x[p + k])
        if isinstance(effect, RecordingEffect):
            continue
        if value**2 * problem.effect_precision[fit.effects[k]] > MIN_EFFECT**2:
            effects.append(
                DriveEffect(
                    *(effect.coordinate, effect.kind, effect.scale, value),
                    standard_error=float(sd[p + k]),
                    degrees_of_freedom=freedom,
                )
            )
    rows = problem.num_rows
    size = np.sqrt(problem.efforts / rows)
    repeating = [floor for floor in floors if np.all(np.isfinite(floor))]
    floor = np.sqrt(np.mean(np.square(repeating), axis=0)) if repeating else np.zeros(arm.num_joints)
    of_held_out = np.sqrt(np.mean(held_out**2, axis=0))
    statistics = size, np.sqrt(fit.errors / rows), of_held_out, floor, size * arm.identification.day_deviation
    actuators = [
        ActuatorStatistics(name, *map(float, numbers))
        for name, *numbers in zip(arm.joint_names, *statistics, strict=True)
    ]
    gravity = problem.regressor.arm.gravity + np.append(problem.tilt, 0.0)
    gravity *= np.linalg.norm(problem.regressor.arm.gravity) / np.linalg.norm(gravity)
    expected = [float(g) for g in arm.gravity]
    return DynamicSection(
        *([float(g) for g in gravity], [], rotors, effects, actuators, problem.grids[0].settings, expected),
        degrees_of_freedom=freedom,
        error_correlation=correlation_of(held_out).tolist(),
    )


def _model(
    recordings: Sequence[Recording], arm: Arm, section: DynamicSection, covariance: NDArray[np.float64]
) -> IdentifiedModel:
    q = np.concatenate([recording.in_joint_coordinates(arm).q for recording in recordings])
    as_mounted = arm.with_gravity(section.gravity)
    joints = []
    measured = np.any([recording.measured_joints(arm) for recording in recordings], axis=0)
    for j, name in enumerate(arm.joint_names):
        lower, upper = float(q[:, j].min()), float(q[:, j].max())
        coverage = (upper - lower) / float(arm.position_upper[j] - arm.position_lower[j])
        # A joint whose effort was not measured gets no feedforward.
        joints.append(
            JointStatistics(
                name,
                feedforward_scale=float(measured[j]),
                position_lower=lower,
                position_upper=upper,
                coverage=coverage,
            )
        )
    model = IdentifiedModel(
        arm=as_mounted,
        joints=joints,
        provenance=Provenance(
            recording=", ".join(recording.source for recording in recordings),
            sha256=" ".join(recording.sha256 for recording in recordings),
            poses=len(q),
            method="dynamic",
            version=version("dvrk-drake"),
        ),
        dynamics=section,
    )
    model.base_parameters = base_parameter_estimates(as_mounted, section, covariance)
    return model
