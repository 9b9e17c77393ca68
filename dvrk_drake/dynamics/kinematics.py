"""Forward and inverse kinematics of a frame of an arm, and the force at a point of contact."""

from __future__ import annotations

from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.eigen_geometry import AngleAxis
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


#: Number of start positions of each wrist joint. Within the limits of a wrist, each equation has at most two roots.
#: Five starts find no other solutions for 120 random poses of a PSM with a needle driver and with a stapler.
_STARTS = 3
#: Distance of the hand frame from the remote centre [m] below which yaw, pitch and roll are not determined.
_AT_CENTER = 1e-6
#: Distance of two solutions that are equal [rad, m].
_SAME = 1e-7


def inverse_kinematics(arm: Arm, X_BF: RigidTransform, rest: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns all poses (k, n) within the limits in which the hand frame F has a pose in the base frame.

    The arm moves its shaft with yaw, pitch, insertion and roll, and has no or two wrist joints behind it, as an ECM and
    a PSM with any instrument. The position error is less than 1e-9 m. `ArmFrame.solve` finds one solution near a
    pose, for every arm. Threads must not share an arm.

    Args:
        arm: Arm with the frames `remote_center` and `shaft`.
        X_BF: Pose of the frame `arm.frames.hand` in the base frame.
        rest: Pose (n,) with the positions of joints that do not move the hand frame, e.g. the jaw [rad, m]. None: zero,
            or the limit nearest to zero.

    Returns:
        Poses, ordered by their distance from `rest`. There is none if the pose is not reachable, or if its origin is at
        the remote centre, where the solution is not unique.

    Raises:
        ArmError: The arm has no such shaft, or `rest` has another number of elements.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pydrake.math import RigidTransform, RollPitchYaw
        >>> arm = dvrk.load_arm("psm_si", "PROGRASP_FORCEPS_420093")
        >>> poses = dvrk.inverse_kinematics(arm, RigidTransform(RollPitchYaw(3.1, 0.2, 1.5), [0.02, 0.03, -0.12]))
        >>> [round(float(q), 3) for q in poses[0]]
        [0.167, -0.282, 0.131, 0.04, 0.491, -0.117, 0.0]
    """
    hand, shaft = ArmFrame(arm), _Shaft(arm)
    lower, upper = arm.position_lower, arm.position_upper
    base = np.zeros(arm.num_joints) if rest is None else np.asarray(rest, dtype=np.float64)
    if base.shape != (arm.num_joints,):
        raise ArmError(f"{arm.name}: rest has the shape {base.shape}; allowed: ({arm.num_joints},), one per joint")
    base = np.clip(base, lower, upper)
    wrists = product(*np.linspace(lower[shaft.wrist], upper[shaft.wrist], _STARTS).T)
    found: list[NDArray[np.float64]] = []
    for wrist in wrists if np.linalg.norm(X_BF.inverse() @ shaft.center) > _AT_CENTER else ():
        q = base.copy()
        q[shaft.wrist] = wrist
        # The shaft with this wrist misses the remote centre in general, but is near a solution for some of the starts.
        for of_shaft in shaft.positions(X_BF @ hand.pose(q).inverse() @ shaft.pose(q)):
            q[:4] = of_shaft
            solution = hand.solve(X_BF, q)
            for turn in 2 * np.pi * np.arange(-2, 3) if solution is not None else ():
                turned = solution + turn * np.eye(arm.num_joints)[3]
                inside = np.all((turned >= lower - _SAME) & (turned <= upper + _SAME))
                if inside and not any(np.allclose(turned, other, rtol=0, atol=_SAME) for other in found):
                    found.append(np.clip(turned, lower, upper))
    found.sort(key=lambda q: float(np.linalg.norm(q - base)))
    return np.array(found).reshape(-1, arm.num_joints)


class _Shaft(ArmFrame):
    """Shaft that yaw, pitch, insertion and roll move about a remote centre.

    Attributes:
        center: Position (3,) of the remote centre in the base frame [m].
        wrist: Indices of the joints behind the shaft that move the hand frame.
    """

    def __init__(self, arm: Arm) -> None:
        super().__init__(arm, arm.frames.shaft)
        home = np.zeros(arm.num_joints)
        axes = self.jacobian(home).T[:4]
        is_complete = bool(arm.frames.remote_center and arm.frames.shaft)
        if not (is_complete and np.allclose(np.linalg.norm(axes[:, :3], axis=1), [1, 1, 0, 1], rtol=0, atol=1e-9)):
            raise ArmError(
                f"{arm.name}: the arm has no shaft that yaw, pitch, insertion and roll move about a fixed point"
            )
        moves_hand = np.any(np.abs(ArmFrame(arm).jacobian(home)) > 1e-9, axis=0)
        self.wrist = np.flatnonzero(moves_hand & (np.arange(arm.num_joints) >= 4))
        if len(self.wrist) not in (0, 2):
            count = len(self.wrist)
            raise ArmError(f"{arm.name}: {count} joints behind the shaft move the hand frame; allowed: 0 or 2")
        self.center = ArmFrame(arm, arm.frames.remote_center).pose(home).translation()
        X_BS = self.pose(home)
        self._R_BS, self._yaw, self._pitch = X_BS.rotation().matrix(), axes[0, :3], axes[1, :3]
        along = self._R_BS[:, 2]
        self._insertion_sign, self._roll_sign = np.sign(axes[2, 3:] @ along), np.sign(axes[3, :3] @ along)
        self._home_depth = float((X_BS.translation() - self.center) @ along)

    def positions(self, X_BS: RigidTransform) -> list[NDArray[np.float64]]:
        """Returns both solutions (4,) for yaw, pitch, insertion and roll, with which the shaft has a pose."""
        yaw, pitch = self._yaw, self._pitch
        d_home, d = self._R_BS[:, 2], X_BS.rotation().col(2)
        depth = float((X_BS.translation() - self.center) @ d)
        insertion = self._insertion_sign * (depth - self._home_depth)
        # The shaft has the direction cos(pitch) d_home + sin(pitch) side before the yaw turns it.
        side = np.cross(pitch, d_home)
        sine = float(np.clip(d @ yaw / (side @ yaw), -1.0, 1.0))
        solutions = []
        for angle in (np.arcsin(sine), np.pi - np.arcsin(sine)):
            before = np.cos(angle) * d_home + sine * side
            first = np.arctan2(np.cross(before, d) @ yaw, before @ d - (before @ yaw) * (d @ yaw))
            R_BS = AngleAxis(first, yaw).rotation() @ AngleAxis(angle, pitch).rotation() @ self._R_BS
            R = R_BS.T @ X_BS.rotation().matrix()
            roll = self._roll_sign * np.arctan2(R[1, 0], R[0, 0])
            # The limits of yaw and pitch are within a half turn.
            first, second = (np.remainder(x + np.pi, 2 * np.pi) - np.pi for x in (first, angle))
            solutions.append(np.array([first, second, insertion, roll]))
        return solutions


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
