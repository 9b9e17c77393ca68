"""The links and rotors of an identified model: bodies that a simulator can use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import (
    LinkInertia,
    parameters_from_pseudo_inertia,
)
from dvrk_drake.dynamics.static_model import compile_static_model
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.plant import shared_plant

#: Least eigenvalue of a link's pseudo-inertia, as a share of that of the SDF's link in all directions.
MIN_SHARE = 0.01
#: Change of Z below which a link has not moved.
_ROUNDING = 1e-7
_UPPER = [(i, k) for i in range(4) for k in range(i, 4)]


def nearest_links(arm: Arm, base_values: ArrayLike) -> tuple[LinkInertia, ...]:
    """Links of which the gravity torque is Y(q) beta, as near to the SDF's as bodies can be.

    With the SDF's pseudo-inertia J0 = L L' of a link, Z = L^-1 J L^-T is 1 where nothing changes, whatever the link's
    size: the distance is the sum of |Z - 1|^2 (Frobenius) over the links, under Z > MIN_SHARE and the linear
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
    if _least_eigenvalue(z) < MIN_SHARE:
        z = _nearest_body(A, b)
    z = _polished(A, b, z)
    if _least_eigenvalue(z) < MIN_SHARE / 2:
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
    plant = shared_plant(arm)
    frames = map(plant.get_frame, plant.GetFrameIndices(plant.GetBodyByName(link).model_instance()))
    return not any(f.name().startswith("dh_") and f.body().name() == link for f in frames)


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
    """The nearest z of which all Z exceed MIN_SHARE."""
    weights, target = _weights(A.shape[1] // 10)
    program = MathematicalProgram()
    z = program.NewContinuousVariables(len(weights), "z")
    program.AddQuadraticCost(2 * np.diag(weights), -2 * weights * target, z, is_convex=True)
    program.AddLinearEqualityConstraint(A, b, z)
    for link in z.reshape(-1, 10):
        shifted = [variable - MIN_SHARE * (i == k) for variable, (i, k) in zip(link, _UPPER, strict=True)]
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


@dataclass(frozen=True, eq=False)
class ModelBodies:
    """What a simulator can have of a model.

    Attributes:
        links: every moving link; a rotor that turns as a link does is part of it, as in the SDF.
        rotors: joint -> inertia that its motors add to it [kg m^2; kg if prismatic]; empty: those of the SDF.
        left_out: what the model's torque has beside these, a line each, for people.
    """

    links: tuple[LinkInertia, ...]
    rotors: dict[str, float]
    left_out: list[str]


def model_bodies(model: IdentifiedModel) -> ModelBodies:
    """The links of the model's dynamics, and its rotors; of a static model the links nearest to the SDF's.

    A static model knows no more than gravity base parameters; its links have exactly these.

    Raises:
        ModelError: no bodies have these base parameters.
    """
    arm = model.arm
    left_out = _static_effects(model)
    expected = load_arm(arm.source).gravity
    if not np.allclose(arm.gravity, expected, atol=0.02):
        gravity = ", ".join(f"{x:.3f}" for x in arm.gravity)
        left_out.append(
            f"gravity ({gravity}) m/s^2 in the base frame: set it in the world that the file is loaded into"
        )
    if model.dynamics is None:
        base_values = np.array([p.value for p in model.base_parameters])
        return ModelBodies(nearest_links(arm, base_values), {}, left_out)
    if effects := model.dynamics.effects:
        coordinates = dict.fromkeys(effect.coordinate for effect in effects)
        left_out.append(f"{len(effects)} effects in the drive (friction, cables, springs): {', '.join(coordinates)}")
    links = {link.link: np.array(link.parameters) for link in model.dynamics.links}
    rotors, lost = _place_rotors(arm, links, [rotor.value for rotor in model.dynamics.rotors])
    if lost:
        left_out.append(f"by what rotors couple joints, which SDF cannot say [kg m^2, largest]: {', '.join(lost)}")
    return ModelBodies(tuple(LinkInertia(name, phi) for name, phi in links.items()), rotors, left_out)


def _static_effects(model: IdentifiedModel) -> list[str]:
    remarks = []
    if effects := [f"{ActuatorEffect.of(e)} {e.coefficient:+.4g}" for e in model.effects]:
        remarks.append(f"effects [N m; N if prismatic]: {', '.join(effects)}")
    if excluded := [f"{j.name} {j.feedforward_scale:g}" for j in model.joints if j.feedforward_scale != 1.0]:
        remarks.append(f"feedforward scale below 1: {', '.join(excluded)}")
    return remarks


def _place_rotors(
    arm: Arm, links: dict[str, NDArray[np.float64]], inertias: list[float]
) -> tuple[dict[str, float], list[str]]:
    """Puts rotors on joints, or into `links` that turn with them; returns the joints' and the rotors that lose terms.

    A rotor adds I J_k' J_k to the mass matrix, J_k its row of the transmission. On a joint SDF has only the diagonal of
    that, which is all where one joint alone moves the motor. Where several do, a link that turns by J_k q takes it, as
    the SDF's own crank and motor_4 links do: about its axis, and half of it about the others, as bodies must.
    """
    plant = shared_plant(arm)
    turning = _turning_links(plant, arm)
    joints = np.zeros(arm.num_joints)
    lost = []
    for name, row, inertia in zip(arm.joint_names, arm.transmission.matrix, inertias, strict=True):
        same = [link for link, (rate, _) in turning.items() if np.allclose(rate, row, atol=1e-9)]
        if np.count_nonzero(row) > 1 and same:
            # Links that always turn alike feel it alike; the last of them is one of the linkage's, like the SDF's own.
            link = same[-1]
            axis = turning[link][1]
            links[link] = links[link] + inertia * np.concatenate([np.zeros(4), _about(axis)])
            continue
        joints += inertia * row**2
        if np.count_nonzero(row) > 1 and inertia > 0:
            coupling = inertia * np.outer(row, row)
            lost.append(f"{name} {np.abs(coupling - np.diag(np.diag(coupling))).max():.2g}")
    return {name: float(x) for name, x in zip(arm.joint_names, joints, strict=True)}, lost


def _about(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) Ixx .. Iyz of a rotor of inertia 1 about `axis`, and a half about all that are normal to it."""
    inertia = (np.eye(3) + np.outer(axis, axis)) / 2
    return np.concatenate([np.diag(inertia), inertia[[0, 0, 1], [1, 2, 2]]])


def _turning_links(plant: MultibodyPlant, arm: Arm) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Links on hinges: by which of q they turn about their hinge's axis (n,), parents with parallel hinges included,
    and that axis in the link's frame (3,)."""
    context = plant.CreateDefaultContext()
    turning: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    axes: dict[str, NDArray[np.float64]] = {}
    for name, row in zip(arm.tree_joint_names, arm.linkage.matrix, strict=True):
        joint = plant.GetJointByName(name)
        if joint.type_name() != "revolute":
            continue
        X_WM = joint.frame_on_child().CalcPoseInWorld(context)
        link, parent = joint.child_body(), joint.parent_body().name()
        axis_W = X_WM.rotation() @ joint.revolute_axis()
        X_WL = link.EvalPoseInWorld(context)
        parallel = parent in turning and np.allclose(axes[parent], axis_W, atol=1e-9)
        rate = row + turning[parent][0] if parallel else row
        turning[link.name()] = rate, X_WL.rotation().inverse() @ axis_W
        axes[link.name()] = axis_W
    return turning
