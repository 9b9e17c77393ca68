"""Estimates physically consistent inertial parameters from a recording and the SDF by convex optimization."""

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

#: Factor of the width of a bounding box that follows from the inertia in the SDF. The mass of the real link may be
#: farther out. A factor of 1 increases the error of a UR10 by a quarter, 3 changes that of four robots by at most 1 %.
WIDENING = 2.0


@dataclass(frozen=True, eq=False)
class BoundingBox:
    """Axis-aligned box in the frame of a link, given by its lower and upper corners (3,) [m]."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    @property
    def center(self) -> NDArray[np.float64]:
        """Center (3,) [m]."""
        return (self.lower + self.upper) / 2

    @property
    def half_width(self) -> NDArray[np.float64]:
        """Half of the width (3,) [m]."""
        return (self.upper - self.lower) / 2


def bounding_boxes(arm: Arm) -> dict[str, BoundingBox]:
    """Returns link -> bounding box for every moving link, according to `bounding_shapes` in the arm's files.

    A link without collision shapes gets a box `WIDENING` times as wide as one around its joints and its inertia.

    Raises:
        ArmError: A box is not valid.
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
            corners = shapes[name].boxes.get(name)
            if corners is None:
                boxes[name] = _box_around_shapes(
                    plant, scene_graph.model_inspector(), name, shapes[name].margin
                ) or _box_from_inertia(plant, name, shapes[name].margin)
            else:
                boxes[name] = _box_from_corners(name, corners)
    return boxes


def _shapes_of_links(arm: Arm) -> dict[str, BoundingShapes]:
    """Returns link -> bounding-box settings for the first SDF file that contains this link."""
    settings: dict[str, BoundingShapes] = {}
    for url, shapes in zip(arm.sdf, arm.identification.bounding_shapes, strict=True):
        names = [link.get("name", "") for link in compose_sdf([url]).iterfind("model/link")]
        if unknown := set(shapes.boxes) - set(names):
            raise ArmError(f"{arm.name}: bounding_shapes.boxes: {url} has no link {', '.join(sorted(unknown))}")
        for name in names:
            settings.setdefault(name, shapes)
    return settings


def _box_around_shapes(
    plant: MultibodyPlant, inspector: SceneGraphInspector, link: str, margin: float
) -> BoundingBox | None:
    """Returns the box around the collision shapes of a link with a margin [m], None if it has no shapes."""
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName(link).index())
    for geometry in inspector.GetGeometries(frame, Role.kProximity):
        box = inspector.GetObbInGeometryFrame(geometry)
        X_LB = inspector.GetPoseInFrame(geometry) @ box.pose()
        half_width = np.abs(X_LB.rotation().matrix()) @ box.half_width()
        lower = np.minimum(lower, X_LB.translation() - half_width)
        upper = np.maximum(upper, X_LB.translation() + half_width)
    return BoundingBox(lower - margin, upper + margin) if np.all(np.isfinite(lower)) else None


def _box_from_inertia(plant: MultibodyPlant, link: str, margin: float) -> BoundingBox:
    """Returns a box around the joints of a link and around a solid box with its inertia, with a margin [m], widened.

    The moments of a solid box with the half widths w about its centre of mass are m w^2 / 3.
    """
    body = plant.GetBodyByName(link)
    M_LLo_L = body.default_spatial_inertia()
    p_LoLcm_L = M_LLo_L.get_com()
    G = M_LLo_L.Shift(p_LoLcm_L).get_unit_inertia().CopyToFullMatrix3()
    half_width = np.sqrt(3 * (np.trace(G) / 2 - np.diag(G)))
    joints = map(plant.get_joint, plant.GetJointIndices())
    ends = [j.frame_on_parent().GetFixedPoseInBodyFrame().translation() for j in joints if j.parent_body() is body]
    points = np.array([np.zeros(3), p_LoLcm_L - half_width, p_LoLcm_L + half_width, *ends])
    box = BoundingBox(points.min(axis=0) - margin, points.max(axis=0) + margin)
    return BoundingBox(box.center - WIDENING * box.half_width, box.center + WIDENING * box.half_width)


def _box_from_corners(link: str, corners: BoxCorners) -> BoundingBox:
    lower, upper = np.array(corners.lower, float), np.array(corners.upper, float)
    if lower.shape != (3,) or upper.shape != (3,) or not np.all(lower < upper) or not np.isfinite(upper - lower).all():
        raise ArmError(f"bounding_shapes: lower and upper of {link} must be three numbers each [m], with lower < upper")
    return BoundingBox(lower, upper)


