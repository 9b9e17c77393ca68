"""Estimates mass and position of a payload, with standard errors, from two recordings of the same motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from dvrk_drake.analysis.check.findings import Finding
from dvrk_drake.analysis.check.recording_check import require_usable
from dvrk_drake.analysis.dynamic.dynamic_identification import identify_dynamic
from dvrk_drake.analysis.dynamic.normal_equations import NormalEquations
from dvrk_drake.analysis.payload.motion_difference import MotionDifference, Whitening, motion_difference
from dvrk_drake.analysis.payload.point_mass import PointMass, PointMassProblem
from dvrk_drake.analysis.signals.repetition import phase_folds
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.errors import ModelError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import shared_plant
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import Recording

#: Confidence level of the reported intervals.
CONFIDENCE = 0.95
#: Links whose cross-validation error is within this factor of the smallest explain the recording equally well.
SAME_ERROR = 1.05
#: Recordings whose efforts differ by less than this share are identical.
MIN_DIFFERENCE = 1e-6
#: Order of the autoregression that whitens the errors, and the number of times it is fitted.
AUTOREGRESSION, WHITENED = 2, 2
#: Smallest load of an actuator by the payload, as a share of the difference of its efforts, for it to be used.
MIN_LOAD = 1e-6


@dataclass(frozen=True)
class PayloadActuator:
    """RMS efforts of one actuator after low-pass filtering [N m, N].

    Attributes:
        name: Name of the joint of the actuator.
        change: Difference between the recordings.
        payload: Part that is explained by the payload.
        left: Residual that neither the payload nor changes of the drive explain.
        explained: 1 - left^2 / change^2, or None if the payload does not load the actuator.
    """

    name: str
    change: float
    payload: float
    left: float
    explained: float | None


@dataclass(frozen=True, eq=False)
class Payload:
    """Point mass on a link.

    Attributes:
        link: Name of the link that carries the payload.
        body: Mass [kg] and position in the link frame [m].
        mass_error: Standard error of the mass [kg].
        place_error: Standard errors (3,) of the position [m], nan for coordinates that are not identifiable.
        quantile: Half the width of the interval of `CONFIDENCE`, in standard errors.
        largest_at_com: Upper end of the interval of a mass that is at the link's own centre of mass [kg].
        place_in_base: Position (3,) in the base frame with all joints at 0 [m].
        left_out: RMS error of cross-validation over the phase of the motion, divided by the error without a payload.
            Geometric mean over the actuators.
        actuators: Efforts of the actuators, in the arm's order.
        shift: Time shift between the two recordings [s].
    """

    link: str
    body: PointMass
    mass_error: float
    place_error: NDArray[np.float64]
    quantile: float
    largest_at_com: float
    place_in_base: NDArray[np.float64]
    left_out: float
    actuators: list[PayloadActuator]
    shift: float

    @property
    def found(self) -> bool:
        """True if the interval of the mass excludes 0."""
        return self.body.mass > self.quantile * self.mass_error

    def as_dict(self, estimates: Sequence[Payload] = ()) -> dict:
        """Returns the entry of `payload --json`, with None for coordinates that are not identifiable.

        Args:
            estimates: Payloads on all links, for comparison. The bound of the mass is omitted if a payload on another
                link explains the change.
        """
        known = self.body.determined
        elsewhere = shown_elsewhere(self, estimates)

        def numbers(values: NDArray[np.float64]) -> list[float | None]:
            return [float(v) if ok else None for v, ok in zip(values, known, strict=True)]

        return {
            "link": self.link,
            "found": self.found,
            "largest_at_com": None if elsewhere and not self.found else self.largest_at_com,
            "mass": self.body.mass,
            "mass_standard_error": self.mass_error,
            "place_in_link": numbers(self.body.place),
            "place_standard_error": numbers(self.place_error),
            "confidence": CONFIDENCE,
            "quantile": self.quantile,
            "left_out_error": self.left_out,
            "better_links": [payload.link for payload in better_links(self, estimates)],
            "shift": self.shift,
            "actuators": [asdict(actuator) for actuator in self.actuators],
        }


def estimate_payload(
    reference: Recording,
    loaded: Recording,
    model: DynamicModel,
    links: Sequence[str] | None = None,
    progress: Callable[[float], object] = lambda _: None,
) -> list[Payload]:
    """Estimates the point mass on each link that best explains the change from the reference, best link first.

    For each actuator, the difference of the efforts is explained by two parts: the ten regressor columns of the link
    with the parameters of a point mass, and possible changes of the drives (`MotionDifference.changes`). A payload is
    assumed to be small compared with its distance from the joint axes. This assumption separates mass and position on
    a link that rotates about a fixed point, where only m p and the inertia m p p' are identifiable.

    The residual of each actuator is whitened (`Whitening`), because errors from offsets, friction and cables are slow,
    while inertia affects the fast parts of a motion. The standard errors are a delete-one jackknife over the folds of
    `phase_folds`. Unlike errors of independent rows, errors that repeat with the motion do not average out over its
    repetitions. The standard errors are not smaller than those of independent rows.

    Args:
        reference: Recording of the motion without the payload.
        loaded: Recording of the same motion with the payload.
        model: Model of the arm in the reference. It determines the shape of Coulomb friction and the effect of
            differences between the motions.
        links: Names of links. Defaults to all moving links.
        progress: Function that is called with the completed share, 0..1.

    Raises:
        RecordingError: A recording is not a motion of this arm, the recordings are not of the same motion, or they are
            identical.
        ModelError: A link does not exist.
    """
    regressor = model.regressor
    names = [link.link for link in regressor.links]
    wanted = names if links is None else list(links)
    check_links(regressor, wanted)
    difference = motion_difference(reference, loaded, model)
    progress(0.2)
    grid = difference.grid
    if np.sqrt(np.mean(difference.tau**2)) < MIN_DIFFERENCE * np.sqrt(np.mean(loaded.measured_effort() ** 2)):
        raise RecordingError(
            f"{loaded.source or 'recording'}: the efforts equal the efforts of the reference. Use two different "
            "recordings of the motion."
        )
    Y = regressor.regressor(grid.q, grid.v, grid.vd)
    J_inverse = model.arm.transmission.inverse.matrix
    estimates = []
    for count, link in enumerate(wanted):
        k = names.index(link)
        columns = np.einsum("ji,mjp->mip", J_inverse, Y[..., 10 * k : 10 * k + 10])
        estimates.append(_estimate(regressor.links[k], columns, difference))
        progress(0.2 + 0.8 * (count + 1) / len(wanted))
    return sorted(estimates, key=lambda payload: payload.left_out)


@dataclass(frozen=True, eq=False)
class PayloadIdentification:
    """Result of `payload`.

    Attributes:
        payload: Payload on the given link, or on the link that explains the change best.
        estimates: Payloads on each moving link, best first.
        model: Model of the arm without the payload.
        warnings: Warnings about links that explain the change better, and about the recordings.
        link: Name of the given link, or None.
    """

    payload: Payload
    estimates: list[Payload]
    model: IdentifiedModel
    warnings: tuple[Finding, ...] = ()
    link: str | None = None

    def as_dicts(self) -> list[dict]:
        """Returns the data of `payload --json`: the payload on the given link, or on every link."""
        chosen = self.estimates if self.link is None else [self.payload]
        return [payload.as_dict(self.estimates) for payload in chosen]


def payload(
    reference: Recording,
    loaded: Recording,
    model: IdentifiedModel | Arm,
    link: str | None = None,
    *,
    progress: Progress | None = None,
) -> PayloadIdentification:
    """Checks two recordings of one motion and estimates the payload of the arm, like `dvrk-drake payload`.

    Args:
        reference: Motion with efforts (m, n), without the payload.
        loaded: The same motion with the payload.
        model: Model identified from a motion of the arm without the payload, or the arm. In the latter case the model
            is identified from `reference`.
        link: SDF link that carries the payload. None selects the link that explains the change best.
        progress: Function that is called with the step, "checking the recording", "identifying" or "estimating", and
            its completed share 0..1.

    Returns:
        Mass [kg] and position [m] with standard errors as `payload`, the same for each link as `estimates`, and
        `warnings`.

    Raises:
        RecordingError: `check` rejects a recording, or the two are not of one motion. See `findings` of the error.
        ModelError: The model has no dynamics, or the link does not exist.
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
    found: tuple[Finding, ...] = ()
    for recording in (reference, loaded):
        report = require_usable(recording, arm, progress)
        found += tuple(replace(warning, where=f"{report.source}: {warning.where}") for warning in report.warnings)
    if isinstance(model, Arm):
        model = identify_dynamic(reference, arm, step_progress(progress, "identifying")).model
    estimates = estimate_payload(reference, loaded, model.dynamic_model, progress=step_progress(progress, "estimating"))
    chosen = estimates[0] if link is None else next(p for p in estimates if p.link == link)
    found = (*better_link_warnings(chosen, estimates), *found)
    return PayloadIdentification(chosen, estimates, model, found, link)


