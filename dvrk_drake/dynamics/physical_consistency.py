"""Inertial parameters that a body can have, nearest to what a recording says: a convex program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram, MathematicalProgramResult, SolverOptions

from dvrk_drake.dynamics.inertial_parameters import LinkInertia, pseudo_inertia
from dvrk_drake.errors import IdentificationError

#: Least eigenvalue of a pseudo-inertia [kg, kg m, kg m^2], unless the SDF's own link has less than four times that.
LEAST_EIGENVALUE = 1e-9
#: A link's mass stays within these multiples of the SDF's.
MASS_RANGE = 0.1, 5.0
#: Its centre of mass stays in a box around the SDF's: this many radii of gyration, at least this far [m].
COM_REACH, LEAST_COM_REACH = 3.0, 0.03
#: Relative accuracy that the solver must reach.
_TOLERANCE = 1e-9
#: Of the way to the cones' boundary that a step may go, tried one after the other; the first is Clarabel's default.
_STEP_FRACTIONS = (0.99, 0.95, 0.9)


@dataclass(frozen=True)
class LinkScale:
    """Sizes of one link as the SDF has it: what its parameters are measured against.

    Attributes:
        mass: [kg].
        length: distance of the centre of mass from the origin plus the radius of gyration [m].
        com: (3,) [m].
        gyration: radius of gyration about the centre of mass [m].
    """

    mass: float
    length: float
    com: NDArray[np.float64]
    gyration: float

    @classmethod
    def of(cls, link: LinkInertia) -> LinkScale:
        """Reads the sizes."""
        m, h, moments = link.parameters[0], link.parameters[1:4], link.parameters[4:7]
        com = h / m
        gyration = float(np.sqrt(max(np.sum(moments) / (2 * m) - com @ com, 1e-12)))
        return cls(float(m), float(np.linalg.norm(com)) + gyration, com, gyration)

    @property
    def deviations(self) -> NDArray[np.float64]:
        """(10,) by how much a parameter may well differ from the SDF's, which is an estimate: by its own size."""
        return self.mass * np.concatenate([[1.0], np.full(3, self.length), np.full(6, self.length**2)])


def consistent_parameters(
    R: NDArray[np.float64],
    b: NDArray[np.float64],
    links: tuple[LinkInertia, ...],
    lower: NDArray[np.float64],
    scale: NDArray[np.float64],
) -> NDArray[np.float64]:
    """x (p,) that minimises |R x - b|^2 such that every link can exist and x >= lower.

    x starts with the ten parameters of each link. Conditions on a link: pseudo-inertia - eps I positive semidefinite,
    mass and centre of mass in a box about the SDF's (`MASS_RANGE`, `COM_REACH`). Wensing, Kim and Slotine, "Linear
    matrix inequalities for physically consistent inertial parameter identification" (2018).

    Args:
        R, b: (p, p) and (p,), compressed rows (e.g. the QR decomposition's), the prior's rows included.
        links: as the SDF has them.
        lower: (p,) bounds, -inf where there is none.
        scale: (p,) typical sizes of x, by which the program is scaled.

    Raises:
        IdentificationError: the solver did not converge.
    """
    program = MathematicalProgram()
    y = program.NewContinuousVariables(len(scale), "y")  # x = scale * y
    A = R * scale
    size = float(np.linalg.norm(b)) or 1.0
    program.Add2NormSquaredCost(A / size, b / size, y)
    bounded = np.flatnonzero(np.isfinite(lower))
    bound = lower[bounded] / scale[bounded]
    program.AddBoundingBoxConstraint(bound, np.full(len(bounded), np.inf), y[bounded])
    for k, link in enumerate(links):
        chosen = slice(10 * k, 10 * k + 10)
        _constrain_link(program, y[chosen], scale[chosen], link)
    result = _solve(program)
    x = np.asarray(result.GetSolution(y), dtype=float) * scale
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


def least_eigenvalue_bound(link: LinkInertia) -> float:
    """The least eigenvalue that a link's pseudo-inertia may get: `LEAST_EIGENVALUE`, or a quarter of the SDF's."""
    return min(LEAST_EIGENVALUE, 0.25 * float(np.linalg.eigvalsh(link.pseudo_inertia())[0]))


def _constrain_link(program: MathematicalProgram, y: NDArray, scale: NDArray[np.float64], link: LinkInertia) -> None:
    size = LinkScale.of(link)
    # A congruence keeps the sign of every eigenvalue and brings a finger's and a forearm's numbers to the same size.
    D = np.diag([1 / size.length] * 3 + [1.0]) / np.sqrt(size.mass)
    units = [scale[i] * D @ pseudo_inertia(unit) @ D for i, unit in enumerate(np.eye(10))]
    # Twice the bound: what the solver leaves of its tolerance must not go below it.
    floor = -2 * least_eigenvalue_bound(link) * D @ D
    program.AddLinearMatrixInequalityConstraint([floor, *units], y)
    low, high = (share * size.mass / scale[0] for share in MASS_RANGE)
    program.AddBoundingBoxConstraint(low, high, y[0])
    reach = max(COM_REACH * size.gyration, LEAST_COM_REACH)
    for axis in range(3):
        # m (c - reach) <= m c <= m (c + reach), linear in m and m c; divided by mass and length of the link.
        row = np.array([scale[0], scale[1 + axis]]) / (size.mass * size.length)
        for sign in (1.0, -1.0):
            edge = size.com[axis] + sign * reach
            program.AddLinearConstraint(sign * np.array([[row[0] * edge, -row[1]]]), 0.0, np.inf, y[[0, 1 + axis]])


def _check(x: NDArray[np.float64], links: tuple[LinkInertia, ...]) -> None:
    for k, link in enumerate(links):
        least = float(np.linalg.eigvalsh(pseudo_inertia(x[10 * k : 10 * k + 10]))[0])
        if least < least_eigenvalue_bound(link):
            raise IdentificationError(
                f"the program for physically consistent parameters left {link.link} with a pseudo-inertia of least "
                f"eigenvalue {least:.2g}; it must be {least_eigenvalue_bound(link):.2g} or more"
            )
