"""Cartesian pose, velocity and inverse kinematics of a simulated dVRK arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from dvrk_drake.dynamics.kinematics import ArmFrame, handle_frame
from dvrk_drake.models.arm import Arm

#: Largest error of a solution [rad, m].
_TOLERANCE = np.array([1e-7] * 3 + [1e-8] * 3)
#: Length [m] that weighs an error of the position against an error of the orientation.
_LENGTH = 0.1
_MAX_ITERATIONS = 50
#: Largest step of a revolute and of a prismatic joint per iteration [rad, m].
_MAX_STEP = (0.5, 0.05)
#: Rotation R_FT of the tool frame T of a PSM. It is the rotation in `tooltip_offset` of the dVRK's instrument files.
_R_FT = RotationMatrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]))


class CrtkKinematics:
    """Kinematics of the tool frame T in the base frame B, as in a dVRK.

    For an MTM, T is the last DH frame, dh_7. For a PSM, T has the origin of dh_6 and the orientation in the
    dVRK's instrument files. The origin of B is the shoulder of an MTM, or the remote centre of motion of a PSM. A dVRK
    can add the pose of the base on its cart. An instrument can add an offset of the tool tip.
    """

    def __init__(self, arm: Arm) -> None:
        """Creates the kinematics of `arm`.

        Raises:
            ArmError: The SDF of the arm has no frames dh_0, dh_1, ...
        """
        self._frame = ArmFrame(arm, handle_frame(arm))
        self._R_FT = _R_FT if arm.separate_joint else RotationMatrix()
        self._lower, self._upper = arm.position_lower, arm.position_upper
        self._max_step = arm.per_joint(*_MAX_STEP)

    def pose(self, q: NDArray[np.float64]) -> RigidTransform:
        """Returns the pose X_BT at q (n,) [rad, m]."""
        X_BF = self._frame.pose(q)
        return RigidTransform(X_BF.rotation() @ self._R_FT, X_BF.translation())

    def velocity(self, q: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns V_BT (6,) at q (n,), v (n,): angular velocity [rad/s], then velocity of T's origin [m/s], in B."""
        return self._frame.jacobian(q) @ v

    def inverse(self, pose: Sequence[float], q_near: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Returns joint positions (n,) within the position limits for a pose of T, or None if no solution is found.

        The method is damped least squares (Levenberg-Marquardt). It converges to a solution near `q_near`.

        Args:
            pose: Position x, y, z [m] and quaternion x, y, z, w of T. The quaternion is normalized.
            q_near: Initial joint positions (n,) [rad, m].
        """
        x, y, z, w = np.asarray(pose[3:], float) / np.linalg.norm(pose[3:])
        X_BT = RigidTransform(Quaternion(wxyz=[w, x, y, z]), pose[:3])
        scale = np.array([1.0] * 3 + [1.0 / _LENGTH] * 3)
        q, damping = np.clip(q_near, self._lower, self._upper), 1e-4
        error = self._error(X_BT, q)
        for _ in range(_MAX_ITERATIONS):
            if np.all(np.abs(error) < _TOLERANCE):
                return q
            J = scale[:, None] * self._frame.jacobian(q)
            e = scale * error
            # A joint at a limit that would move beyond the limit does not move.
            gradient = J.T @ e
            stuck = ((q <= self._lower) & (gradient < 0)) | ((q >= self._upper) & (gradient > 0))
            J[:, stuck] = 0.0
            step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), e)
            step /= max(1.0, float(np.max(np.abs(step) / self._max_step)))
            q_next = np.clip(q + step, self._lower, self._upper)
            error_next = self._error(X_BT, q_next)
            if np.linalg.norm(scale * error_next) < np.linalg.norm(e):
                q, error, damping = q_next, error_next, max(0.1 * damping, 1e-12)
            else:
                damping = 10.0 * max(damping, 1e-8)
                if damping > 1e4:
                    return None
        return None

    def _error(self, X_BT: RigidTransform, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the rotation vector and the translation (6,) from the pose at q to X_BT, expressed in B."""
        X = self.pose(q)
        rotation = X_BT.rotation().multiply(X.rotation().inverse()).ToAngleAxis()
        return np.concatenate([rotation.angle() * rotation.axis(), X_BT.translation() - X.translation()])
