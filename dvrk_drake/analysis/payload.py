"""Estimates mass and position of a payload, with standard errors, from one recording or from two of the same motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from dvrk_drake.analysis.check.recording_check import require_usable, with_power
from dvrk_drake.analysis.estimation.normal_equations import NormalEquations
from dvrk_drake.analysis.estimation.point_mass import PointMass, PointMassProblem
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.motion_difference import MotionDifference, Whitening, motion_difference
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import phase_folds
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ModelError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import Reportable
from dvrk_drake.models.plant import link_poses
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import Recording

#: Confidence level of the reported intervals.
CONFIDENCE = 0.95
#: Largest ratio of the cross-validated errors for payloads on two links that explain the change of the efforts equally
#: well. For `psm_one_205g_insertion`, the ratio of the best wrong link is 1.43 with a reference. Links on which a
#: payload has the same effect have ratios below 1.001.
SAME_ERROR = 1.05
#: Largest share of an RMS effort that is a rounding error. Files contain efforts with six digits or more. Two
#: recordings whose efforts differ by less are the same, and a payload with a smaller effort does not load an actuator.
ROUNDING = 1e-6
#: Order of the autoregression that whitens the errors, and number of fits of the autoregression. It is the smallest
#: order that can represent an oscillation. The second fit uses residuals of a fit that already weights the frequencies.
AUTOREGRESSION_ORDER, NUM_WHITENING_ITERATIONS = 2, 2
#: Number of random poses at which the reach of the arm is measured. For an MTM and a PSM, the result is within 1 % of
#: that for 400 poses.
NUM_REACH_POSES = 50


@dataclass(frozen=True)
class PayloadActuator:
    """RMS efforts of one actuator after low-pass filtering [N m, N].

    Attributes:
        name: Name of the joint of the actuator.
        change: Difference between the efforts of the recordings.
        payload: Effort of the payload.
        left: Residual after subtracting the payload and the changes of the drive.
        explained: Share of the squared change that is explained, 1 - left^2 / change^2 [1], or None if the payload does
            not load the actuator.
    """

    name: str
    change: float
    payload: float
    left: float
    explained: float | None


@dataclass(frozen=True, eq=False)
class Payload:
    """Estimate of a payload, modelled as a point mass on a link.

    Attributes:
        link: Name of the link to which the payload is attached.
        body: Mass [kg] and position in the link frame [m].
        mass_error: Standard error of the mass [kg].
        position_error: Standard errors (3,) of the position [m], nan for coordinates that are not identifiable.
        quantile: Half-width of the confidence interval (`CONFIDENCE`), in standard errors.
        largest_at_com: Upper end of the confidence interval for a mass at the link's own centre of mass [kg].
        max_mass: Largest mass that the estimation allows [kg].
        position_in_base: Position (3,) of the payload in the base frame, with all joint positions at 0 [m].
        relative_error: Cross-validated RMS error with the payload divided by the error without a payload [1], as the
            geometric mean over the actuators. The folds are intervals of the phase of the motion.
        actuators: Efforts of the actuators, in the arm's order.
        shift: Time shift between the two recordings [s].
    """

    link: str
    body: PointMass
    mass_error: float
    position_error: NDArray[np.float64]
    quantile: float
    largest_at_com: float
    max_mass: float
    position_in_base: NDArray[np.float64]
    relative_error: float
    actuators: list[PayloadActuator]
    shift: float

    @property
    def found(self) -> bool:
        """True if the confidence interval of the mass excludes 0."""
        return self.body.mass > self.quantile * self.mass_error

    def as_dict(self, estimates: Sequence[Payload] = ()) -> dict:
        """Returns the output of `payload --json` for this link. Coordinates that are not identifiable are None.

        Args:
            estimates: Payloads on all links, for comparison. The entry "largest_at_com" is None if no payload was found
                on this link and a payload on another link may explain the change of the efforts.
        """
        determined = self.body.determined
        contradicted = bool(contradicting_links(self, estimates))

        def numbers(values: NDArray[np.float64]) -> list[float | None]:
            return [float(v) if known else None for v, known in zip(values, determined, strict=True)]

        return {
            "link": self.link,
            "found": self.found,
            "largest_at_com": None if contradicted and not self.found else self.largest_at_com,
            "mass": self.body.mass,
            "mass_standard_error": self.mass_error,
            "place_in_link": numbers(self.body.position),
            "place_standard_error": numbers(self.position_error),
            "confidence": CONFIDENCE,
            "quantile": self.quantile,
            "left_out_error": self.relative_error,
            "better_links": [payload.link for payload in better_links(self, estimates)],
            "shift": self.shift,
            "actuators": [asdict(actuator) for actuator in self.actuators],
        }


def estimate_payload(
    reference: Observations | None,
    loaded: Observations,
    model: DynamicModel,
    links: Sequence[str] | None = None,
    progress: Callable[[float], object] = lambda _: None,
) -> list[Payload]:
    """Estimates a point mass on each link from the change of the efforts. The best link is first.

    Without a reference, the change is the difference between the measured efforts and those of the model. The errors of
    the model are then part of the change. They are less certain than the changes of an arm between two recordings, so
    their prior standard deviation is larger (`motion_difference`).

    The model of the change of an actuator's effort has two parts: the ten regressor columns of the link with the
    parameters of a point mass, and possible changes of the drives (`MotionDifference.changes`). The dimensions of
    the payload are assumed to be small compared with its distance from the joint axes. On a link that rotates about a
    fixed point, only m p and the inertia m p p' are identifiable for a mass m at position p. Because of the assumption,
    m and p are nevertheless identifiable separately.

    The residual of each actuator is whitened (`Whitening`), because errors of offsets, friction and cables vary slowly,
    whereas inertia affects the high frequencies. The standard errors are computed by a delete-one jackknife over the
    folds of `phase_folds`, because errors that repeat with the motion do not average out over the periods. The standard
    errors are at least those for independent rows.

    Args:
        reference: Motion with efforts, without the payload. None: the change from the efforts of the model is used.
        loaded: Motion with the payload, the same as that of the reference.
        model: Model of the arm without the payload. It predicts the dry friction at each row, and the effect of small
            differences between the two motions.
        links: Names of the links. None means all moving links.
        progress: Callback that receives the finished share, 0 to 1.

    Raises:
        RecordingError: A recording is not a motion of this arm, the recordings are not of the same motion, or their
            efforts are identical.
        ModelError: A link does not exist or does not move.
    """
    regressor = model.regressor
    names = [link.link for link in regressor.links]
    tested = names if links is None else list(links)
    check_links(regressor, tested)
    difference = motion_difference(reference, loaded, model)
    progress(0.2)
    grid = difference.grid
    if np.sqrt(np.mean(difference.tau**2)) < ROUNDING * np.sqrt(np.mean(loaded.recording.measured_effort() ** 2)):
        other = "the model" if reference is None else "the reference. Use two different recordings of the motion"
        raise RecordingError(f"{loaded.source}: the efforts equal the efforts of {other}.")
    Y = regressor.regressor(grid.q, grid.v, grid.vd)
    J_inverse = model.arm.transmission.inverse.matrix
    estimates = []
    for count, link in enumerate(tested):
        k = names.index(link)
        columns = np.einsum("ji,mjp->mip", J_inverse, Y[..., 10 * k : 10 * k + 10])
        estimates.append(_estimate(regressor.links[k], columns, difference))
        progress(0.2 + 0.8 * (count + 1) / len(tested))
    return sorted(estimates, key=lambda payload: payload.relative_error)


@dataclass(frozen=True, eq=False)
class PayloadIdentification(Reportable):
    """Result of `payload`.

    Attributes:
        payload: Payload on the given link. Without a given link: payload on the link that explains the change best.
        estimates: Payload on each moving link, best first.
        model: Model of the arm without the payload.
        warnings: Findings about links that explain the change better, and about the recordings.
        link: Name of the given link, or None.
        has_reference: False if the change of the efforts is the difference from the efforts of the model.
    """

    payload: Payload
    estimates: list[Payload]
    model: IdentifiedModel
    warnings: tuple[Finding, ...] = ()
    link: str | None = None
    has_reference: bool = True

    def as_dicts(self) -> list[dict]:
        """Returns the output of `payload --json`: payload on the given link, or on every link if none is given."""
        payloads = self.estimates if self.link is None else [self.payload]
        return [payload.as_dict(self.estimates) for payload in payloads]


def payload(
    reference: Recording | None,
    loaded: Recording,
    model: IdentifiedModel | Arm,
    link: str | None = None,
    *,
    progress: Progress | None = None,
) -> PayloadIdentification:
    """Checks the recordings and estimates the payload of the arm, as `dvrk-drake payload` does.

    Args:
        reference: Motion with efforts (m, n), without the payload. None: the efforts are compared with those of the
            model. The estimate is then less accurate, because it contains the errors of the model.
        loaded: Motion with the payload, the same as that of the reference.
        model: Model identified from a motion of the arm without the payload. If an arm is given instead, the model is
            identified from `reference`.
        link: SDF link to which the payload is attached. None: the link that explains the change best.
        progress: Callback that receives the name of the step ("checking the recording", "identifying" or "estimating")
            and the finished share of the step (0 to 1).

    Returns:
        Result with mass [kg], position [m] and standard errors as `payload`, the estimates on all links as `estimates`,
        and `warnings`.

    Raises:
        RecordingError: `check` rejects a recording, the two motions differ, or the model was identified from `loaded`.
            The attribute `findings` of the error contains the reasons of `check`.
        ModelError: The model has no dynamics, there is neither a model nor a reference, or the link does not exist or
            does not move.
        IdentificationError: The model of the arm is not identifiable from `reference`.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("psm")
        >>> t, w = np.arange(0, 11, 0.02)[:, None], 1 + 0.25 * np.arange(7)
        >>> middle = (arm.position_upper + arm.position_lower) / 2
        >>> reach = 0.3 * (arm.position_upper - arm.position_lower)
        >>> q, v, vd = middle + reach * np.sin(w * t), reach * w * np.cos(w * t), -reach * w**2 * np.sin(w * t)
        >>> def recorded(model):
        ...     tau = arm.transmission.pull_back_effort(model.dynamic_model.effort(q, v, vd))
        ...     return dvrk.Recording(q=q, qd=v, tau=tau, t=t[:, 0])
        >>> model, heavier = (dvrk.IdentifiedModel.from_arm(arm, dynamics=True) for _ in range(2))
        >>> links = {link.link: link for link in heavier.dynamics.links}
        >>> links["end_link"].parameters[0] += 0.1  # [kg] at the origin of the link
        >>> result = dvrk.payload(recorded(model), recorded(heavier), model, "end_link")
        >>> round(result.payload.body.mass, 3), result.payload.found  # [kg]
        (0.1, True)
    """
    arm = model if isinstance(model, Arm) else model.arm
    check_links(DynamicRegressor(arm), [] if link is None else [link])
    if reference is None and isinstance(model, Arm):
        raise ModelError("a payload requires a reference recording, or a model of the arm without the payload")
    if not isinstance(model, Arm) and model.provenance.includes(loaded.sha256):
        raise RecordingError(
            f"{loaded.source or 'recording'}: the model was identified from this recording, so it contains the "
            "payload. Give a model of the arm without the payload."
        )
    warnings: tuple[Finding, ...] = ()
    observations: list[Observations] = []
    for given in (loaded,) if reference is None else (reference, loaded):
        recording, findings = with_power(given, arm)
        own = Observations(recording, arm) if isinstance(model, Arm) else Observations.for_model(recording, model)
        observations.append(own)
        report = require_usable(own, progress)
        if recording.tau is not None and np.any(unmeasured := recording.unmeasured):
            names = ", ".join(f"tau{j + 1}" for j in np.flatnonzero(unmeasured))
            raise RecordingError(
                f"{report.source}: {names} was not measured, but a payload requires the efforts of all joints. Record "
                "with power on all motors."
            )
        warnings += tuple(finding.within(report.source) for finding in (*findings, *report.warnings))
    *references, with_payload = observations
    if isinstance(model, Arm):
        model = identify_dynamic(references, step_progress(progress, "identifying")).model
    share = step_progress(progress, "estimating")
    estimates = estimate_payload(
        references[0] if references else None, with_payload, model.dynamic_model, progress=share
    )
    result = estimates[0] if link is None else next(p for p in estimates if p.link == link)
    warnings = (*better_link_warnings(result, estimates), *warnings)
    return PayloadIdentification(result, estimates, model, warnings, link, bool(references))


def check_links(regressor: DynamicRegressor, links: Sequence[str]) -> None:
    """Raises ModelError if a link does not exist or does not move."""
    names = [link.link for link in regressor.links]
    if unknown := [link for link in links if link not in names]:
        raise ModelError(f'unknown link "{unknown[0]}". Moving links of {regressor.arm.name}: {", ".join(names)}')


def equally_good_links(estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the payloads whose error is at most `SAME_ERROR` times the error of the payload on the best link."""
    return [payload for payload in estimates if payload.relative_error <= SAME_ERROR * estimates[0].relative_error]


