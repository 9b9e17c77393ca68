"""What was added to an arm between two recordings of one motion: a mass, its place, and how well both are known."""

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

#: Of the intervals that are reported.
CONFIDENCE = 0.95
#: Links whose left-out error is within this of the best explain the recording as well.
SAME_ERROR = 1.05
#: Two recordings whose efforts differ by less than this share of them are one.
MIN_DIFFERENCE = 1e-6
#: Order of the autoregression that whitens the errors, and how often it is fitted.
AUTOREGRESSION, WHITENED = 2, 2
#: An actuator that the payload loads by less than this share of its difference tells nothing of it.
MIN_LOAD = 1e-6


@dataclass(frozen=True)
class PayloadActuator:
    """One actuator: RMS efforts behind the low-pass [N m, N].

    Attributes:
        name: of the joint whose actuator it is.
        change: what the recordings differ by.
        payload: what the payload takes of it.
        left: what neither the payload nor changes of the drive explain.
        explained: 1 - left^2 / change^2; None where the payload does not load the actuator.
    """

    name: str
    change: float
    payload: float
    left: float
    explained: float | None


@dataclass(frozen=True, eq=False)
class Payload:
    """A point mass on a link.

    Attributes:
        link: which carries it.
        body: mass [kg] and place in the link's frame [m].
        mass_error: standard error [kg].
        place_error: (3,) standard errors [m], nan where the motion does not determine the coordinate.
        quantile: so many standard errors either way are the interval of `CONFIDENCE`.
        largest_at_com: upper end of the interval of a mass that is at the link's own centre of mass [kg].
        place_in_base: (3,) the place in the base frame with all joints at 0 [m].
        left_out: RMS error of phases that are predicted from the others, as a share of the error without a payload;
            geometric mean over the actuators.
        actuators: in the arm's order.
        shift: of the two recordings [s].
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
        """Whether the interval of the mass excludes 0."""
        return self.body.mass > self.quantile * self.mass_error

    def as_dict(self, estimates: Sequence[Payload] = ()) -> dict:
        """Returns the entry of `payload --json`; coordinates that are not determined are null.

        Args:
            estimates: of all links, for a comparison. No bound of the mass is stated where another link shows one.
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
    """The point mass on each of some links that explains best what changed from the reference, best link first.

    The efforts' difference is explained, actuator by actuator, by the regressor's ten columns of the link with the
    parameters of a point mass, and by what may have changed in the drives (`MotionDifference.changes`). That a weight
    is small beside its distance from the joints' axes is what tells mass from place on a link that turns about a fixed
    point: there only m p and the inertia m p p' show.

    What is left is whitened, actuator by actuator (`Whitening`): offsets, friction and cables err slowly, while inertia
    shows in the fast parts of a motion. The standard errors are a delete-one jackknife over the folds of `phase_folds`:
    errors that repeat with the motion do not average out with its repetitions, as those of independent rows would. They
    are never less than independent rows would have.

    Args:
        reference, loaded: recordings of the same motion, without and with the payload.
        model: of the arm in the reference: it gives the shape of dry friction, and what differs since the motions do.
        links: names; all moving links by default.
        progress: called with the finished share, 0..1.

    Raises:
        RecordingError: a recording is no motion of this arm, they are not of the same motion, or they are the same.
        ModelError: there is no such link.
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
            f"{loaded.source or 'recording'}: shows no difference from the reference: they are the same recording"
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
        payload: on the named link, or on the one that explains the change best.
        estimates: on each moving link, best first.
        model: of the arm without the payload.
        warnings: another link explains the change better, and what was found in the recordings.
        link: the named one, or None.
    """

    payload: Payload
    estimates: list[Payload]
    model: IdentifiedModel
    warnings: tuple[Finding, ...] = ()
    link: str | None = None

    def as_dicts(self) -> list[dict]:
        """Returns what `payload --json` writes: the payload on the named link, or on every link."""
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
    """Checks two recordings of one motion and estimates what was added to the arm: what `dvrk-drake payload` does.

    Args:
        reference, loaded: motions with efforts (m, n), without and with the payload.
        model: identified from a motion of the arm without the payload; or the arm: its model is then identified from
            `reference`.
        link: of the SDF that carries the payload; None for the one that explains the change best.
        progress: called with the step, "checking the recording", "identifying" or "estimating", and its finished share
            0..1.

    Returns:
        Mass [kg] and place [m] with standard errors as `payload`, the same on each link as `estimates`, and `warnings`.

    Raises:
        RecordingError: `check` refuses a recording, or the two are not of one motion: see `findings` of the error.
        ModelError: the model has no dynamics, or there is no such link.
        IdentificationError: `reference` does not determine the arm's model.

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
    """Raises ModelError unless links of these names move; before a model is identified for nothing."""
    names = [link.link for link in regressor.links]
    if unknown := [link for link in links if link not in names]:
        raise ModelError(f'unknown link "{unknown[0]}"; links of {regressor.arm.name} that move: {", ".join(names)}')


def as_good(estimates: Sequence[Payload]) -> list[Payload]:
    """The links that the recording cannot tell from the best one."""
    return [payload for payload in estimates if payload.left_out <= SAME_ERROR * estimates[0].left_out]


def better_links(payload: Payload, estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the links that explain the change clearly better than `payload` does, best first."""
    return [other for other in estimates if SAME_ERROR * other.left_out < payload.left_out]