#: Lower bound on the eigenvalues of a pseudo-inertia [kg, kg m, kg m^2]. The bound is lower for a link whose smallest
#: eigenvalue in the SDF is less than four times this value (see `least_eigenvalue_bound`). Half or twice the value
#: changes the errors of the public motions `mtm_one` and `psm_one` by less than 0.02 percentage points.
MIN_EIGENVALUE = 1e-9
#: Lower and upper bounds of the mass of a link, as multiples of its mass in the SDF. The lower bound is also that of a
#: rotor inertia. Half or twice these bounds change the errors of the public motions `mtm_one` and `psm_one` by at most
#: 0.01 percentage points.
MASS_RANGE = 0.1, 5.0
#: Largest change of the total mass of all links, as a share of the total mass in the SDF. Half or twice the value
#: changes the errors of the public motions `mtm_one` and `psm_one` by at most 0.001 percentage points.
TOTAL_MASS_TOLERANCE = 0.2
#: Weight of the log-det prior, in units of one squared standard deviation. On the public motions, it is the largest
#: weight that increases the cross-validated error of each actuator by at most 0.1 %.
LOG_DET_WEIGHT = 0.03
#: Required relative accuracy of the solver. On the public motions and simulated arms, the cost is then within 0.0003 of
#: the minimum, in units of one squared standard deviation.
_TOLERANCE = 1e-8
#: Relative distance to a bound below which a parameter is considered to be at the bound. Half or twice the value
#: reports the same bounds for the public motions `mtm_one` and `psm_one`.
_AT_BOUND = 1e-3
_UNITS = np.eye(10)
#: Maximum steps of the solver, as fractions of the distance to the cone boundary. The values are tried in this order.
#: The first is the default of Clarabel.
_STEP_FRACTIONS = (0.99, 0.95, 0.9)


@dataclass(frozen=True)
class LinkScale:
    """Mass and length of one link in the SDF that define the scale of its inertial parameters.

    Attributes:
        mass: Mass [kg].
        length: Distance of the centre of mass from the origin of the link, plus the radius of gyration [m].
    """

    mass: float
    length: float

    @classmethod
    def of(cls, link: LinkInertia) -> LinkScale:
        """Returns the scale of `link`."""
        m, h, moments = link.parameters[0], link.parameters[1:4], link.parameters[4:7]
        com = h / m
        gyration = float(np.sqrt(max(np.sum(moments) / (2 * m) - com @ com, 1e-12)))
        return cls(float(m), float(np.linalg.norm(com)) + gyration)

    @property
    def deviations(self) -> NDArray[np.float64]:
        """Scales (10,) of the inertial parameters, which are proportional to the prior standard deviations."""
        return self.mass * np.concatenate([[1.0], np.full(3, self.length), np.full(6, self.length**2)])


