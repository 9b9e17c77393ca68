"""Computes inertial parameters of links and rotors from an identified model, for use in a simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import (
    LinkInertia,
    parameters_from_pseudo_inertia,
    rotor_links,
)
from dvrk_drake.dynamics.kinematic_tree import KinematicTree
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import shared_plant

#: Lower bound on the eigenvalues of Z, the pseudo-inertia of a link relative to the pseudo-inertia in the SDF (see
#: `nearest_links`). Without it, the nearest links would be at the boundary of the consistent parameters, where rounding
#: errors make an inertia inconsistent.
MIN_EIGENVALUE_RATIO = 0.01
#: Largest change of an element of Z that is considered a rounding error: ten times the tolerance of Clarabel (1e-8).
_ROUNDING = 1e-7
_UPPER = [(i, k) for i in range(4) for k in range(i, 4)]


def nearest_links(arm: Arm, base_values: ArrayLike) -> tuple[LinkInertia, ...]:
    """Returns the physically consistent links that have the given base parameters and are nearest to the SDF.

    Z = L^-1 J L^-T is the pseudo-inertia J of a link relative to the pseudo-inertia J0 = L L' in the SDF. Z is the
    identity matrix for a link with J = J0. The distance to the SDF is the sum of |Z - 1|^2 (Frobenius norm)
    over the links. This distance is minimized subject to the linear equations of the gravity torque. All eigenvalues of
    Z must be at least MIN_EIGENVALUE_RATIO. The distance and the constraints do not depend on frames or units. The
    distance is a second-order approximation at J0 of the distance defined by Lee, Wensing and Park, "Geometric robot
    dynamic identification" (2020).

    Args:
        arm: Arm of the links.
        base_values: Values (b,) of the base parameters `gravity_parameters(arm).base`.

    Raises:
        ModelError: No physically consistent links have these base parameters, or the solver did not converge.
    """
    regressor = DynamicRegressor(arm)
    # The parameters phi of a link are a linear function of the ten elements z of Z. Balanced rotors are not changed.
    rotors = rotor_links(arm)
    maps = {i: _parameter_map(link) for i, link in enumerate(regressor.links) if link.link not in rotors}
    A, b = _equations(regressor, maps, np.asarray(base_values, dtype=np.float64))
    z = _nearest(A, b)
    if _least_eigenvalue(z) < MIN_EIGENVALUE_RATIO:
        z = _nearest_consistent(A, b)
    z = _refine(A, b, z)
    if _least_eigenvalue(z) < MIN_EIGENVALUE_RATIO / 2:
        raise ModelError(f"{arm.name}: no physically consistent links have these base parameters")
    links = list(regressor.links)
    for (i, T), part in zip(maps.items(), z.reshape(-1, 10), strict=True):
        links[i] = LinkInertia(links[i].link, T @ part)
    return tuple(links)


def _parameter_map(link: LinkInertia) -> NDArray[np.float64]:
    L = np.linalg.cholesky(link.pseudo_inertia())
    return np.column_stack([parameters_from_pseudo_inertia(L @ _symmetric(e) @ L.T) for e in np.eye(10)])


def _equations(
    regressor: DynamicRegressor, maps: dict[int, NDArray[np.float64]], base_values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns A and b of the equations A z = b, with one independent row per base parameter.

    The equations are derived from random poses, which are not restricted to the joint limits.
    """
    arm = regressor.arm
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (60, arm.num_joints))
    Y = regressor.regressor(q, np.zeros_like(q), np.zeros_like(q))
    Y = Y.reshape(-1, Y.shape[2])
    fixed = np.repeat([i not in maps for i in range(len(regressor.links))], 10)
    fixed = np.append(fixed, np.zeros(len(regressor.rotors), dtype=bool))
    tau = (static_model(arm).regressor(q) @ base_values).ravel() - Y[:, fixed] @ regressor.values[fixed]
    A = np.hstack([Y[:, 10 * i : 10 * i + 10] @ T for i, T in maps.items()])
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    rank = int(np.sum(s > 1e-9 * s[0]))
    # The rows have unit norm, so that the tolerance of the solver has the same effect on all torques.
    return Vt[:rank], (U[:, :rank].T @ tau) / s[:rank]


