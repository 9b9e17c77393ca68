"""Identifies the full dynamics of an arm from one motion: physically consistent link parameters, rotors and effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.dynamic.columns import drive_effects, dynamic_columns, optional_effects
from dvrk_drake.analysis.dynamic.effect_selection import cross_validate, select_effects
from dvrk_drake.analysis.dynamic.estimates import DynamicEstimates, base_parameter_estimates, parameter_covariance
from dvrk_drake.analysis.dynamic.problem import ConsistentFit, DynamicProblem
from dvrk_drake.analysis.results import Identification
from dvrk_drake.analysis.signals.motion_grid import MotionGrid, default_settings, motion_grid
from dvrk_drake.analysis.signals.repetition import period_of, phase_folds, repeatability_floor
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
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.recordings.recording import REST_SPEED, Recording

#: Smallest absolute coefficient of an effect that the model contains, in units of the prior standard deviation of this
#: coefficient.
MIN_EFFECT = 1e-4
#: Largest number of rows in a fit. A motion with more rows is thinned out after low-pass filtering.
MAX_ROWS = 40_000


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class DynamicIdentification(Identification):
    """Model identified from a motion.

    The model contains `dynamics`. The base parameters of gravity are computed from the identified link parameters.

    Attributes:
        grid: Resampled motion.
        period: Period of the motion [s], or None if the motion does not repeat.
        measured: Measured efforts (r, n) of the actuators after low-pass filtering [N m, N]. One second at each end of
            the motion is omitted.
        predicted: Predicted efforts (r, n) of the actuators at the same rows, after the same low-pass filter [N m, N].
        held_out: Efforts (r, n) that cross-validation predicts for the rows of each held-out fold [N m, N].
        dry_friction: Coordinate -> sum of its Coulomb and presliding friction, and standard error of this sum [N m, N].
        nominal_mass: Total mass of the links in the SDF [kg].
    """

    grid: MotionGrid
    period: float | None
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]
    held_out: NDArray[np.float64]
    dry_friction: dict[str, tuple[float, float]]
    nominal_mass: float


def identify_dynamic(
    recording: Recording, arm: Arm, progress: Callable[[float], object] = lambda _: None
) -> DynamicIdentification:
    """Identifies the dynamics of `arm` from a motion.

    Measured efforts and regressor columns are filtered with the same low-pass filter. The model includes the mandatory
    effects of `drive_effects`. These are an offset of every actuator, friction along every drive coordinate, and the
    springs, cables and asymmetric friction that the arm file lists. The friction model consists of viscous, smoothed
    Coulomb and presliding friction. Additional effects are selected by cross-validation over the phase of the motion.

    The link parameters are physically consistent. For parameters that the recording does not identify, the estimates
    are the values of the SDF (`consistent_parameters`). The direction of gravity is estimated if the arm file allows a
    base tilt. The cross-validated errors are prediction errors on held-out folds (`cross_validate`).

    Args:
        recording: Motion with t and tau, in joint or actuator coordinates.
        arm: Arm that was recorded.
        progress: Callback that receives the finished share, 0 to 1.

    Raises:
        RecordingError: The recording does not match the arm, has no efforts, or is not a motion.
        IdentificationError: The solver for consistent parameters did not converge, or the cross-validated RMS error of
            a moving actuator exceeds the RMS effort of this actuator.
    """
    grid = motion_grid(recording, arm, default_settings(arm), max_rows=MAX_ROWS)
    tau = recording.in_actuator_coordinates(arm).measured_effort()
    progress(0.05)
    period = period_of(grid)
    problem = motion_problem(grid, tau, period)
    progress(0.2)
    selection = select_effects(problem, lambda share: progress(0.2 + 0.3 * share))
    selection, fit = selection.consistent()
    problem, effects = selection.problem, selection.effects
    held_out = cross_validate(selection, fit.x[: problem.num_rigid], lambda share: progress(0.55 + 0.45 * share))
    measured = problem.columns.tau
    squares = np.sum((measured - held_out) ** 2, axis=0)
    _refuse_worse_than_zero(recording, grid, np.sqrt(squares / np.maximum(problem.efforts, np.finfo(float).tiny)))
    predicted = problem.predict(effects, fit.x)
    error = measured - predicted
    covariance = parameter_covariance(problem, fit, error, grid.rate / grid.step, grid.settings.effort_cut_off, period)
    estimates = DynamicEstimates(problem, fit, covariance)
    section = _section(problem, effects, fit, covariance, squares, grid, tau, period)
    section.links = estimates.links()
    section.base_parameters, section.correlations = estimates.base_parameters()
    model = _model(recording, arm, section, covariance)
    progress(1.0)
    nominal = float(sum(link.parameters[0] for link in problem.regressor.links))
    return DynamicIdentification(
        model=model,
        recording=recording,
        num_rows=len(recording),
        grid=grid,
        period=period,
        measured=measured,
        predicted=predicted,
        held_out=held_out,
        dry_friction=estimates.dry_friction(),
        nominal_mass=nominal,
    )


def _refuse_worse_than_zero(recording: Recording, grid: MotionGrid, errors: NDArray[np.float64]) -> None:
    """Raises IdentificationError if the cross-validated relative error of a moving actuator exceeds 1.

    Args:
        recording: Recording that the error message names.
        grid: Resampled motion.
        errors: Cross-validated relative errors (n,) of the actuators [1].
    """
    arm = grid.arm
    moves = np.sqrt(np.mean(arm.transmission.velocity(grid.v) ** 2, axis=0)) > arm.per_joint(*REST_SPEED)
    if len(bad := np.flatnonzero(moves & (errors > 1))):
        joints = ", ".join(f"{arm.joint_names[i]} ({100 * errors[i]:.0f} %)" for i in bad)
        raise IdentificationError(
            f"{recording.source or 'recording'}: no model was identified, because the cross-validated relative error "
            f"exceeds 100 % for {joints}. Check the arm, the coordinates, and the order, signs and units of the "
            "columns (dvrk-drake check)."
        )


def motion_problem(
    grid: MotionGrid, tau: NDArray[np.float64], period: float | None, effects: Sequence[ActuatorEffect] | None = None
) -> DynamicProblem:
    """Returns the least-squares problem of a motion.

    Args:
        grid: Resampled motion.
        tau: Measured efforts (m, n) of the actuators at the rows of the recording [N m, N].
        period: Period of the motion [s], or None if the motion does not repeat.
        effects: Effects of the model, all of which are mandatory. If None, the effects of `drive_effects` are mandatory
            and those of `optional_effects` are candidates.
    """
    mandatory = effects if effects is not None else drive_effects(grid.arm, grid)
    candidates = [] if effects is not None else optional_effects(grid.arm, grid)
    regressor = DynamicRegressor(grid.arm)
    columns = dynamic_columns(grid, tau, regressor, [*mandatory, *candidates])
    fold, edge = phase_folds(grid, period)
    # A low-pass filtered effort has two independent values per period of the cut-off frequency. Repetitions of the
    # motion do not add independent values.
    duration = len(columns.tau) * grid.step / grid.rate
    independent = 2 * grid.settings.effort_cut_off * min(duration, period or duration)
    return DynamicProblem(
        grid=grid,
        kept=np.ones(len(columns.tau), dtype=bool),
        columns=columns,
        regressor=regressor,
        fold=fold,
        edge=edge,
        independent=min(independent, len(columns.tau)),
        num_mandatory=len(mandatory),
    )


def _section(
    problem: DynamicProblem,
    selected: NDArray[np.int_],
    fit: ConsistentFit,
    covariance: NDArray[np.float64],
    held_out: NDArray[np.float64],
    grid: MotionGrid,
    tau: NDArray[np.float64],
    period: float | None,
) -> DynamicSection:
    arm, p = grid.arm, problem.num_rigid
    sd = np.sqrt(np.diag(covariance))
    rotors = [
        RotorEstimate(name, float(fit.x[i]), float(sd[i]))
        for i, name in enumerate(arm.joint_names, start=p - arm.num_joints)
    ]
    effects = []
    for k, effect in enumerate(problem.columns.effects[c] for c in selected):
        value = float(fit.x[p + k])
        if value**2 * problem.effect_precision[selected[k]] > MIN_EFFECT**2:
            effects.append(
                DriveEffect(effect.coordinate, effect.kind, effect.scale, value, standard_error=float(sd[p + k]))
            )
    rows = problem.num_rows
    size = np.sqrt(problem.efforts / rows)
    floor = np.zeros(arm.num_joints)
    if period is not None:
        floor = np.nan_to_num(repeatability_floor(tau, grid.rate, period, grid.settings.effort_cut_off)) * size
    actuators = [
        ActuatorStatistics(name, *map(float, numbers))
        for name, *numbers in zip(
            arm.joint_names, size, np.sqrt(fit.errors / rows), np.sqrt(held_out / rows), floor, strict=True
        )
    ]
    gravity = problem.regressor.arm.gravity + np.append(problem.tilt, 0.0)
    gravity *= np.linalg.norm(problem.regressor.arm.gravity) / np.linalg.norm(gravity)
    expected = [float(g) for g in arm.gravity]
    return DynamicSection([float(g) for g in gravity], [], rotors, effects, actuators, grid.settings, expected)


def _model(recording: Recording, arm: Arm, section: DynamicSection, covariance: NDArray[np.float64]) -> IdentifiedModel:
    in_joints = recording.in_joint_coordinates(arm)
    as_mounted = arm.with_gravity(section.gravity)
    joints = []
    for j, name in enumerate(arm.joint_names):
        lower, upper = float(in_joints.q[:, j].min()), float(in_joints.q[:, j].max())
        coverage = (upper - lower) / float(arm.position_upper[j] - arm.position_lower[j])
        joints.append(JointStatistics(name=name, position_lower=lower, position_upper=upper, coverage=coverage))
    model = IdentifiedModel(
        arm=as_mounted,
        joints=joints,
        provenance=Provenance(
            recording=recording.source,
            sha256=recording.sha256,
            poses=len(recording),
            method="dynamic",
            version=version("dvrk-drake"),
        ),
        dynamics=section,
    )
    model.base_parameters = base_parameter_estimates(as_mounted, section, covariance)
    return model