def consistent_parameters(
    R: NDArray[np.float64],
    b: NDArray[np.float64],
    links: Sequence[LinkInertia],
    boxes: Mapping[str, BoundingBox],
    lower: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns x (p,) that minimizes |R x - b|^2 / 2 + log-det prior, subject to physical consistency and x >= lower.

    x starts with the ten parameters of each link. The prior of a link is LOG_DET_WEIGHT times

        trace(S0^-1 S) - log det S,    S = J - eps I,

    where J is the pseudo-inertia of the link, S0 is S for the link of the SDF, and eps is `least_eigenvalue_bound`. The
    prior has its minimum at the parameters of the SDF. The prior is infinite on the boundary of the consistent
    parameters, so J - eps I is positive definite. Parameters that R does not determine have the values of the SDF.

    The mass of each link and the total mass are bounded relative to the SDF (`MASS_RANGE`, `TOTAL_MASS_TOLERANCE`).
    The mass of a link must fit into its bounding box (`BoundingBox`). This means that along each axis, the mean square
    distance of the mass from the center of the box is at most the squared half width. This constraint is linear in J
    and implies that the centre of mass is inside the box.

    Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter identification"
    (2018) describe the pseudo-inertia and the constraint trace(J Q) >= 0 of a bounding ellipsoid. Here, one degenerate
    ellipsoid is used for each axis. Lee, Wensing and Park, "Geometric robot dynamic identification" (2020) describe the
    log-det prior.

    Args:
        R, b: Compressed regressor (p, p) and efforts (p,), e.g. from a QR decomposition, in units of the standard
            deviation of the efforts. Both include the rows of the Gaussian prior.
        links: Links of the SDF.
        boxes: Link -> bounding box of its mass.
        lower: Lower bounds (p,), -inf for unbounded parameters.

    Raises:
        IdentificationError: The solver did not converge.
    """
    program = MathematicalProgram()
    # As a function of z = R x, the cost is isotropic. As a function of x, the curvature of the cost would vary by many
    # orders of magnitude, even after scaling.
    z = program.NewContinuousVariables(len(b), "z")
    # If the links are last, each link parameter depends on few elements of z, so Clarabel's matrices are sparse.
    order = np.roll(np.arange(len(b)), -10 * len(links))
    Q, triangle = np.linalg.qr(R[:, order])
    to_x = np.empty_like(R)
    to_x[order] = scipy.linalg.solve_triangular(triangle, np.eye(len(b)))
    program.AddQuadraticCost(np.eye(len(b)), -Q.T @ b, z, is_convex=True)
    bounded = np.flatnonzero(np.isfinite(lower))
    size = np.linalg.norm(to_x[bounded], axis=1)
    upper = np.full(len(bounded), np.inf)
    program.AddLinearConstraint(to_x[bounded] / size[:, None], lower[bounded] / size, upper, z)
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
    # Interior-point solutions satisfy inequalities to within the tolerance. The lower bounds are enforced exactly.
    x[bounded] = np.maximum(x[bounded], lower[bounded])
    _check(x, links)
    return x


def _solve(program: MathematicalProgram) -> MathematicalProgramResult:
    """Solves the program to full accuracy.

    If rounding errors prevent convergence, the program is solved again with shorter steps.
    """
    for fraction in _STEP_FRACTIONS:
        options = SolverOptions()
        options.SetOption(ClarabelSolver.id(), "max_step_fraction", fraction)
        for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
            options.SetOption(ClarabelSolver.id(), name, _TOLERANCE)
        result = ClarabelSolver().Solve(program, None, options)
        details = result.get_solver_details()
        # Drake also reports success for AlmostSolved, which has reduced accuracy.
        if result.is_success() and details.status == "Solved":
            return result
    raise IdentificationError(
        f"the identification did not converge (Clarabel: {details.status} after {details.iterations} iterations). "
        "Usual causes: efforts of another arm, wrong units, or exchanged channels. Run: dvrk-drake check RECORDING"
    )


def log_det_curvature(x: NDArray[np.float64], links: Sequence[LinkInertia]) -> NDArray[np.float64]:
    """Returns the Hessian (p, p) of the log-det prior at x (p,)."""
    H = np.zeros((len(x),) * 2)
    for k, link in enumerate(links):
        chosen = slice(10 * k, 10 * k + 10)
        inverse = np.linalg.inv(pseudo_inertia(x[chosen]) - least_eigenvalue_bound(link) * np.eye(4))
        steps = np.array([inverse @ pseudo_inertia(unit) for unit in _UNITS])
        H[chosen, chosen] = LOG_DET_WEIGHT * np.einsum("iab,kba->ik", steps, steps)
    return H


def least_eigenvalue_bound(link: LinkInertia) -> float:
    """Returns the lower bound on the eigenvalues of a link's pseudo-inertia.

    The bound is the smaller of `MIN_EIGENVALUE` and a quarter of the smallest eigenvalue in the SDF.
    """
    return min(MIN_EIGENVALUE, 0.25 * float(np.linalg.eigvalsh(link.pseudo_inertia())[0]))


def box_margins(parameters: NDArray[np.float64], box: BoundingBox) -> NDArray[np.float64]:
    """Returns 1 - (mean square distance from the center of the box) / (half width)^2 for each axis (3,).

    A negative value means that the mass does not fit into the box.
    """
    return _margin_matrix(box) @ parameters / parameters[0]


def reached_bounds(parameters: NDArray[np.float64], link: LinkInertia, box: BoundingBox) -> list[str]:
    """Returns a description of each bound that the parameters (10,) of a link have reached."""
    bounds = [
        f"mass is {limit:g} x the mass in the SDF"
        for limit in MASS_RANGE
        if abs(parameters[0] / link.parameters[0] - limit) < _AT_BOUND * limit
    ]
    sides = "".join(
        axis for axis, margin in zip("xyz", box_margins(parameters, box), strict=True) if margin < _AT_BOUND
    )
    if sides:
        bounds.append(f"mass reaches its bounding box along {sides}")
    return bounds


def _add_prior(program: MathematicalProgram, z: NDArray, to_link: NDArray[np.float64], link: LinkInertia) -> None:
    floor = least_eigenvalue_bound(link) * np.eye(4)
    # With S0 = L L', Z = L^-1 S L^-T is the identity matrix for S = S0. log det Z differs from log det S only by a
    # constant.
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
    lower_ratio, upper_ratio = MASS_RANGE
    program.AddLinearConstraint(to_link[:1] / mass, [lower_ratio], [upper_ratio], z)
    program.AddLinearConstraint(_margin_matrix(box) @ to_link / mass, np.zeros(3), np.full(3, np.inf), z)


def _margin_matrix(box: BoundingBox) -> NDArray[np.float64]:
    """Returns a matrix (3, 10) that maps parameters to the integrals of 1 - (x - c)^2 / w^2 over the mass.

    There is one integral for each axis x of the box. c is the center and w the half width of the box.
    """
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
                f"the identified inertia of {link.link} is not physically consistent: the smallest eigenvalue of its "
                f"pseudo-inertia is {least:.2g}, but must be {least_eigenvalue_bound(link):.2g} or more"
            )
