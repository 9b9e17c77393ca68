"""The torque of an arm's full dynamics, linear in its inertial parameters: tau = Y(q, v, vd) phi."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.inertial_parameters import (
    PARAMETER_NAMES,
    LinkInertia,
    RotorInertia,
    link_inertias,
    rotor_inertias,
)
from dvrk_drake.dynamics.kinematic_tree import KinematicTree
from dvrk_drake.dynamics.regressor_kernel import fill_regressor
from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant

#: Samples that a thread takes at a time, and that `torque` keeps a regressor of.
_CHUNK = 256


class DynamicRegressor:
    """tau = Y(q, v, vd) phi: the torque on the n independent joints that moves the arm, linkage and rotors included.

    phi (p,) holds the ten inertial parameters of every moving link, each about its origin in its frame of the SDF, and
    then the inertias of the rotors in actuator coordinates. The equations are those of the arm's MultibodyPlant, whose
    joints are read; tau equals its inverse dynamics less gravity forces, projected through the linkage with G'.
    Friction and joint damping are not part of it.

    Attributes:
        arm: whose equations these are, mounted as its `gravity` says.
        links: the moving links with their SDF's parameters, in the order of the columns.
        rotors: the rotor parameters, in the order of their columns, which follow the links'.
    """

    def __init__(self, arm: Arm) -> None:
        """Reads the arm's plant.

        Raises:
            ArmError: a joint of its SDF neither turns, slides nor is fixed.
        """
        self.arm = arm
        plant = make_arm_plant(arm)
        self._tree = KinematicTree.from_plant(plant, arm)
        by_name = {inertia.link: inertia for inertia in link_inertias(arm)}
        self.links: tuple[LinkInertia, ...] = tuple(by_name[link] for link in self._tree.links)
        self.rotors: tuple[RotorInertia, ...] = rotor_inertias(plant, arm)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(p,) such as "forearm_link.mcx" [kg m] and "rotor.elbow_pitch" [kg m^2; kg on a prismatic actuator]."""
        links = [f"{link.link}.{name}" for link in self.links for name in PARAMETER_NAMES]
        return tuple(links + [rotor.name for rotor in self.rotors])

    @cached_property
    def values(self) -> NDArray[np.float64]:
        """(p,) what the SDF states."""
        return np.concatenate([*(link.parameters for link in self.links), [rotor.value for rotor in self.rotors]])

    def regressor(
        self, q: ArrayLike, v: ArrayLike, vd: ArrayLike, out: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Y (m, n, p).

        Args:
            q, v, vd: (m, n) positions [rad, m], velocities and accelerations of the independent joints.
            out: array to write to and return. The memory of a new one takes as long to get as Y takes to compute, so
                who goes through many samples in parts keeps one.

        Raises:
            ModelError: the arrays are not of these shapes, or `out` is not C-contiguous float64.
        """
        motion = self._checked_motion(q, v, vd)
        shape = (*motion[0].shape, len(self.names))
        Y = np.empty(shape) if out is None else out
        if Y.shape != shape or Y.dtype != np.float64 or not Y.flags.c_contiguous:
            raise ModelError(f"out is {Y.dtype} {Y.shape}; allowed: float64 {shape}, C-contiguous")
        self._fill(motion, self.arm.gravity, Y)
        return Y

    def torque(self, q: ArrayLike, v: ArrayLike, vd: ArrayLike, parameters: ArrayLike) -> NDArray[np.float64]:
        """tau (m, n) [N m; N on a prismatic joint] for parameters (p,); arguments as in `regressor`."""
        return self._torque(self._checked_motion(q, v, vd), self.arm.gravity, self._checked_parameters(parameters))

    def mass_matrix(self, q: ArrayLike, parameters: ArrayLike) -> NDArray[np.float64]:
        """M (m, n, n) of the independent joints at the poses q (m, n), for parameters (p,): tau = M vd + ...

        Column j is the torque of a unit acceleration of joint j at rest and without gravity.
        """
        q, _, _ = self._checked_motion(q, np.zeros_like(q, dtype=float), np.zeros_like(q, dtype=float))
        n = self.arm.num_joints
        poses, vd = np.repeat(q, n, axis=0), np.tile(np.eye(n), (len(q), 1))
        columns = self._torque((poses, np.zeros_like(vd), vd), np.zeros(3), self._checked_parameters(parameters))
        return columns.reshape(-1, n, n).transpose(0, 2, 1)

    def _torque(
        self, motion: tuple[NDArray, NDArray, NDArray], gravity: NDArray, parameters: NDArray
    ) -> NDArray[np.float64]:
        """Chunk by chunk, so that no regressor of all samples is held."""
        tau = np.empty(motion[0].shape)
        Y = np.empty((_CHUNK, self.arm.num_joints, len(parameters)))
        for start in range(0, len(tau), _CHUNK):
            chunk = tuple(x[start : start + _CHUNK] for x in motion)
            part = Y[: len(chunk[0])]
            self._fill(chunk, gravity, part)
            tau[start : start + _CHUNK] = part @ parameters
        return tau

    def _fill(self, motion: tuple[NDArray, ...], gravity: NDArray, Y: NDArray) -> None:
        tree = self._tree

        chunks = iter(range(0, len(Y), _CHUNK))  # shared: a thread that was kept waiting takes fewer

        def work() -> None:
            # A part at a time, where the caches hold it: Y itself goes to memory once and in order.
            part = np.zeros((min(_CHUNK, len(Y)), *Y.shape[1:]))
            for first in chunks:
                chunk = slice(first, first + _CHUNK)
                q, v, vd = (x[chunk] for x in motion)
                fill_regressor(
                    tree.joint_motion(q, v, vd),
                    vd,
                    gravity,
                    tree.parents,
                    tree.pose_terms,
                    tree.hinges,
                    tree.G,
                    tree.affects,
                    self._rotor_rows,
                    part[: len(q)],
                )
                Y[chunk] = part[: len(q)]

        threads = min(os.cpu_count() or 1, len(Y) // (2 * _CHUNK))
        if threads <= 1:
            work()
            return
        with ThreadPoolExecutor(threads) as pool:
            for result in [pool.submit(work) for _ in range(threads)]:
                result.result()

    @cached_property
    def _rotor_rows(self) -> NDArray[np.float64]:
        """(r, 2, n) as `fill_regressor` takes them."""
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
            raise ModelError(f"q, v, vd have shapes {q.shape}, {v.shape}, {vd.shape}; allowed: (m, {n}), all alike")
        return q, v, vd

    def _checked_parameters(self, parameters: ArrayLike) -> NDArray[np.float64]:
        phi = np.ascontiguousarray(parameters, dtype=np.float64)
        if phi.shape != self.values.shape:
            raise ModelError(f"parameters have shape {phi.shape}; {self.arm.name} has {len(self.values)}")
        return phi