def check_links(regressor: DynamicRegressor, links: Sequence[str]) -> None:
    """Raises ModelError if a link does not move or does not exist. Called before a model is identified."""
    names = [link.link for link in regressor.links]
    if unknown := [link for link in links if link not in names]:
        raise ModelError(f'unknown link "{unknown[0]}". Moving links of {regressor.arm.name}: {", ".join(names)}')


def as_good(estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the links that explain the change as well as the best one."""
    return [payload for payload in estimates if payload.left_out <= SAME_ERROR * estimates[0].left_out]


def better_links(payload: Payload, estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the links that explain the change clearly better than `payload`, best first."""
    return [other for other in estimates if SAME_ERROR * other.left_out < payload.left_out]


def better_link_warnings(payload: Payload, estimates: Sequence[Payload]) -> tuple[Finding, ...]:
    """Returns a warning with the links that explain the change better than that of `payload`, if there are any."""
    better = better_links(payload, estimates)
    if not better:
        return ()
    first = better[0]
    same = [other.link for other in as_good(estimates)]
    mass = f" ({first.body.mass:.3g} +- {first.mass_error:.2g} kg)" if first.found else ""
    what = (
        f"a payload on {' or '.join(same)}{mass} explains the change better (cross-validated error "
        f"{100 * first.left_out:.1f} % instead of {100 * payload.left_out:.1f} %)"
    )
    advice = f"Unless the payload is certainly on {payload.link}, run again with --link {first.link}."
    return (Finding("warning", "other link", payload.link, what, advice),)


def shown_elsewhere(payload: Payload, estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the links that contradict the absence of a payload on the link of `payload`, best first.

    These links explain the change clearly better, or their estimated mass predicts phases that were not used for its
    fit.
    """
    better = better_links(payload, estimates)
    return [
        other for other in estimates if other in better or (other is not payload and other.found and other.left_out < 1)
    ]


def _estimate(link: LinkInertia, columns: NDArray[np.float64], difference: MotionDifference) -> Payload:
    problems = _Problems.of(link, columns, difference)
    plain, problem = problems.plain, problems.whitened
    folds = range(problem.equations.folds)
    body, weights, errors = problem.fit()
    parts = [problem.without_fold(fold, weights, body) for fold in folds]
    spread = _jackknife([[part.mass, *part.place] for part in parts], errors)
    at_com, at_com_error = problem.mass_at_com(weights)
    at_com_spread = _jackknife([[problem.mass_at_com(weights, fold)[0]] for fold in folds], np.array([at_com_error]))
    quantile = float(stdtrit(len(folds) - 1, (1 + CONFIDENCE) / 2))
    rows, arm = len(difference.tau), difference.grid.arm
    rms = np.sqrt(np.stack(plain.budget(body, problems.plain_weights)) / rows)
    actuators = [
        PayloadActuator(name, change, own, left, 1 - (left / change) ** 2 if own > MIN_LOAD * change else None)
        for name, (change, own, left) in zip(arm.joint_names, rms.T.tolist(), strict=True)
    ]
    with_it, without = (
        np.maximum(np.sum([problem.fold_errors(fold, weights, start) for fold in folds], axis=0), 1e-30)
        for start in (body, None)
    )
    return Payload(
        link=link.link,
        body=body,
        mass_error=float(spread[0]),
        place_error=np.where(body.determined, spread[1:], np.nan),
        quantile=quantile,
        largest_at_com=max(at_com, 0.0) + quantile * float(at_com_spread[0]),
        place_in_base=_in_base(arm, link.link, body.place),
        left_out=float(np.exp(np.mean(np.log(with_it / without)) / 2)),
        actuators=actuators,
        shift=difference.shift,
    )


def _jackknife(parts: list[list[float]], least: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns standard errors (k,), at least `least`, from estimates (folds, k) that each exclude one fold."""
    return np.maximum(np.sqrt((len(parts) - 1) * np.var(np.array(parts), axis=0)), least)


@dataclass(frozen=True, eq=False)
class _Problems:
    """Least-squares problems of one link: original, weighted by actuator, and whitened by the residuals."""

    plain: PointMassProblem
    plain_weights: NDArray[np.float64]
    whitened: PointMassProblem

    @classmethod
    def of(cls, link: LinkInertia, columns: NDArray[np.float64], difference: MotionDifference) -> _Problems:
        """Creates the problems. The autoregression is fitted to the unwhitened residuals, then once more."""
        grid, n = difference.grid, difference.grid.arm.num_joints
        at_rows = np.stack([grid.at_rows(columns[:, i], i) for i in range(n)], axis=1)
        filtered = grid.filter_efforts(at_rows)[difference.rows]
        both = [np.hstack([filtered[:, i], difference.changes[:, i]]) for i in range(n)]
        problem = plain = _problem(link, both, difference, Whitening.none(n))
        body, plain_weights, _ = plain.fit()
        weights = plain_weights
        for again in range(WHITENED):
            phi, x = body.parameters, problem.nuisances(body, weights)
            left = difference.tau - np.column_stack([both[i] @ np.concatenate([phi, x[i]]) for i in range(n)])
            whitening = Whitening.of(left, AUTOREGRESSION, grid.rate, grid.settings.effort_cut_off)
            problem = _problem(link, both, difference, whitening)
            if again < WHITENED - 1:
                body, weights, _ = problem.fit(body)
        return cls(plain, plain_weights, problem)


def _problem(
    link: LinkInertia, both: list[NDArray[np.float64]], difference: MotionDifference, whitening: Whitening
) -> PointMassProblem:
    grid, rows = difference.grid, np.flatnonzero(difference.rows)[whitening.lost :]
    fold, edge = phase_folds(grid, difference.period)
    tau = np.column_stack([whitening(x, i) for i, x in enumerate(difference.tau.T)])
    size = both[0].shape[1]
    columns = ((np.arange(size), whitening(x, i)) for i, x in enumerate(both))
    equations = NormalEquations.of(columns, size, tau, fold[rows], edge[rows])
    # A low-pass filtered effort has two independent values per period of the cut-off frequency. Errors that repeat with
    # the motion have fewer, which the jackknife over the phases takes into account.
    independent = 2 * grid.settings.effort_cut_off / grid.rate
    com = link.parameters[1:4] / link.parameters[0]
    precision = np.mean(difference.changes**2, axis=0) / difference.deviation**2
    return PointMassProblem(equations, min(independent, 1.0), com, precision, len(tau))


def _in_base(arm: Arm, link: str, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a point (3,) of a link in the base frame with all joints at 0."""
    plant = shared_plant(arm)
    context = plant.CreateDefaultContext()
    for name, x in zip(arm.tree_joint_names, arm.linkage.position(np.zeros(arm.num_joints)), strict=True):
        joint = plant.GetJointByName(name)
        start = joint.position_start()
        positions = plant.GetPositions(context)
        positions[start] = x
        plant.SetPositions(context, positions)
    X_BL = plant.CalcRelativeTransform(context, plant.GetFrameByName("base_link"), plant.GetFrameByName(link))
    return np.asarray(X_BL @ place, dtype=float)
