"""Inertial parameters that a body can have, nearest to what a recording and the SDF say: a convex program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from pydrake.geometry import Role, SceneGraphInspector
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.solvers import ClarabelSolver, MathematicalProgram, MathematicalProgramResult, SolverOptions
from pydrake.symbolic import Expression
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.inertial_parameters import LinkInertia, pseudo_inertia
from dvrk_drake.errors import ArmError, IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import BoundingShapes, BoxCorners
from dvrk_drake.models.plant import add_arm
from dvrk_drake.models.sdf_model import compose_sdf


@dataclass(frozen=True, eq=False)
class BoundingBox:
    """A box along the axes of the frame of link L: `lower` and `upper` (3,) are its corners, p_LoC_L [m]."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) [m]."""
        return (self.lower + self.upper) / 2

    @property
    def half_width(self) -> NDArray[np.float64]:
        """(3,) [m]."""
        return (self.upper - self.lower) / 2


def bounding_boxes(arm: Arm) -> dict[str, BoundingBox]:
    """Link -> its box, for every link of the arm, as the `bounding_shapes` of the arm's files say.

    Raises:
        ArmError: a link that can move has neither collision shapes nor a box of its own, or a box is none.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    instance = add_arm(plant, arm)
    plant.Finalize()
    shapes = _shapes_of_links(arm)
    boxes = {}
    for body in map(plant.get_body, plant.GetBodyIndices(instance)):
        if not plant.IsAnchored(body):
            name = body.name()
            stated = shapes[name].boxes.get(name)
            if stated is None:
                boxes[name] = _around_shapes(plant, scene_graph.model_inspector(), name, shapes[name].margin)
            else:
                boxes[name] = _stated(name, stated)
    return boxes


def _shapes_of_links(arm: Arm) -> dict[str, BoundingShapes]:
    """Link -> the settings that stand beside the SDF file that it is first named in."""
    settings: dict[str, BoundingShapes] = {}
    for url, shapes in zip(arm.sdf, arm.identification.bounding_shapes, strict=True):
        names = [link.get("name", "") for link in compose_sdf([url]).iterfind("model/link")]
        if unknown := set(shapes.boxes) - set(names):
            raise ArmError(f"{arm.name}: bounding_shapes.boxes names {', '.join(sorted(unknown))}, no link of {url}")
        for name in names:
            settings.setdefault(name, shapes)
    return settings


def _around_shapes(plant: MultibodyPlant, inspector: SceneGraphInspector, link: str, margin: float) -> BoundingBox:
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName(link).index())
    for geometry in inspector.GetGeometries(frame, Role.kProximity):
        box = inspector.GetObbInGeometryFrame(geometry)
        X_LB = inspector.GetPoseInFrame(geometry) @ box.pose()
        half_width = np.abs(X_LB.rotation().matrix()) @ box.half_width()
        lower = np.minimum(lower, X_LB.translation() - half_width)
        upper = np.maximum(upper, X_LB.translation() + half_width)
    if not np.all(np.isfinite(lower)):
        raise ArmError(
            f"{link} has no <collision> in its SDF, so nothing says where its mass can be: give it a box in "
            "bounding_shapes of the arm's mechanism or instrument file"
        )
    return BoundingBox(lower - margin, upper + margin)


def _stated(link: str, corners: BoxCorners) -> BoundingBox:
    lower, upper = np.array(corners.lower, float), np.array(corners.upper, float)
    if lower.shape != (3,) or upper.shape != (3,) or not np.all(lower < upper) or not np.isfinite(upper - lower).all():
        raise ArmError(f"bounding_shapes: lower and upper of {link} must be three numbers each, lower below upper [m]")
    return BoundingBox(lower, upper)


#: Least eigenvalue of a pseudo-inertia [kg, kg m, kg m^2], unless the SDF's own link has less than four times that.
MIN_EIGENVALUE = 1e-9
#: A link's mass stays within these multiples of the SDF's.
MASS_RANGE = 0.1, 5.0
#: The sum of all links' masses stays within this share of the SDF's.
TOTAL_MASS_TOLERANCE = 0.2
#: Weight of the log-det prior, in units of one squared standard deviation; the largest that no actuator's
#: cross-validated error rises by more than a thousandth with, on the public motions.
LOG_DET_WEIGHT = 0.03
#: Relative accuracy that the solver must reach: on the public motions and simulated arms the cost is then within 0.0003
#: of the least, in units of one squared standard deviation.
_TOLERANCE = 1e-8
#: Nearer to a bound than this share of it, a parameter is at the bound.
_AT_BOUND = 1e-3
_UNITS = np.eye(10)
#: Of the way to the cones' boundary that a step may go, tried one after the other; the first is Clarabel's default.
_STEP_FRACTIONS = (0.99, 0.95, 0.9)


@dataclass(frozen=True)
class LinkScale:
    """Sizes of one link as the SDF has it: what its parameters are measured against.

    Attributes:
        mass: [kg].
        length: distance of the centre of mass from the origin plus the radius of gyration [m].
    """

    mass: float
    length: float

    @classmethod
    def of(cls, link: LinkInertia) -> LinkScale:
        """Reads the sizes."""
        m, h, moments = link.parameters[0], link.parameters[1:4], link.parameters[4:7]
        com = h / m
        gyration = float(np.sqrt(max(np.sum(moments) / (2 * m) - com @ com, 1e-12)))
        return cls(float(m), float(np.linalg.norm(com)) + gyration)

    @property
    def deviations(self) -> NDArray[np.float64]:
        """(10,) by how much a parameter may well differ from the SDF's, which is an estimate: by its own size."""
        return self.mass * np.concatenate([[1.0], np.full(3, self.length), np.full(6, self.length**2)])