def _weights(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the weights of the squared elements of z in |Z - 1|^2, and the elements of the identity matrix.

    Off-diagonal elements have weight 2, because z contains only the upper triangle of Z.
    """
    diagonal = np.array([i == k for i, k in _UPPER])
    return np.tile(np.where(diagonal, 1.0, 2.0), count), np.tile(diagonal.astype(float), count)


def _nearest(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the nearest z that satisfies the equations. Links that the equations do not affect remain unchanged."""
    weights, target = _weights(A.shape[1] // 10)
    step = np.linalg.lstsq(A / np.sqrt(weights), b - A @ target, rcond=None)[0]
    return target + step / np.sqrt(weights)


def _nearest_consistent(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the nearest z for which the eigenvalues of all Z are at least MIN_EIGENVALUE_RATIO."""
    weights, target = _weights(A.shape[1] // 10)
    program = MathematicalProgram()
    z = program.NewContinuousVariables(len(weights), "z")
    program.AddQuadraticCost(2 * np.diag(weights), -2 * weights * target, z, is_convex=True)
    program.AddLinearEqualityConstraint(A, b, z)
    for link in z.reshape(-1, 10):
        shifted = [variable - MIN_EIGENVALUE_RATIO * (i == k) for variable, (i, k) in zip(link, _UPPER, strict=True)]
        program.AddPositiveSemidefiniteConstraint(_symmetric(np.array(shifted, dtype=object)))
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        status = result.get_solution_result().name
        raise ModelError(f"found no physically consistent links with these base parameters (Clarabel: {status})")
    return np.asarray(result.GetSolution(z))


def _refine(A: NDArray[np.float64], b: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Resets links that changed only by rounding errors, and corrects the other links to satisfy A z = b.

    Clarabel satisfies the equations to 1e-8, and the correction satisfies them to machine precision. The correction is
    much smaller than the distance of Z to the boundary of the positive semidefinite cone.
    """
    _, target = _weights(A.shape[1] // 10)
    changed = np.repeat(np.abs(z - target).reshape(-1, 10).max(axis=1) > _ROUNDING, 10)
    z = np.where(changed, z, target)
    z[changed] -= np.linalg.lstsq(A[:, changed], A @ z - b, rcond=None)[0]
    return z


def _least_eigenvalue(z: NDArray[np.float64]) -> float:
    return min(float(np.linalg.eigvalsh(_symmetric(part))[0]) for part in z.reshape(-1, 10))


def _symmetric(z: NDArray) -> NDArray:
    """Returns the symmetric matrix (4, 4) with upper triangle `z` (10,), row by row."""
    Z = np.empty((4, 4), dtype=z.dtype)
    for (i, k), value in zip(_UPPER, z, strict=True):
        Z[i, k] = Z[k, i] = value
    return Z


@dataclass(frozen=True, eq=False)
class ModelBodies:
    """Parts of an identified model that a simulator can represent.

    Attributes:
        links: All moving links. A rotor that rotates with a link is part of this link, as in the SDF.
        rotors: Joint -> reflected rotor inertia [kg m^2; kg for a prismatic joint]. If it is empty, the rotor inertias
            of the SDF apply.
        motors: Actuator -> inertia of its rotor [kg m^2, kg], for rotors that no link contains, from which `rotors`
            follow. Formats with coupled rotors need no `rotors`. Empty if the rotor inertias of the SDF apply.
        left_out: Descriptions of the terms of the model's torque that an SDF does not represent, by their kind:
            "effects", "scale", "gravity", "drives" or "rotors".
    """

    links: tuple[LinkInertia, ...]
    rotors: dict[str, float]
    motors: dict[str, float]
    left_out: dict[str, str]


def model_bodies(model: IdentifiedModel) -> ModelBodies:
    """Returns the links and rotors of a model.

    A static model contains only base parameters of gravity. For a static model, the links are the result of
    `nearest_links` for these base parameters.

    Raises:
        ModelError: No physically consistent links have these base parameters.
    """
    arm = model.arm
    left_out = _static_effects(model)
    # Simulators that load a file have this gravity vector by default.
    if not np.allclose(arm.gravity, [0.0, 0.0, -9.81], rtol=0, atol=0.02):
        gravity = ", ".join(f"{x:.3f}" for x in arm.gravity)
        left_out["gravity"] = (
            f"gravity ({gravity}) m/s^2 in the base frame; set this vector in the simulator that loads the file"
        )
    if model.dynamics is None:
        base_values = np.array([p.value for p in model.base_parameters])
        return ModelBodies(nearest_links(arm, base_values), {}, {}, left_out)
    if effects := model.dynamics.effects:
        coordinates = dict.fromkeys(effect.coordinate for effect in effects)
        left_out["drives"] = f"{len(effects)} drive effects (friction, cables, springs) along {', '.join(coordinates)}"
    links = {link.link: np.array(link.parameters) for link in model.dynamics.links}
    rotors, motors, couplings = _assign_rotors(arm, links, [rotor.value for rotor in model.dynamics.rotors])
    if couplings:
        left_out["rotors"] = f"rotor inertias that couple joints, largest element [kg m^2]: {', '.join(couplings)}"
    return ModelBodies(tuple(LinkInertia(name, phi) for name, phi in links.items()), rotors, motors, left_out)


def _static_effects(model: IdentifiedModel) -> dict[str, str]:
    remarks = {}
    if effects := [f"{ActuatorEffect.of(e)} {e.coefficient:+.4g}" for e in model.effects]:
        remarks["effects"] = f"effects [N m; N if prismatic]: {', '.join(effects)}"
    if excluded := [f"{j.name} {j.feedforward_scale:g}" for j in model.joints if j.feedforward_scale != 1.0]:
        remarks["scale"] = f"feedforward scale below 1: {', '.join(excluded)}"
    return remarks


def _assign_rotors(
    arm: Arm, links: dict[str, NDArray[np.float64]], inertias: list[float]
) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """Assigns the inertia of each rotor to joints, or adds it to a link in `links` that rotates with the rotor.

    A rotor adds I J_k' J_k to the mass matrix, where I is the rotor inertia and J_k is the row of the motor in the
    transmission matrix. In SDF, a joint can represent only the diagonal of this matrix. This is sufficient if a single
    joint moves the motor. If several joints move the motor, the inertia is added to a link that rotates by J_k q, such
    as crank_link or motor_4_link. Half of the inertia is added about each perpendicular axis, so that the link remains
    physically consistent.

    Returns:
        Joint -> rotor inertia, actuator -> inertia of a rotor that no link contains, and descriptions of the rotors
        whose coupling terms are not represented.
    """
    tree = KinematicTree.from_plant(shared_plant(arm), arm)
    rates = tree.inherited_rates + tree.G
    joints = np.zeros(arm.num_joints)
    motors, couplings = {}, []
    for name, row, inertia in zip(arm.joint_names, arm.transmission.matrix, inertias, strict=True):
        candidates = np.flatnonzero(~tree.prismatic & np.all(np.abs(rates - row) < 1e-9, axis=1))
        if np.count_nonzero(row) > 1 and len(candidates):
            # All candidates rotate at the same rate, so any of them can be used. The last is part of the linkage.
            link, axis = tree.links[candidates[-1]], tree.joint_poses[candidates[-1], :3, 2]
            links[link] = links[link] + inertia * np.concatenate([np.zeros(4), _unit_rotor_inertia(axis)])
            continue
        motors[name] = float(inertia)
        joints += inertia * row**2
        if np.count_nonzero(row) > 1 and inertia > 0:
            coupling = inertia * np.outer(row, row)
            couplings.append(f"{name} {np.abs(coupling - np.diag(np.diag(coupling))).max():.2g}")
    return {name: float(x) for name, x in zip(arm.joint_names, joints, strict=True)}, motors, couplings


def _unit_rotor_inertia(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the rotational inertia (6,) of a rotor, in the order Ixx, Iyy, Izz, Ixy, Ixz, Iyz.

    The moment of inertia is 1 about `axis` and 1/2 about perpendicular axes.
    """
    inertia = (np.eye(3) + np.outer(axis, axis)) / 2
    return np.concatenate([np.diag(inertia), inertia[[0, 0, 1], [1, 2, 2]]])
