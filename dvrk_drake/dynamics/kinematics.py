"""Forward and inverse kinematics of a frame of an arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import main_frames, shared_plant, tree_selector

#: Largest error of a solution of the inverse kinematics [rad, m].
_TOLERANCE = np.array([1e-7] * 3 + [1e-8] * 3)
#: Weighted error at which the iterations end [rad]. Rounding errors are below 1e-12.
_CONVERGED = 1e-11
#: Length [m] that weighs an error of the position against an error of the orientation. It is short, because the tip
#: must not move far if a limit prevents the orientation.
_LENGTH = 0.01
_WEIGHTS = np.array([1.0] * 3 + [1.0 / _LENGTH] * 3)
#: Largest step of a revolute and of a prismatic joint per iteration [rad, m]. The linear approximation of a sine is
#: wrong by 4 % at this angle.
_MAX_STEP = (0.5, 0.05)
#: Damping factors of the inverse kinematics: at the start, smallest and largest. J J' has elements of about 1, so that
#: the first one hardly changes a step, and a step with the last one is negligible. The smallest one exceeds the
#: rounding errors of J J' if joints at their limits make it singular.
_START_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-4, 1e-8, 1e4


class ArmFrame:
    """Kinematics of a frame F of an arm with base frame B.

    Joint positions q have shape (n,) [rad; m for a prismatic joint]. Threads must not share an `ArmFrame`.
    """

    def __init__(self, arm: Arm, frame_name: str = "") -> None:
        """Creates the kinematics of a frame of the SDF. If its name is empty, it is the frame `arm.frames.hand`.

        Raises:
            ArmError: The SDF has no such frame.
        """
        self._arm = arm
        self._plant = shared_plant(arm)
        if not self._plant.HasFrameNamed(frame_name := frame_name or arm.frames.hand):
            known = ", ".join(dict.fromkeys([*main_frames(arm), arm.frames.hand]))
            raise ArmError(f'{arm.name}: the SDF has no frame "{frame_name}"; available frames: {known}, and all links')
        self._frame = self._plant.GetFrameByName(frame_name)
        self._context = self._plant.CreateDefaultContext()
        # G maps velocities of the independent joints to velocities of the plant.
        self._G = np.zeros((self._plant.num_velocities(), arm.num_joints))
        self._selector = tree_selector(self._plant, arm)
        self._G[self._selector] = arm.linkage.matrix

    def pose(self, q: ArrayLike) -> RigidTransform:
        """Returns the pose X_BF."""
        self._set(q)
        return self._frame.CalcPoseInWorld(self._context)

    def jacobian(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the Jacobian J (6, n) with V_BF = J v, expressed in B.

        V_BF consists of the angular velocity [rad/s] and the velocity of the origin of F [m/s].
        """
        self._set(q)
        world = self._plant.world_frame()
        J = self._plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._frame, np.zeros(3), world, world
        )
        return J @ self._G

    def mass_matrix(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the mass matrix (n, n) of the independent joints, including the linkage."""
        self._set(q)
        return self._G.T @ self._plant.CalcMassMatrix(self._context) @ self._G

    def solve(self, X_BF: RigidTransform, q_near: ArrayLike) -> NDArray[np.float64] | None:
        """Returns joint positions (n,) within the position limits for a pose X_BF, or None if no solution is found.

        The solution is near `q_near` (n,) [rad, m]. See `approach` for the method.
        """
        q = self.approach(X_BF, q_near, max_steps=50)
        return q if np.all(np.abs(self._error(X_BF, q)) < _TOLERANCE) else None

    def approach(self, X_BF: RigidTransform, q_start: ArrayLike, max_steps: int) -> NDArray[np.float64]:
        """Returns joint positions (n,) within the position limits, with which the frame is nearer to a pose X_BF.

        The method is damped least squares (Levenberg-Marquardt), which reduces the error with every step until it is
        zero, or minimal within the limits. It needs no further information on the mechanism.

        Args:
            X_BF: Desired pose of the frame in the base frame.
            q_start: Initial joint positions (n,) [rad, m]. They are clipped to the limits.
            max_steps: Largest number of steps. Steps that would increase the error do not count.
        """
        lower, upper = self._arm.position_lower, self._arm.position_upper
        max_step = self._arm.per_joint(*_MAX_STEP)
        q, damping = np.clip(q_start, lower, upper), _START_DAMPING
        e = _WEIGHTS * self._error(X_BF, q)
        while max_steps and np.linalg.norm(e) > _CONVERGED and damping < _MAX_DAMPING:
            J = _WEIGHTS[:, None] * self.jacobian(q)
            # A joint at a limit that would move beyond the limit does not move.
            gradient = J.T @ e
            J[:, ((q <= lower) & (gradient < 0)) | ((q >= upper) & (gradient > 0))] = 0.0
            step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), e)
            step /= max(1.0, float(np.max(np.abs(step) / max_step)))
            q_next = np.clip(q + step, lower, upper)
            e_next = _WEIGHTS * self._error(X_BF, q_next)
            if np.linalg.norm(e_next) < np.linalg.norm(e):
                q, e, damping, max_steps = q_next, e_next, max(0.1 * damping, _MIN_DAMPING), max_steps - 1
            else:
                damping *= 10.0
        return q

    def _error(self, X_BF: RigidTransform, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the rotation vector and the translation (6,) from the pose at q to X_BF, expressed in B."""
        X = self.pose(q)
        rotation = X_BF.rotation().multiply(X.rotation().inverse()).ToAngleAxis()
        return np.concatenate([rotation.angle() * rotation.axis(), X_BF.translation() - X.translation()])

    def _set(self, q: ArrayLike) -> None:
        # As `set_arm_positions`, which finds the joints anew in each call.
        positions = np.empty(self._plant.num_positions())
        positions[self._selector] = self._arm.linkage.position(q)
        self._plant.SetPositions(self._context, positions)
