"""Computes the regressor of an arm's full dynamics and the corresponding base parameters."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform

from dvrk_drake.dynamics.gravity_parameters import (
    BaseParameters,
    StandardParameter,
    link_frames,
    named_lengths,
    preference_order,
    reduce_to_base,
)
from dvrk_drake.dynamics.inertial_parameters import (
    PARAMETER_NAMES,
    LinkInertia,
    RotorInertia,
    change_of_frame,
    link_inertias,
    parameter_axis,
    rotor_inertias,
)
from dvrk_drake.dynamics.kinematic_tree import KinematicTree
from dvrk_drake.dynamics.regressor_kernel import fill_regressor
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import shared_plant

#: Number of samples in a chunk, for which `torque` computes one regressor: four blocks of the compiled recursion
#: (`BLOCK`). The regressor of a PSM then has 2 MB, which fits into the cache of a core.
_CHUNK = 256


class DynamicRegressor:
    """Regressor Y of the inverse dynamics tau = Y(q, v, vd) phi of an arm, including linkage and rotors.

    tau (n,) are the efforts of the independent joints [N m, N]. phi (p,) contains the ten inertial parameters of every
    moving link, then the inertias of the rotors in actuator coordinates. The parameters of a link are about the origin
    of its SDF frame and expressed in this frame. The joints are read from the arm's MultibodyPlant. Without friction
    and joint damping, tau equals G' (tau_id - tau_g). Here, tau_id is the inverse dynamics of the plant, tau_g are its
    generalized gravity forces, and G is the matrix of `Arm.linkage`.

    Attributes:
        arm: Arm of the regressor. Its `gravity` specifies the orientation of the base.
        links: Moving links with their parameters in the SDF, in the order of the regressor columns.
        rotors: Rotor parameters, in the order of their regressor columns. These columns follow the columns of the
            links.
    """

    def __init__(self, arm: Arm) -> None:
        """Reads the arm's plant.

        Raises:
            ArmError: A joint of the SDF is not revolute, prismatic or fixed.
        """
        self.arm = arm
        plant = shared_plant(arm)
        self._tree = KinematicTree.from_plant(plant, arm)
        by_name = {inertia.link: inertia for inertia in link_inertias(arm)}
        self.links: tuple[LinkInertia, ...] = tuple(by_name[link] for link in self._tree.links)
        self.rotors: tuple[RotorInertia, ...] = rotor_inertias(plant, arm)

    def with_gravity(self, gravity: Sequence[float]) -> DynamicRegressor:
        """Returns the regressor of the same arm with gravity vector (3,) in its base frame [m/s^2]."""
        other = copy.copy(self)
        other.arm = self.arm.with_gravity(gravity)
        return other

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Parameter names (p,).

        Examples are "forearm_link.mcx" [kg m] and "rotor.elbow_pitch" [kg m^2; kg for a prismatic actuator].
        """
        links = [f"{link.link}.{name}" for link in self.links for name in PARAMETER_NAMES]
        return tuple(links + [rotor.name for rotor in self.rotors])

    @cached_property
    def values(self) -> NDArray[np.float64]:
        """Parameters phi (p,) of the SDF."""
        return np.concatenate([*(link.parameters for link in self.links), [rotor.value for rotor in self.rotors]])

    def regressor(
        self, q: ArrayLike, v: ArrayLike, vd: ArrayLike, out: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Returns the regressor Y (m, n, p).

        Args:
            q, v, vd: Positions [rad, m], velocities and accelerations (m, n) of the independent joints.
            out: Array that receives the result and is returned. Allocating a new array takes longer than computing Y,
                so callers that process many samples in chunks should reuse one.

        Raises:
            ModelError: The arrays do not have the required shapes, or `out` is not C-contiguous float64.
        """
        motion = self._checked_motion(q, v, vd)
        shape = (*motion[0].shape, len(self.names))
        Y = np.empty(shape) if out is None else out
        if Y.shape != shape or Y.dtype != np.float64 or not Y.flags.c_contiguous:
            raise ModelError(f"out is {Y.dtype} {Y.shape}; allowed: float64 {shape}, C-contiguous")
        self._fill(motion, self.arm.gravity, Y)
        return Y

    def torque(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike, parameters: ArrayLike) -> NDArray[np.float64]:
        """Returns tau (m, n) [N m; N for a prismatic joint] for parameters (p,).

        The other arguments are those of `regressor`.
        """
        return self._torque(self._checked_motion(q, v, vd), self.arm.gravity, self._checked_parameters(parameters))

    def mass_matrix(self, q: ArrayLike, parameters: ArrayLike) -> NDArray[np.float64]:
        """Returns the mass matrix M (m, n, n) of the independent joints at poses q (m, n) for parameters (p,).

        Column j is the torque for a unit acceleration of joint j at zero velocity and without gravity.
        """
        q, _, _ = self._checked_motion(q, np.zeros_like(q, dtype=float), np.zeros_like(q, dtype=float))
        n = self.arm.num_joints
        poses, vd = np.repeat(q, n, axis=0), np.tile(np.eye(n), (len(q), 1))
        columns = self._torque((poses, np.zeros_like(vd), vd), np.zeros(3), self._checked_parameters(parameters))
        return columns.reshape(-1, n, n).transpose(0, 2, 1)

    def _torque(
        self, motion: tuple[NDArray, NDArray, NDArray], gravity: NDArray, parameters: NDArray
    ) -> NDArray[np.float64]:
        """Computes the torque in chunks, to limit memory use."""
        tau = np.empty(motion[0].shape)
        Y = np.empty((_CHUNK, self.arm.num_joints, len(parameters)))
        for start in range(0, len(tau), _CHUNK):
            chunk = tuple(x[start : start + _CHUNK] for x in motion)
            part = Y[: len(chunk[0])]
            self._fill(chunk, gravity, part)
            tau[start : start + _CHUNK] = part @ parameters
        return tau

    def _fill(self, motion: tuple[NDArray, ...], gravity: NDArray, Y: NDArray) -> None:
        fill_regressor(*motion, gravity, self._tree.arrays, self._rotor_rows, Y)

    @cached_property
    def _rotor_rows(self) -> NDArray[np.float64]:
        """Rotor rows (r, 2, n) for `fill_regressor`."""
        J = self.arm.transmission.matrix
        index = self.arm.joint_names.index
        rows = [
            (J[index(a)] * (0.5 if a == b else 1.0), J[index(b)]) for a, b in (rotor.actuators for rotor in self.rotors)
        ]
        return np.array(rows).reshape(-1, 2, self.arm.num_joints)

    def _checked_motion(self, *motion: ArrayLike) -> tuple[NDArray, NDArray, NDArray]:
        q, v, vd = (np.ascontiguousarray(x, dtype=np.float64) for x in motion)
        n = self.arm.num_joints
        if q.ndim != 2 or q.shape[1] != n or not q.shape == v.shape == vd.shape:
            raise ModelError(f"q, v, vd have shapes {q.shape}, {v.shape}, {vd.shape}; allowed: (m, {n}) for all")
        return q, v, vd

    def _checked_parameters(self, parameters: ArrayLike) -> NDArray[np.float64]:
        phi = np.ascontiguousarray(parameters, dtype=np.float64)
        if phi.shape != self.values.shape:
            raise ModelError(f"parameters have shape {phi.shape}; allowed for {self.arm.name}: ({len(self.values)},)")
        return phi


_AXES = tuple(parameter_axis(name) for name in PARAMETER_NAMES)


@dataclass(frozen=True, eq=False)
class DynamicBaseParameters:
    """Base parameters beta = base.combination @ phi_F, with tau = Y_base beta = Y phi for every motion.

    phi_F (p,) contains the ten parameters of each link in its frame dh_<label>, then the parameters of the rotors. For
    a link without such a frame, the SDF frame is used. `base.names` refers to phi_F. phi (p,) contains the parameters
    of `DynamicRegressor`, in the SDF frames.

    Attributes:
        standard_parameters: Standard parameters phi_F (p,).
        base: Base parameters as combinations of phi_F.
        to_links: Matrix (p, p) with phi = to_links @ phi_F.
    """

    standard_parameters: tuple[StandardParameter, ...]
    base: BaseParameters
    to_links: NDArray[np.float64]

    @cached_property
    def combination(self) -> NDArray[np.float64]:
        """Matrix (b, p) with beta = combination @ phi."""
        return np.asarray(np.linalg.solve(self.to_links.T, self.base.combination.T).T, dtype=np.float64)


def derive_base_parameters(model: DynamicRegressor) -> DynamicBaseParameters:
    """Derives the base parameters numerically from the regressor at random states.

    The states are chosen so that gravity, velocity and acceleration terms have similar magnitude. The base parameters
    depend on the orientation of the base. If the base is tilted, additional parameters of the first links can affect
    the torque. The last columns of the regressor, for terms that couple two rotors, are excluded, because real motors
    have no such terms (see `rotor_inertias`).
    """
    from scipy.linalg import block_diag

    frames = _link_frames(model)
    to_links = block_diag(*(change_of_frame(X_LF) for _, X_LF in frames), np.eye(model.arm.num_joints))
    p = len(to_links)
    parameters = [StandardParameter(label, axis) for label, _ in frames for axis in _AXES]
    for i, prismatic in enumerate(model.arm.prismatic, start=1):
        parameters.append(StandardParameter(f"{i}", "a", prismatic=bool(prismatic)))
    base = reduce_to_base(
        _regressor_at_random_states(model)[:, :p] @ to_links,
        parameters,
        preference_order(parameters, _hinge_axes(model, frames)),
        _named_coefficients(named_lengths(model.arm, link_frames(model.arm))),
    )
    return DynamicBaseParameters(tuple(parameters), base, to_links)


def _link_frames(model: DynamicRegressor) -> list[tuple[str, RigidTransform]]:
    """Returns the label of each link L of the model, and the pose X_LF of its frame F; see `link_frames`."""
    named = {body.name(): (label, X_LF) for label, (body, X_LF) in link_frames(model.arm).items()}
    return [named.get(link.link, (link.link.removesuffix("_link"), RigidTransform())) for link in model.links]


def _regressor_at_random_states(model: DynamicRegressor) -> NDArray[np.float64]:
    """Returns regressor rows (rows, p) at random states. There are about three times as many rows as columns."""
    generator = np.random.default_rng(0)
    shape = (3 * len(model.values) // model.arm.num_joints + 1, model.arm.num_joints)
    q, v, vd = generator.uniform(-2, 2, shape), generator.normal(0, 2, shape), generator.normal(0, 5, shape)
    return model.regressor(q, v, vd).reshape(-1, len(model.values))


def _hinge_axes(model: DynamicRegressor, frames: list[tuple[str, RigidTransform]]) -> dict[str, int]:
    """Returns label -> index (0, 1, 2) of the axis of frame F that is parallel to the axis of a revolute joint."""
    plant, axes = shared_plant(model.arm), {}
    for link, (label, X_LF) in zip(model.links, frames, strict=True):
        joints = (plant.get_joint(i) for i in plant.GetJointIndices())
        (joint,) = (joint for joint in joints if joint.child_body().name() == link.link)
        if joint.type_name() == "revolute":
            axis_L = joint.frame_on_child().GetFixedPoseInBodyFrame().rotation() @ joint.revolute_axis()
            axes[label] = int(np.argmax(np.abs(X_LF.rotation().inverse() @ axis_L)))
    return axes


def _named_coefficients(lengths: dict[str, float]) -> dict[str, float]:
    """Returns name -> coefficient of base parameters: numbers, lengths, and products, squares and ratios of lengths."""
    lengths = {name: length for name, length in lengths.items() if name != "1"}
    named = {**lengths, **{f"{name}^2": length**2 for name, length in lengths.items()}}
    for (a, x), (b, y) in itertools.permutations(lengths.items(), 2):
        named |= {
            f"{a} {b}": x * y,
            f"({a}^2 + {b}^2)": x**2 + y**2,
            f"({a}^2 - {b}^2)": x**2 - y**2,
            f"{a}/{b}": x / y,
        }
    return {"1": 1.0, "2": 2.0, **named, **{f"2 {name}": 2 * size for name, size in named.items()}}