def better_link_warnings(payload: Payload, estimates: Sequence[Payload]) -> tuple[Finding, ...]:
    """Returns a warning that names the links that explain the change better than that of `payload`, if any do."""
    better = better_links(payload, estimates)
    if not better:
        return ()
    first = better[0]
    same = [other.link for other in as_good(estimates)]
    mass = f", {first.body.mass:.3g} +- {first.mass_error:.2g} kg" if first.found else ""
    what = (
        f"does not explain the change best: left-out error {payload.left_out:.1%}, but {first.left_out:.1%} with a "
        f"payload on {' or '.join(same)}{mass}"
    )
    advice = f"use this result only if the payload is certainly on {payload.link}; else repeat with --link {first.link}"
    return (Finding("warning", "other link", payload.link, what, advice),)


def shown_elsewhere(payload: Payload, estimates: Sequence[Payload]) -> list[Payload]:
    """Returns the links that contradict "no payload" on the link of `payload`, best first.

    These explain the change clearly better, or a mass was found on them that predicts phases not used for its fit.
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
    """Standard errors (k,) from estimates (folds, k) that leave one fold out each, not below `least`."""
    return np.maximum(np.sqrt((len(parts) - 1) * np.var(np.array(parts), axis=0)), least)


@dataclass(frozen=True, eq=False)
class _Problems:
    """The problem of one link: as the rows are, with its actuators' weights, and with what it leaves made white."""

    plain: PointMassProblem
    plain_weights: NDArray[np.float64]
    whitened: PointMassProblem

    @classmethod
    def of(cls, link: LinkInertia, columns: NDArray[np.float64], difference: MotionDifference) -> _Problems:
        """The errors' autoregression is that of what the problem, not yet whitened, leaves; then once more."""
        grid, n = difference.grid, difference.grid.arm.num_joints
        at_rows = np.stack([grid.at_rows(columns[:, i], i) for i in range(n)], axis=1)
        filtered = grid.behind_filter(at_rows)[difference.rows]
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
    # A low-passed effort has two independent values a period of the cut-off. What repeats with the motion has fewer:
    # the jackknife over its phases sees to that.
    independent = 2 * grid.settings.effort_cut_off / grid.rate
    com = link.parameters[1:4] / link.parameters[0]
    precision = np.mean(difference.changes**2, axis=0) / difference.deviation**2
    return PointMassProblem(equations, min(independent, 1.0), com, precision, len(tau))


def _in_base(arm: Arm, link: str, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) a point of a link in the base frame with all joints at 0."""
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