def better_links(payload: Payload, estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the payloads on other links that explain the change clearly better (`SAME_ERROR`), best first."""
    return [other for other in estimates if SAME_ERROR * other.relative_error < payload.relative_error]


def better_link_warnings(payload: Payload, estimates: Sequence[Payload]) -> tuple[Finding, ...]:
    """Returns a warning if other links explain the change clearly better, otherwise an empty tuple."""
    better = better_links(payload, estimates)
    if not better:
        return ()
    first = better[0]
    same = [other.link for other in equally_good_links(estimates)]
    mass = f" ({first.body.mass:.3g} +- {first.mass_error:.2g} kg)" if first.found else ""
    what = (
        f"a payload on {' or '.join(same)}{mass} explains the change of the efforts better (cross-validated error "
        f"{100 * first.relative_error:.1f} % instead of {100 * payload.relative_error:.1f} %)"
    )
    advice = f"Unless the payload is certainly on {payload.link}, run again with --link {first.link}."
    return (Finding("warning", "other link", payload.link, what, advice),)


def contradicting_links(payload: Payload, estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the payloads on other links that may explain the change, best first.

    A link is listed if a payload on it explains the change clearly better. It is also listed if a payload was found on
    it and reduces the cross-validated error.
    """
    better = better_links(payload, estimates)
    return [
        other
        for other in estimates
        if other in better or (other is not payload and other.found and other.relative_error < 1)
    ]


def _estimate(link: LinkInertia, columns: NDArray[np.float64], difference: MotionDifference) -> Payload:
    plain, plain_weights, problem = _problems(link, columns, difference)
    folds = range(problem.equations.folds)
    body, weights, errors = problem.fit()
    bodies = [problem.without_fold(fold, weights, body) for fold in folds]
    standard_errors = _jackknife([[body.mass, *body.position] for body in bodies], errors)
    at_com, at_com_error = problem.mass_at_com(weights)
    at_com_errors = _jackknife([[problem.mass_at_com(weights, fold)[0]] for fold in folds], np.array([at_com_error]))
    quantile = float(stdtrit(len(folds) - 1, (1 + CONFIDENCE) / 2))
    rows, arm = len(difference.tau), difference.grid.arm
    rms = np.sqrt(np.stack(plain.budget(body, plain_weights)) / rows)
    actuators = [
        PayloadActuator(name, change, load, left, 1 - (left / change) ** 2 if load > ROUNDING * change else None)
        for name, (change, load, left) in zip(arm.joint_names, rms.T.tolist(), strict=True)
    ]
    with_payload, without = (
        np.maximum(np.sum([problem.fold_errors(fold, weights, start) for fold in folds], axis=0), 1e-30)
        for start in (body, None)
    )
    return Payload(
        link=link.link,
        body=body,
        mass_error=float(standard_errors[0]),
        position_error=np.where(body.determined, standard_errors[1:], np.nan),
        quantile=quantile,
        largest_at_com=max(at_com, 0.0) + quantile * float(at_com_errors[0]),
        max_mass=problem.max_mass,
        position_in_base=_in_base(arm, link.link, body.position),
        relative_error=float(np.exp(np.mean(np.log(with_payload / without)) / 2)),
        actuators=actuators,
        shift=difference.shift,
    )


def _jackknife(estimates: list[list[float]], min_errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the standard errors (k,), at least `min_errors`. Each row of `estimates` (folds, k) excludes one fold."""
    return np.maximum(np.sqrt((len(estimates) - 1) * np.var(np.array(estimates), axis=0)), min_errors)


def _problems(
    link: LinkInertia, columns: NDArray[np.float64], difference: MotionDifference
) -> tuple[PointMassProblem, NDArray[np.float64], PointMassProblem]:
    """Returns the problem of a link without whitening, its weights (n,), and the problem with whitened residuals.

    The ten regressor columns (m, n, 10) of the link are sampled on the grid of the motion.
    """
    grid, n = difference.grid, difference.grid.arm.num_joints
    at_rows = np.stack([grid.at_rows(columns[:, i], i) for i in range(n)], axis=1)
    filtered = grid.filter_efforts(at_rows)[difference.rows]
    actuator_columns = [np.hstack([filtered[:, i], difference.changes[:, i]]) for i in range(n)]
    problem = plain = _problem(link, actuator_columns, difference, Whitening.none(n))
    body, plain_weights, _ = plain.fit()
    weights = plain_weights
    for iteration in range(NUM_WHITENING_ITERATIONS):
        if iteration:
            body, weights, _ = problem.fit(body)
        fitted = zip(actuator_columns, problem.coefficients(body, weights), strict=True)
        residual = difference.tau - np.column_stack([X @ x for X, x in fitted])
        whitening = Whitening.of(residual, AUTOREGRESSION_ORDER, grid.rate, grid.settings.effort_cut_off)
        problem = _problem(link, actuator_columns, difference, whitening)
    return plain, plain_weights, problem


def _problem(
    link: LinkInertia, actuator_columns: list[NDArray[np.float64]], difference: MotionDifference, whitening: Whitening
) -> PointMassProblem:
    grid, rows = difference.grid, np.flatnonzero(difference.rows)[whitening.num_removed :]
    fold, edge = phase_folds(grid, difference.period)
    tau = np.column_stack([whitening(x, i) for i, x in enumerate(difference.tau.T)])
    size = actuator_columns[0].shape[1]
    columns = ((np.arange(size), whitening(x, i)) for i, x in enumerate(actuator_columns))
    equations = NormalEquations.of(columns, size, tau, fold[rows], edge[rows])
    # A low-pass filtered effort has two independent values per period of the cut-off frequency. Errors that repeat with
    # the motion have fewer independent values, so the standard errors are computed by a jackknife over the folds.
    independent = 2 * grid.settings.effort_cut_off / grid.rate
    com = link.parameters[1:4] / link.parameters[0]
    precision = np.mean(difference.changes**2, axis=0) / difference.deviation**2
    mass, distance = _largest(grid.arm)
    return PointMassProblem(equations, len(tau) * min(independent, 1.0), com, precision, mass, distance)


@cache
def _largest(arm: Arm) -> tuple[float, float]:
    """Returns the largest mass [kg] of a payload, and its largest distance from the centre of mass of its link [m].

    An arm carries less than the mass of its own links. A tool extends the reach of its links by less than one half.
    """
    poses = arm.sample_poses(NUM_REACH_POSES, np.random.default_rng(0))
    reach = max(float(np.linalg.norm(X.translation())) for q in poses for X in link_poses(arm, q).values())
    return sum(float(link.parameters[0]) for link in link_inertias(arm)), 1.5 * reach


def _in_base(arm: Arm, link: str, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transforms a position (3,) from the link frame to the base frame, with all joint positions at 0 [m]."""
    return np.asarray(ArmFrame(arm, link).pose(np.zeros(arm.num_joints)) @ position, dtype=float)
