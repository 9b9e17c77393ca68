"""Designs a motion that gives the most information about the dynamics of an arm, within all limits."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.solvers import MathematicalProgram, SnoptSolver, SolverOptions

from dvrk_drake.analysis.excitation.information import (
    STEP,
    USED,
    MotionInformation,
    effort_without_friction,
    middle_pose,
    random_motion,
    sample_times,
    state_of,
    states_at,
)
from dvrk_drake.analysis.excitation.motion_limits import ROUNDING, MotionLimits, first_collision, motion_violations
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import Reportable
from dvrk_drake.progress import Progress, step_progress

#: Number of times per harmonic at which the information is computed and the efforts are limited. The information
#: contains products of two states, whose frequencies require more than four times.
INFORMATION_TIMES = 8
#: Numbers of times per harmonic at which the optimisation limits positions, velocities, accelerations and jerks. High
#: harmonics are a larger part of high derivatives, which therefore need more times. The contraction corrects the small
#: excess between the times.
_DERIVATIVE_TIMES = (6, 6, 8, 12)
#: Share of the effort limits that the optimisation uses, see `USED`.
_USED_EFFORT = 0.95
#: Longest default period [s]. A motion of two minutes then has four periods, which give its repeatability.
MAX_PERIOD = 30.0
#: Largest number of major iterations of the solver, and of minor iterations in each of them. The first quadratic
#: programs need more minor iterations, but incomplete solutions of them are sufficient. The quadratic programs are
#: solved by a quasi-Newton method. With SNOPT's default (Cholesky factors) and 100 major iterations, two random motions
#: led to 1.887 and 1.908 % after 73 and 66 s; now they lead to 1.885 and 1.814 % after 45 and 66 s (MTML, 30 s, 16
#: harmonics; processor time on a busy computer).
MAX_ITERATIONS, MAX_MINOR_ITERATIONS = 200, 150
#: Factor by which a motion is contracted towards its centre until it has no collision and meets all limits, and largest
#: number of contractions. The contraction is at most 1 % more than necessary, and ends at 22 % of the motion, with
#: which an excitation is no longer useful.
_CONTRACTION, _MAX_CONTRACTIONS = 0.99, 150


@dataclass(frozen=True, eq=False)
class ExcitationDesign(Reportable):
    """Designed motion and the information that it gives.

    Attributes:
        arm: Arm of the motion.
        motion: Motion within all limits.
        expected_error: Expected RMS error of efforts that a model predicts after this motion, relative to the RMS
            efforts, see `MotionInformation.expected_error`.
        known_parameters: Number of base parameters with a standard error of at most 10 %.
        num_parameters: Number of base parameters.
        condition_number: See `MotionInformation.condition_number`.
        random_error: Smallest expected error of the random motions from which the optimisation started.
    """

    arm: Arm
    motion: PeriodicMotion
    expected_error: float
    known_parameters: int
    num_parameters: int
    condition_number: float
    random_error: float

    def __repr__(self) -> str:
        return (
            f"<ExcitationDesign of {self.motion.arm}: {self.motion.duration:g} s, expected error "
            f"{100 * self.expected_error:.1f} %>"
        )


def design_excitation(
    arm: Arm,
    *,
    duration: float = 30.0,
    period: float | None = None,
    harmonics: int = 16,
    limits: MotionLimits | None = None,
    model: IdentifiedModel | None = None,
    starts: int = 2,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> ExcitationDesign:
    """Designs a motion for `identify`: periodic, at rest at both ends, and within all limits.

    The motion of each joint is a Fourier series. The coefficients minimise the expected error of efforts that the
    identified model predicts for random motions within the limits (V-optimality), see `MotionInformation`. The solver
    is SNOPT, started from several random motions. The best motion is contracted towards its centre until
    `motion_violations` finds nothing.

    Args:
        arm: Arm to move.
        duration: Duration of the motion [s]. It is rounded up to whole periods.
        period: Period [s]. None: the duration divided by the smallest number for which the period is at
            most `MAX_PERIOD`.
        harmonics: Number of harmonics, 2 to 20.
        limits: Limits of the motion. None: the defaults of `MotionLimits`.
        model: Earlier model of the arm. Its parameters and gravity vector replace those of `arm`, for the effort limits
            and for the expected results. The motion gives the most information in addition to that of the model, see
            `MotionInformation`.
        starts: Number of random motions from which the optimisation starts.
        seed: Seed of the random motions.
        executor: Executor that runs the optimisations in parallel, e.g. a `ProcessPoolExecutor`. None: one after the
            other in this process.
        progress: Callback that receives the name of the step ("optimising") and the finished share (0 to 1).

    Raises:
        ExcitationError: An argument is out of range, the model is that of another arm, or no motion meets the limits.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.load_arm("mtml")
        >>> design = dvrk.design_excitation(arm, duration=5.0, period=5.0, harmonics=3, starts=1)
        >>> design.motion.duration
        5.0
        >>> design.expected_error < design.random_error
        True
    """
    period = duration / max(np.ceil(duration / MAX_PERIOD), 1.0) if period is None else period
    for name, value, lowest, highest in (
        ("period", period, 1.0, 600.0),
        ("duration", duration, period, 36_000.0),
        ("harmonics", harmonics, 2, 20),
        ("starts", starts, 1, 100),
    ):
        if not lowest <= value <= highest:
            raise ExcitationError(f"{name} is {value:g}; allowed: {lowest:g} to {highest:g}")
    limits = limits or MotionLimits()
    limits.of_arm(arm)
    if model is not None:
        if (model.arm.name, model.arm.joint_names) != (arm.name, arm.joint_names):
            raise ExcitationError(
                f"the model is for {model.arm.name} with the joints {', '.join(model.arm.joint_names)}; allowed: a "
                f"model of {arm.name} with the joints {', '.join(arm.joint_names)}"
            )
        arm = arm.with_gravity(model.arm.gravity.tolist())
        # A copy has no compiled functions, which cannot be sent to another process.
        model = replace(model)
    middle = middle_pose(arm, limits, np.random.default_rng(seed))
    if collision := first_collision(arm, middle[None], limits.environment):
        raise ExcitationError(f"{arm.name}: no motion meets all limits: {collision[1]} in the middle of the motion")
    share = step_progress(progress, "optimising")
    share(0.0)
    problems = [_Problem(arm, limits, model, period, harmonics, seed + k) for k in range(starts)]
    results = []
    for result in (map if executor is None else executor.map)(_solve, problems):
        results.append(result)
        share(0.9 * len(results) / starts)
    best = min(results, key=lambda result: result[1])
    motion = contracted(best[0], arm, limits, model)
    motion = replace(motion, repetitions=int(np.ceil(duration / period - ROUNDING)), environment=limits.environment)
    share(1.0)
    information = MotionInformation(arm, limits, model)
    state = state_of(motion, INFORMATION_TIMES * harmonics)
    criterion, matrix = information.criterion, information.matrix(state, period)
    return ExcitationDesign(
        arm=arm,
        motion=motion,
        expected_error=criterion.after(matrix),
        known_parameters=criterion.known_parameters(matrix),
        num_parameters=information.num_base,
        condition_number=information.condition_number(state),
        random_error=min(result[2] for result in results),
    )


def contracted(
    motion: PeriodicMotion, arm: Arm, limits: MotionLimits, model: IdentifiedModel | None = None
) -> PeriodicMotion:
    """Returns the motion after a small contraction towards its centre with which it meets all limits.

    With one contraction less, it exceeds a limit.

    Raises:
        ExcitationError: The motion does not meet the limits after `_MAX_CONTRACTIONS` contractions.
    """

    def after(contractions: int) -> tuple[PeriodicMotion, list[str]]:
        sine, cosine = ((_CONTRACTION**contractions * np.array(x)).tolist() for x in (motion.sine, motion.cosine))
        smaller = replace(motion, sine=sine, cosine=cosine)
        return smaller, motion_violations(smaller, arm, limits, model)

    # Contractions after which the motion exceeds a limit, and after which it meets all limits.
    exceeds, meets = -1, 0
    found, violations = after(meets)
    while violations:
        if meets == _MAX_CONTRACTIONS:
            raise ExcitationError(f"{arm.name}: no motion meets all limits: {violations[0]}")
        exceeds, meets = meets, min(max(1, 2 * meets), _MAX_CONTRACTIONS)
        found, violations = after(meets)
    while meets - exceeds > 1:
        middle = (exceeds + meets) // 2
        smaller, violations = after(middle)
        if violations:
            exceeds = middle
        else:
            meets, found = middle, smaller
    return found


@dataclass(frozen=True, eq=False)
class _Problem:
    """Optimisation from one random motion."""

    arm: Arm
    limits: MotionLimits
    model: IdentifiedModel | None
    period: float
    harmonics: int
    seed: int

    def solve(self) -> tuple[PeriodicMotion, float, float]:
        """Returns the motion, its expected error, and the expected error of the random motion."""
        arm, basis = self.arm, FourierBasis.of(self.period, self.harmonics)
        information = MotionInformation(arm, self.limits, self.model)
        generator = np.random.default_rng(self.seed)
        start = random_motion(arm, self.limits, self.period, self.harmonics, generator, self.model)
        n, size, unit = arm.num_joints, 2 * self.harmonics - 1, information.scales[0]
        program = MathematicalProgram()
        x = program.NewContinuousVariables(n, size, "x")
        _add_joint_limits(program, x, unit, basis, arm, self.limits)
        _add_effort_limits(program, x, basis, information)
        values = basis.values(sample_times(basis, INFORMATION_TIMES))[:3]

        def cost(variables: NDArray) -> object:
            is_gradient = variables.dtype == object
            number = ExtractValue(variables).ravel() if is_gradient else variables
            state = states_at(values, unit[:, None] * number.reshape(n, size))
            if not is_gradient:
                return float(np.log(information.expected_error(state, self.period)))
            value, by_state = information.log_error_gradient(state, self.period)
            gradient = np.einsum("kmj,kmb->jb", by_state, values) * unit[:, None]
            return InitializeAutoDiff([value], gradient.reshape(1, -1) @ ExtractGradient(variables))[0, 0]

        program.AddCost(cost, vars=x.ravel())
        guess = _coefficients(start, basis) / unit[:, None]
        program.SetInitialGuess(x, guess)
        options = SolverOptions()
        options.SetOption(SnoptSolver.id(), "Major iterations limit", MAX_ITERATIONS)
        options.SetOption(SnoptSolver.id(), "Minor iterations limit", MAX_MINOR_ITERATIONS)
        options.SetOption(SnoptSolver.id(), "QPSolver", "QN")
        options.SetOption(SnoptSolver.id(), "Major optimality tolerance", 1e-3)
        result = SnoptSolver().Solve(program, None, options)
        found = unit[:, None] * result.GetSolution(x)
        random_error = information.expected_error(states_at(values, unit[:, None] * guess), self.period)
        motion = PeriodicMotion.of_coefficients(arm, basis, found, 1)
        return motion, information.expected_error(states_at(values, found), self.period), random_error


def _solve(problem: _Problem) -> tuple[PeriodicMotion, float, float]:
    return problem.solve()


def _coefficients(motion: PeriodicMotion, basis: FourierBasis) -> NDArray[np.float64]:
    weights = np.array(motion.sine) @ basis.sines + np.array(motion.cosine) @ basis.cosines
    return np.column_stack([motion.center, weights])


def _add_joint_limits(
    program: MathematicalProgram,
    x: NDArray,
    unit: NDArray[np.float64],
    basis: FourierBasis,
    arm: Arm,
    limits: MotionLimits,
) -> None:
    """Adds the linear constraints on positions, velocities, accelerations and jerks."""
    joints = limits.of_arm(arm)
    by_order = [basis.values(sample_times(basis, times)) for times in _DERIVATIVE_TIMES]
    values = by_order[0]
    middle, half = (joints.lower + joints.upper) / 2, USED * (joints.upper - joints.lower) / 2
    for row, T, center, allowed in zip(joints.A, joints.look_ahead, middle, half, strict=True):
        used = np.flatnonzero(row)
        rows = np.hstack([row[j] * unit[j] * (values[0] + T * values[1]) for j in used])
        one = np.ones(len(rows))
        program.AddLinearConstraint(rows, (center - allowed) * one, (center + allowed) * one, x[used].ravel())
    for k, limit in ((1, joints.speed), (2, joints.acceleration), (3, joints.jerk)):
        for j in range(arm.num_joints):
            scaled = by_order[k][k] * unit[j] / limit[j]
            bound = np.full(len(scaled), USED)
            program.AddLinearConstraint(scaled[:, 1:], -bound, bound, x[j, 1:])


def _add_effort_limits(
    program: MathematicalProgram, x: NDArray, basis: FourierBasis, information: MotionInformation
) -> None:
    """Adds the constraints on the predicted efforts, relative to their limits."""
    predicted, scales = information.predicted, information.scales
    allowed, unit = _USED_EFFORT * effort_without_friction(predicted, information.limits), scales[0]
    values, n = basis.values(sample_times(basis, INFORMATION_TIMES))[:3], len(allowed)

    def effort(state: NDArray[np.float64]) -> NDArray[np.float64]:
        return predicted.without_dry_friction(*state) / allowed

    def constraint(variables: NDArray) -> object:
        is_gradient = variables.dtype == object
        number = ExtractValue(variables).ravel() if is_gradient else variables
        state = states_at(values, unit[:, None] * number.reshape(n, -1))
        tau = effort(state)
        if not is_gradient:
            return tau.ravel()
        # (m, i, j, b): derivative of the effort of joint i with respect to coefficient b of joint j.
        gradient = np.zeros((*tau.shape, n, values.shape[2]))
        for k in range(3):
            for j in range(n):
                step = STEP * scales[k, j]
                ahead = state.copy()
                ahead[k, :, j] += step
                slope = (effort(ahead) - tau) / step
                gradient[:, :, j] += slope[:, :, None] * values[k][:, None] * unit[j]
        return InitializeAutoDiff(tau.ravel(), gradient.reshape(tau.size, -1) @ ExtractGradient(variables)).ravel()

    bound = np.ones(values.shape[1] * n)
    program.AddConstraint(constraint, lb=-bound, ub=bound, vars=x.ravel())
