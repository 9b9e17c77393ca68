"""Converts external joint efforts of an arm to the force at a point of contact, with its covariance."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm

#: Prior standard deviation of each component of a force [N]: the largest force for which the estimates were tested
#: (benchmarks/external_force.py). It hardly changes a component that the efforts determine to 1 N.
PRIOR_FORCE = 10.0
#: Largest standard deviation of a component that is reported [N], a fifth of that without a measurement. The interval
#: is then +- 4 N, so it contains 0 for most forces that an instrument exerts.
MAX_DEVIATION = 2.0

#: Axes in which a force is expressed: those of the base B of the arm, or those of the frame F of the contact.
Axes = Literal["base", "frame"]


class Contact:
    """Point P, fixed in a frame F of an arm with base B, at which a force acts on the arm.

    The force f has k components: x, y, z, or one component along a known direction. Only the force at P is assumed to
    act on the arm. It causes the joint efforts J' f. A lateral force on the shaft at the remote centre of motion causes
    no efforts, so it neither changes the estimate nor can be estimated.

    Attributes:
        components: Names of the components: ("x", "y", "z") or ("direction",).
        axes: Axes in which the force is expressed.
        num_joints: Number n of joints of the arm.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> tip = dvrk.Contact(dvrk.load_arm("psm"), axes="frame")
        >>> q = np.array([[0.1, 0.2, 0.1, 0, 0.3, 0, 0]])
        >>> effort = [1.0, 2.0, 3.0] @ tip.jacobian(q[0])  # of a known force
        >>> force, covariance = tip.force(q, effort[None], 1e-8 * np.eye(7)[None])
        >>> force.round(3).tolist()
        [[1.0, 2.0, 3.0]]
    """

    def __init__(
        self,
        arm: Arm,
        frame: str = "",
        point: ArrayLike = (0.0, 0.0, 0.0),
        *,
        axes: Axes = "base",
        direction: ArrayLike | None = None,
        cannula: bool = False,
    ) -> None:
        """Creates a contact.

        Args:
            arm: Arm on which the force acts.
            frame: Frame F of the SDF. Default: `arm.frames.hand`.
            point: Position p_FP (3,) of the point [m].
            axes: Axes in which the force and the direction are expressed.
            direction: Direction (3,) of the force, if it is known. Its length is ignored. The other components of the
                force are then assumed to be 0.
            cannula: True if a cannula at the remote centre can exert an unknown force along the shaft. The interval of
                the axial component then becomes wider, because few joints distinguish the two forces.

        Raises:
            ArmError: The SDF has no such frame, a vector is not three finite numbers, the direction is 0, or the arm
                has no shaft through a remote centre.
        """
        self._frame, self.num_joints = ArmFrame(arm, frame), arm.num_joints
        self._p_FP = _vector("point", point)
        if axes not in ("base", "frame"):
            raise ArmError(f'axes is "{axes}"; allowed: base, frame')
        self.axes = axes
        self.components: tuple[str, ...] = ("x", "y", "z")
        self._select = np.eye(3)
        if direction is not None:
            vector = _vector("direction", direction)
            if not np.any(vector):
                raise ArmError("direction is 0; allowed: a vector with a length")
            self.components, self._select = ("direction",), (vector / np.linalg.norm(vector))[None]
        self._shaft = None
        if cannula:
            if not (arm.frames.shaft and arm.frames.remote_center):
                raise ArmError(f"{arm.name} has no shaft through a remote centre, so it has no cannula")
            self._shaft = ArmFrame(arm, arm.frames.shaft)
            self._p_remote = ArmFrame(arm, arm.frames.remote_center).pose(np.zeros(arm.num_joints)).translation()

    def point(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the position p_BP (3,) of the point [m] at a pose q (n,)."""
        return np.asarray(self._frame.pose(q) @ self._p_FP)

    def directions(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the directions (3, k) of the components at a pose q (n,), in the base frame, as unit vectors."""
        rotation = self._frame.pose(q).rotation().matrix() if self.axes == "frame" else np.eye(3)
        return np.asarray(rotation @ self._select.T)

    def jacobian(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the matrix J at a pose q (n,). An additional row belongs to the force of the cannula."""
        J, X_BF = self._frame.jacobian(q), self._frame.pose(q)
        rows = self.directions(q).T @ (J[3:] + np.cross(J[:3], X_BF.rotation() @ self._p_FP, axis=0))
        if self._shaft is None:
            return rows
        X_BS, J_S = self._shaft.pose(q), self._shaft.jacobian(q)
        axis = X_BS.rotation().matrix()[:, 2]
        at_remote = J_S[3:] + np.cross(J_S[:3], self._p_remote - X_BS.translation(), axis=0)
        return np.vstack([rows, axis @ at_remote])

    def force(
        self, q: NDArray[np.float64], effort: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the forces (m, k) [N] and their covariances (m, k, k) [N^2].

        The estimate minimises the weighted squares of J' f - effort, with the inverse covariance as weights, and with
        the prior standard deviation `PRIOR_FORCE` for each component.

        Args:
            q: Poses (m, n) [rad, m].
            effort: Joint efforts (m, n) that the force causes [N m, N].
            covariance: Covariances (m, n, n) of these efforts.
        """
        J = np.array([self.jacobian(pose) for pose in q]).reshape(len(q), -1, q.shape[1])
        k = len(self.components)
        weighted = np.linalg.solve(covariance, J.transpose(0, 2, 1))
        of_force = np.linalg.inv(J @ weighted + np.eye(J.shape[1]) / PRIOR_FORCE**2)
        force: NDArray[np.float64] = np.einsum("mij,mnj,mn->mi", of_force, weighted, effort)
        return force[:, :k], np.asarray(of_force[:, :k, :k])


def is_measurable(covariance: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns the mask (..., k) of the components that the arm can measure, see `MAX_DEVIATION`.

    Args:
        covariance: Covariances (..., k, k) of the forces [N^2].
    """
    return np.asarray(np.diagonal(covariance, axis1=-2, axis2=-1) <= MAX_DEVIATION**2)


def _vector(name: str, values: ArrayLike) -> NDArray[np.float64]:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise ArmError(f"{name} is {vector.tolist()}; allowed: three finite numbers")
    return vector