def consistent_parameters(
    R: NDArray[np.float64],
    b: NDArray[np.float64],
    links: Sequence[LinkInertia],
    boxes: Mapping[str, BoundingBox],
    lower: NDArray[np.float64],
) -> NDArray[np.float64]:
    """x (p,) that minimises |R x - b|^2 / 2 + the log-det prior such that every link can exist and x >= lower.

    x starts with the ten parameters of each link. The prior of a link is LOG_DET_WEIGHT times

        trace(S0^-1 S) - log det S,    S = J - eps I,

    J its pseudo-inertia, S0 that of the SDF's: least at the SDF's, and infinite at the edge of what can exist, so
    that J - eps I is positive definite. Where R says nothing, x is the SDF's. Its mass and the mass of all are near
    the SDF's (`MASS_RANGE`, `TOTAL_MASS_TOLERANCE`), and it has a place in its bounding box (`BoundingBox`): the mean
    square distance from the box's middle is at most the half width squared along each axis, which is linear in J and
    puts the centre of mass into the box. Pseudo-inertia, and trace(J Q) >= 0 of a bounding ellipsoid, here a flat one
    an axis: Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
    identification" (2018); log-det: Lee, Wensing and Park, "Geometric robot dynamic identification" (2020).

    Args:
        R, b: (p, p) and (p,), compressed rows (e.g. the QR decomposition's) in units of their standard deviation, the
            Gaussian prior's rows included.
        links: as the SDF has them.
        boxes: link -> where its mass can be.
        lower: (p,) bounds, -inf where there is none.

    Raises:
        IdentificationError: the solver did not converge.
    """
    program = MathematicalProgram()
    # In z = R x the cost is a sphere: what motions tell differs by many decades, which no scaling of x takes away.
    z = program.NewContinuousVariables(len(b), "z")
    # With the links last, R is a triangle in which they depend on few z, which Clarabel's matrices are sparse with.
    order = np.roll(np.arange(len(b)), -10 * len(links))
    Q, triangle = np.linalg.qr(R[:, order])
    to_x = np.empty_like(R)
    to_x[order] = scipy.linalg.solve_triangular(triangle, np.eye(len(b)))
    program.AddQuadraticCost(np.eye(len(b)), -Q.T @ b, z, is_convex=True)
    bounded = np.flatnonzero(np.isfinite(lower))
    size = np.linalg.norm(to_x[bounded], axis=1)
    high = np.full(len(bounded), np.inf)
    program.AddLinearConstraint(to_x[bounded] / size[:, None], lower[bounded] / size, high, z)
    for k, link in enumerate(links):
        to_link = to_x[10 * k : 10 * k + 10]
        own = np.flatnonzero(np.any(to_link, axis=0))
        _add_prior(program, z[own], to_link[:, own], link)
        _constrain_link(program, z[own], to_link[:, own], link, boxes[link.link])
    share = TOTAL_MASS_TOLERANCE
    total = np.sum(to_x[: 10 * len(links) : 10], axis=0) / _total_mass(links)
    program.AddLinearConstraint(total[None], [1 - share], [1 + share], z)
    result = _solve(program)
    x = to_x @ np.asarray(result.GetSolution(z), dtype=float)
    # Interior-point solutions keep their inequalities to the tolerance; these are kept exactly.
    x[bounded] = np.maximum(x[bounded], lower[bounded])
    _check(x, links)
    return x


def _solve(program: MathematicalProgram) -> MathematicalProgramResult:
    """Solves to full accuracy, with shorter steps where rounding stops Clarabel's own short of it."""
    for fraction in _STEP_FRACTIONS:
        options = SolverOptions()
        options.SetOption(ClarabelSolver.id(), "max_step_fraction", fraction)
        for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
            options.SetOption(ClarabelSolver.id(), name, _TOLERANCE)
        result = ClarabelSolver().Solve(program, None, options)
        details = result.get_solver_details()
        # Drake counts what Clarabel calls AlmostSolved, at a reduced accuracy, as a success.
        if result.is_success() and details.status == "Solved":
            return result
    raise IdentificationError(
        f"the program for physically consistent parameters did not converge: Clarabel says {details.status} after "
        f"{details.iterations} iterations; are efforts and positions this arm's?"
    )


