"""Links that can exist and have given gravity base parameters: those nearest to the arm's SDF."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import (
    LinkInertia,
    parameters_from_pseudo_inertia,
)
from dvrk_drake.dynamics.static_model import compile_static_model
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant

#: Least eigenvalue of a link's pseudo-inertia, as a share of that of the SDF's link in all directions.
LEAST_SHARE = 0.01
#: Change of Z below which a link has not moved.
_ROUNDING = 1e-7
_UPPER = [(i, k) for i in range(4) for k in range(i, 4)]


def nearest_links(arm: Arm, base_values: ArrayLike) -> tuple[LinkInertia, ...]:
    """Links of which the gravity torque is Y(q) beta, as near to the SDF's as bodies can be.

    With the SDF's pseudo-inertia J0 = L L' of a link, Z = L^-1 J L^-T is 1 where nothing changes, whatever the link's
    size: the distance is the sum of |Z - 1|^2 (Frobenius) over the links, under Z > LEAST_SHARE and the linear
    equations of the gravity torque. Distance and condition do not depend on frames or units (Lee, Wensing, Park,
    "Geometric robot dynamic identification", 2020: its second-order approximation at J0).

    Args:
        arm: the arm.
        base_values: (b,) values of `derive_gravity(arm).base`.

    Raises:
        ModelError: no bodies have these base parameters, or the solver did not converge.
    """
    regressor = DynamicRegressor(arm)
    # phi of a link as a linear function of the ten numbers z of its Z; a rotor stays as it is.
    maps = {i: _map(link) for i, link in enumerate(regressor.links) if not _is_rotor(arm, link.link)}
    A, b = _equations(regressor, maps, np.asarray(base_values, dtype=np.float64))
    z = _nearest(A, b)
    if _least_eigenvalue(z) < LEAST_SHARE:
        z = _nearest_body(A, b)
    z = _polished(A, b, z)
    if _least_eigenvalue(z) < LEAST_SHARE / 2:
        raise ModelError(f"{arm.name}: no bodies were found that have these base parameters")
    links = list(regressor.links)
    for (i, T), part in zip(maps.items(), z.reshape(-1, 10), strict=True):
        links[i] = LinkInertia(links[i].link, T @ part)
    return tuple(links)


def _map(link: LinkInertia) -> NDArray[np.float64]:
    L = np.linalg.cholesky(link.pseudo_inertia())
    return np.column_stack([parameters_from_pseudo_inertia(L @ _symmetric(e) @ L.T) for e in np.eye(10)])


def _is_rotor(arm: Arm, link: str) -> bool:
    """Links without a frame dh_<name> are centred on their axis, see `derive_gravity`, and must stay so."""
    plant = _plant(arm)
    frames = map(plant.get_frame, plant.GetFrameIndices(plant.GetBodyByName(link).model_instance()))
    return not any(f.name().startswith("dh_") and f.body().name() == link for f in frames)


@cache
def _plant(arm: Arm) -> MultibodyPlant:
    return make_arm_plant(arm)


def _equations(
    regressor: DynamicRegressor, maps: dict[int, NDArray[np.float64]], base_values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A z = b: as many independent rows as there are base parameters, from random poses beyond the joint box."""
    arm = regressor.arm
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (60, arm.num_joints))
    Y = regressor.regressor(q, np.zeros_like(q), np.zeros_like(q))
    Y = Y.reshape(-1, Y.shape[2])
    fixed = np.repeat([i not in maps for i in range(len(regressor.links))], 10)
    fixed = np.append(fixed, np.zeros(len(regressor.rotors), dtype=bool))
    tau = (compile_static_model(arm).regressor(q) @ base_values).ravel() - Y[:, fixed] @ regressor.values[fixed]
    A = np.hstack([Y[:, 10 * i : 10 * i + 10] @ T for i, T in maps.items()])
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    rank = int(np.sum(s > 1e-9 * s[0]))
    # Rows of unit size, so that the solver's tolerance is one of torques of each kind alike.
    return Vt[:rank], (U[:, :rank].T @ tau) / s[:rank]


def _weights(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights of the squares in |Z - 1|^2, where entries off the diagonal count twice, and the entries of 1."""
    diagonal = np.array([i == k for i, k in _UPPER])
    return np.tile(np.where(diagonal, 1.0, 2.0), count), np.tile(diagonal.astype(float), count)


def _nearest(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest z of the equations alone; links that they do not concern stay exactly as they are."""
    weights, target = _weights(A.shape[1] // 10)
    step = np.linalg.lstsq(A / np.sqrt(weights), b - A @ target, rcond=None)[0]
    return target + step / np.sqrt(weights)


def _nearest_body(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest z of which all Z exceed LEAST_SHARE."""
    weights, target = _weights(A.shape[1] // 10)
    program = MathematicalProgram()
    z = program.NewContinuousVariables(len(weights), "z")
    program.AddQuadraticCost(2 * np.diag(weights), -2 * weights * target, z, is_convex=True)
    program.AddLinearEqualityConstraint(A, b, z)
    for link in z.reshape(-1, 10):
        shifted = [variable - LEAST_SHARE * (i == k) for variable, (i, k) in zip(link, _UPPER, strict=True)]
        program.AddPositiveSemidefiniteConstraint(_symmetric(np.array(shifted, dtype=object)))
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        raise ModelError(f"no bodies were found that have these base parameters: {result.get_solution_result().name}")
    return np.asarray(result.GetSolution(z))


def _polished(A: NDArray[np.float64], b: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """z with links that only rounding moved put back, and the equations met to machine precision by the others.

    Clarabel meets them to 1e-8; this last step is far smaller than the distance from the cone's edge.
    """
    _, target = _weights(A.shape[1] // 10)
    moved = np.repeat(np.abs(z - target).reshape(-1, 10).max(axis=1) > _ROUNDING, 10)
    z = np.where(moved, z, target)
    z[moved] -= np.linalg.lstsq(A[:, moved], A @ z - b, rcond=None)[0]
    return z


def _least_eigenvalue(z: NDArray[np.float64]) -> float:
    return min(float(np.linalg.eigvalsh(_symmetric(part))[0]) for part in z.reshape(-1, 10))


def _symmetric(z: NDArray) -> NDArray:
    """(4, 4) of its ten numbers or variables, row by row from the diagonal on."""
    Z = np.empty((4, 4), dtype=z.dtype)
    for (i, k), value in zip(_UPPER, z, strict=True):
        Z[i, k] = Z[k, i] = value
    return Z
