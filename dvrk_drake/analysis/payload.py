"""What was added to an arm between two recordings of one motion: a mass, its place, and how well both are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student_t

from dvrk_drake.analysis.motion_difference import MotionDifference, motion_difference
from dvrk_drake.analysis.normal_equations import NormalEquations
from dvrk_drake.analysis.phase_folds import phase_folds
from dvrk_drake.analysis.point_mass import PointMass, PointMassProblem
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant
from dvrk_drake.models.recording import Recording

#: Of the intervals that are reported.
CONFIDENCE = 0.95
#: Links whose left-out error is within this of the best explain the recording as well.
SAME_ERROR = 1.05
#: An actuator that the payload loads by less than this share of its difference tells nothing of it.
LEAST_LOAD = 1e-6


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
    place_in_base: NDArray[np.float64]
    left_out: float
    actuators: list[PayloadActuator]
    shift: float

    @property
    def found(self) -> bool:
        """Whether the interval of the mass excludes 0."""
        return self.body.mass > self.quantile * self.mass_error

    def as_dict(self) -> dict:
        """What `payload --json` writes; coordinates that are not determined are null."""
        known = self.body.determined

        def numbers(values: NDArray[np.float64]) -> list[float | None]:
            return [float(v) if ok else None for v, ok in zip(values, known, strict=True)]

        return {
            "link": self.link,
            "mass": self.body.mass,
            "mass_standard_error": self.mass_error,
            "place_in_link": numbers(self.body.place),
            "place_standard_error": numbers(self.place_error),
            "confidence": CONFIDENCE,
            "quantile": self.quantile,
            "left_out_error": self.left_out,
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

    The standard errors are a delete-one jackknife over the folds of `phase_folds`: errors that repeat with the motion
    do not average out with its repetitions, as those of independent rows would. They are never less than independent
    rows would have.

    Args:
        reference, loaded: recordings of the same motion, without and with the payload.
        model: of the arm in the reference: it gives the shape of dry friction, and what differs since the motions do.
        links: names; all moving links by default.
        progress: called with the finished share, 0..1.

    Raises:
        RecordingError: a recording is no motion of this arm, or they are not of the same motion.
        ModelError: there is no such link.
    """
    regressor = model.regressor
    names = [link.link for link in regressor.links]
    wanted = names if links is None else list(links)
    if unknown := [link for link in wanted if link not in names]:
        raise ModelError(f'unknown link "{unknown[0]}"; links of {model.arm.name} that move: {", ".join(names)}')
    difference = motion_difference(reference, loaded, model)
    progress(0.2)
    grid = difference.grid
    Y = regressor.regressor(grid.q, grid.v, grid.vd)
    J_inverse = model.arm.transmission.inverse().matrix
    estimates = []
    for count, link in enumerate(wanted):
        k = names.index(link)
        columns = np.einsum("ji,mjp->mip", J_inverse, Y[..., 10 * k : 10 * k + 10])
        estimates.append(_estimate(regressor.links[k], columns, difference))
        progress(0.2 + 0.8 * (count + 1) / len(wanted))
    return sorted(estimates, key=lambda payload: payload.left_out)


def as_good(estimates: Sequence[Payload]) -> list[Payload]:
    """The links that the recording cannot tell from the best one."""
    return [payload for payload in estimates if payload.left_out <= SAME_ERROR * estimates[0].left_out]


def _estimate(link: LinkInertia, columns: NDArray[np.float64], difference: MotionDifference) -> Payload:
    problem = _problem(link, columns, difference)
    folds = range(problem.equations.folds)
    body, weights, errors = problem.fit()
    parts = [problem.without_fold(fold, weights, body) for fold in folds]
    jackknife = np.array([[part.mass, *part.place] for part in parts])
    spread = np.sqrt((len(folds) - 1) * np.var(jackknife, axis=0))
    spread = np.maximum(spread, errors)
    rows, arm = len(difference.tau), difference.grid.arm
    rms = np.sqrt(np.stack(problem.budget(body, weights)) / rows)
    actuators = [
        PayloadActuator(name, change, own, left, 1 - (left / change) ** 2 if own > LEAST_LOAD * change else None)
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
        quantile=float(student_t.ppf((1 + CONFIDENCE) / 2, len(folds) - 1)),
        place_in_base=_in_base(arm, link.link, body.place),
        left_out=float(np.exp(np.mean(np.log(with_it / without)) / 2)),
        actuators=actuators,
        shift=difference.shift,
    )


def _problem(link: LinkInertia, columns: NDArray[np.float64], difference: MotionDifference) -> PointMassProblem:
    grid, rows = difference.grid, difference.rows
    n = grid.arm.num_joints
    at_rows = np.stack([grid.at_rows(columns[:, i], i) for i in range(n)], axis=1)
    filtered = grid.behind_filter(at_rows)[rows]
    fold, edge = phase_folds(grid, difference.period)
    both = [np.hstack([filtered[:, i], difference.changes[:, i]]) for i in range(n)]
    equations = NormalEquations.of(both, difference.tau, fold[rows], edge[rows])
    # A low-passed effort has two independent values a period of the cut-off. What repeats with the motion has fewer:
    # the jackknife over its phases sees to that.
    independent = 2 * grid.settings.effort_cut_off / grid.rate
    com = link.parameters[1:4] / link.parameters[0]
    return PointMassProblem(equations, min(independent, 1.0), com, difference.deviation)


def _in_base(arm: Arm, link: str, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) a point of a link in the base frame with all joints at 0."""
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    for name, x in zip(arm.tree_joint_names, arm.linkage.position(np.zeros(arm.num_joints)), strict=True):
        joint = plant.GetJointByName(name)
        start = joint.position_start()
        positions = plant.GetPositions(context)
        positions[start] = x
        plant.SetPositions(context, positions)
    X_BL = plant.CalcRelativeTransform(context, plant.GetFrameByName("base_link"), plant.GetFrameByName(link))
    return np.asarray(X_BL @ place, dtype=float)