def log_det_curvature(x: NDArray[np.float64], links: Sequence[LinkInertia]) -> NDArray[np.float64]:
    """(p, p) second derivative of the log-det prior at x (p,)."""
    H = np.zeros((len(x),) * 2)
    for k, link in enumerate(links):
        chosen = slice(10 * k, 10 * k + 10)
        inverse = np.linalg.inv(pseudo_inertia(x[chosen]) - least_eigenvalue_bound(link) * np.eye(4))
        steps = np.array([inverse @ pseudo_inertia(unit) for unit in _UNITS])
        H[chosen, chosen] = LOG_DET_WEIGHT * np.einsum("iab,kba->ik", steps, steps)
    return H


def least_eigenvalue_bound(link: LinkInertia) -> float:
    """The least eigenvalue that a link's pseudo-inertia may get: `MIN_EIGENVALUE`, or a quarter of the SDF's."""
    return min(MIN_EIGENVALUE, 0.25 * float(np.linalg.eigvalsh(link.pseudo_inertia())[0]))


def room_in_box(parameters: NDArray[np.float64], box: BoundingBox) -> NDArray[np.float64]:
    """(3,) 1 - mean square distance from the middle of the box / half width^2, along each axis; negative: outside."""
    return _room(box) @ parameters / parameters[0]


def reached_bounds(parameters: NDArray[np.float64], link: LinkInertia, box: BoundingBox) -> list[str]:
    """Which bounds (10,) parameters of a link lie at, for people; empty: none."""
    bounds = [
        f"mass at {limit:g} x the SDF's"
        for limit in MASS_RANGE
        if abs(parameters[0] / link.parameters[0] - limit) < _AT_BOUND * limit
    ]
    sides = "".join(axis for axis, room in zip("xyz", room_in_box(parameters, box), strict=True) if room < _AT_BOUND)
    if sides:
        bounds.append(f"mass fills its box along {sides}")
    return bounds


def total_mass_reached(total: float, nominal: float) -> bool:
    """Whether the mass of all links [kg] lies at the edge of what the SDF's, `nominal`, allows."""
    return abs(total / nominal - 1) > TOTAL_MASS_TOLERANCE - _AT_BOUND


def _add_prior(program: MathematicalProgram, z: NDArray, to_link: NDArray[np.float64], link: LinkInertia) -> None:
    floor = least_eigenvalue_bound(link) * np.eye(4)
    # With S0 = L L', Z = L^-1 S L^-T is 1 at the SDF's, whatever the link's size; log det S differs by a constant.
    L_inverse = np.linalg.inv(np.linalg.cholesky(link.pseudo_inertia() - floor))
    units = np.array([L_inverse @ pseudo_inertia(unit) @ L_inverse.T for unit in _UNITS])
    Z = program.NewSymmetricContinuousVariables(4, "Z")
    below = np.tril_indices(4)
    entries = np.hstack([units[:, *below].T @ to_link, -np.eye(10)])
    program.AddLinearEqualityConstraint(
        entries, (L_inverse @ floor @ L_inverse.T)[below], np.concatenate([z, Z[below]])
    )
    program.AddLinearCost(np.full(4, LOG_DET_WEIGHT), np.diag(Z))
    cost, terms, _ = program.AddMaximizeLogDeterminantCost(Z.astype(Expression))
    program.RemoveCost(cost)
    program.AddLinearCost(np.full(4, -LOG_DET_WEIGHT), terms)


def _constrain_link(
    program: MathematicalProgram, z: NDArray, to_link: NDArray[np.float64], link: LinkInertia, box: BoundingBox
) -> None:
    mass = link.parameters[0]
    low, high = MASS_RANGE
    program.AddLinearConstraint(to_link[:1] / mass, [low], [high], z)
    program.AddLinearConstraint(_room(box) @ to_link / mass, np.zeros(3), np.full(3, np.inf), z)


def _room(box: BoundingBox) -> NDArray[np.float64]:
    """(3, 10) of the parameters: integral of (1 - (x - c)^2 / w^2) dm for each axis, c and w of the box."""
    units = np.array([pseudo_inertia(unit) for unit in _UNITS])
    m, h, squares = units[:, 3, 3], units[:, :3, 3].T, units[:, [0, 1, 2], [0, 1, 2]].T
    c, w = box.center[:, None], box.half_width[:, None]
    return m - (squares - 2 * c * h + c**2 * m) / w**2


def _total_mass(links: Sequence[LinkInertia]) -> float:
    return float(sum(link.parameters[0] for link in links))


def _check(x: NDArray[np.float64], links: Sequence[LinkInertia]) -> None:
    for k, link in enumerate(links):
        least = float(np.linalg.eigvalsh(pseudo_inertia(x[10 * k : 10 * k + 10]))[0])
        if least < least_eigenvalue_bound(link):
            raise IdentificationError(
                f"the program for physically consistent parameters left {link.link} with a pseudo-inertia of least "
                f"eigenvalue {least:.2g}; it must be {least_eigenvalue_bound(link):.2g} or more"
            )
