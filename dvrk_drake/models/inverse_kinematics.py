"""Inverse kinematics of arms whose shaft passes through a remote centre of motion: all solutions within the limits."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint
from pydrake.systems.framework import Context

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.immutable import cached
from dvrk_drake.models.plant import shared_plant, tree_selector

#: Number of start positions of each wrist joint. Within the limits of a wrist, each equation has at most two roots.
_STARTS = 5
#: Largest number of Newton steps, and step of the difference quotients [rad].
_STEPS, _STEP = 30, 1e-6
#: Distance of the shaft from the remote centre [m] at which a Newton iteration has converged.
_CONVERGED = 1e-14
#: Largest error of a solution [m, rad], far above rounding errors.
_TOLERANCE = 1e-9
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
    return _remote_center_arm(arm).solve(X_BF, rest)


@cached
def _remote_center_arm(arm: Arm) -> _RemoteCenterArm:
    return _RemoteCenterArm(arm)


class _RemoteCenterArm:
    """Kinematics of an arm with yaw, pitch, insertion and roll of a shaft, and a wrist."""

    def __init__(self, arm: Arm) -> None:
        self._arm, self._plant = arm, shared_plant(arm)
        self._context, self._selector = self._plant.CreateDefaultContext(), tree_selector(self._plant, arm)
        self._positions = self._plant.GetPositions(self._context)
        frames, joints = arm.frames, [self._plant.GetJointByName(name) for name in arm.joint_names[:4]]
        turns = [isinstance(joint, RevoluteJoint) for joint in joints]
        if not (frames.remote_center and frames.shaft) or turns != [True, True, False, True]:
            raise ArmError(
                f"{arm.name}: the arm has no shaft that yaw, pitch, insertion and roll move about a fixed point"
            )
        self._shaft, self._hand = (self._plant.GetFrameByName(name) for name in (frames.shaft, frames.hand))
        self._set(np.zeros(arm.num_joints))
        self._center = self._plant.GetFrameByName(frames.remote_center).CalcPoseInWorld(self._context).translation()
        yaw, pitch, insertion, roll = (_axis(joint, self._context) for joint in joints)
        X_BS = self._shaft.CalcPoseInWorld(self._context)
        # The axes at the home pose: yaw, pitch and shaft are orthogonal.
        self._axes, self._R_BS = (yaw, pitch), X_BS.rotation().matrix()
        self._roll_sign = float(np.sign(roll @ X_BS.rotation().col(2)))
        self._insertion_sign = float(np.sign(insertion @ X_BS.rotation().col(2)))
        self._home_depth = float((X_BS.translation() - self._center) @ X_BS.rotation().col(2))
        self._wrist = self._moved_joints(np.arange(4, arm.num_joints))

    def _moved_joints(self, joints: NDArray[np.int_]) -> NDArray[np.int_]:
        """Returns the joints behind the shaft that move the hand frame."""
        moving = []
        home = self._hand_in_shaft(np.zeros(self._arm.num_joints)).GetAsMatrix4()
        for joint in joints:
            q = np.zeros(self._arm.num_joints)
            q[joint] = 0.1
            if not np.allclose(self._hand_in_shaft(q).GetAsMatrix4(), home, rtol=0, atol=1e-12):
                moving.append(joint)
        if len(moving) not in (0, 2):
            raise ArmError(
                f"{self._arm.name}: {len(moving)} joints behind the shaft move the hand frame; allowed: 0 or 2"
            )
        return np.array(moving, dtype=int)

    def solve(self, X_BF: RigidTransform, rest: ArrayLike | None) -> NDArray[np.float64]:
        """Returns all poses (k, n), see `inverse_kinematics`."""
        arm = self._arm
        lower, upper = arm.position_lower, arm.position_upper
        base = np.zeros(arm.num_joints) if rest is None else np.asarray(rest, dtype=np.float64)
        if base.shape != (arm.num_joints,):
            raise ArmError(f"{arm.name}: rest has the shape {base.shape}; allowed: ({arm.num_joints},), one per joint")
        base = np.clip(base, lower, upper)
        p_FC = X_BF.inverse() @ self._center
        found: list[NDArray[np.float64]] = []
        for wrist in self._wrist_solutions(p_FC, base) if np.linalg.norm(p_FC) > _AT_CENTER else []:
            q = base.copy()
            q[self._wrist] = wrist
            for of_shaft in self._shaft_solutions(X_BF @ self._hand_in_shaft(q).inverse()):
                q[:4] = of_shaft
                inside = np.all((q >= lower - _SAME) & (q <= upper + _SAME))
                if inside and not any(np.allclose(q, other, rtol=0, atol=_SAME) for other in found):
                    q = np.clip(q, lower, upper)
                    if self._error(q, X_BF) < _TOLERANCE:
                        found.append(q.copy())
        found.sort(key=lambda q: float(np.linalg.norm(q - base)))
        return np.array(found).reshape(-1, arm.num_joints)

    def _wrist_solutions(self, p_FC: NDArray[np.float64], base: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Returns the positions of the wrist joints with which the axis of the shaft passes through the remote centre.

        Newton's method from a grid of positions solves the two equations p_SC_x = p_SC_y = 0 for the position of the
        remote centre C in the frame S of the shaft.
        """
        wrist, q = self._wrist, base.copy()

        def residual(w: NDArray[np.float64]) -> NDArray[np.float64]:
            q[wrist] = w
            return (self._hand_in_shaft(q) @ p_FC)[:2]

        if not len(wrist):
            return [base[wrist]]
        lower, upper = self._arm.position_lower[wrist], self._arm.position_upper[wrist]
        found: list[NDArray[np.float64]] = []
        for start in product(*np.linspace(lower, upper, _STARTS).T):
            w = np.array(start)
            for _ in range(_STEPS):
                r = residual(w)
                if np.linalg.norm(r) < _CONVERGED:
                    break
                J = np.column_stack([(residual(w + e) - residual(w - e)) / (2 * _STEP) for e in _STEP * np.eye(2)])
                if abs(np.linalg.det(J)) < 1e-12:
                    break
                w = w - np.clip(np.linalg.solve(J, r), -0.5, 0.5)
            inside = np.all((w >= lower - _SAME) & (w <= upper + _SAME))
            is_new = not any(np.allclose(w, other, rtol=0, atol=_SAME) for other in found)
            if inside and is_new and np.linalg.norm(residual(w)) < _TOLERANCE:
                found.append(w)
        return found

    def _shaft_solutions(self, X_BS: RigidTransform) -> list[NDArray[np.float64]]:
        """Returns yaw, pitch, insertion and roll for a pose of the shaft, for several turns of the roll."""
        yaw, pitch = self._axes
        d_home, d = self._R_BS[:, 2], X_BS.rotation().col(2)
        depth = float((X_BS.translation() - self._center) @ d)
        insertion = self._insertion_sign * (depth - self._home_depth)
        # The shaft has the direction cos(pitch) d_home + sin(pitch) side before the yaw turns it.
        side = np.cross(pitch, d_home)
        sine = float(np.clip(d @ yaw / (side @ yaw), -1.0, 1.0))
        solutions = []
        for angle in (np.arcsin(sine), np.pi - np.arcsin(sine)):
            before = np.cos(angle) * d_home + sine * side
            first = np.arctan2(np.cross(before, d) @ yaw, before @ d - (before @ yaw) * (d @ yaw))
            R_BS = _rotation(yaw, first) @ _rotation(pitch, angle) @ self._R_BS
            R = R_BS.T @ X_BS.rotation().matrix()
            roll = self._roll_sign * np.arctan2(R[1, 0], R[0, 0])
            turns = 2 * np.pi * np.arange(-2, 3)
            first, second = (float(np.remainder(x + np.pi, 2 * np.pi) - np.pi) for x in (first, angle))
            solutions += [np.array([first, second, insertion, roll + turn]) for turn in turns]
        return solutions

    def _error(self, q: NDArray[np.float64], X_BF: RigidTransform) -> float:
        self._set(q)
        X = self._hand.CalcPoseInWorld(self._context)
        difference = np.abs(X.GetAsMatrix34() - X_BF.GetAsMatrix34())
        return float(difference.max())

    def _hand_in_shaft(self, q: NDArray[np.float64]) -> RigidTransform:
        self._set(q)
        return self._hand.CalcPose(self._context, self._shaft)

    def _set(self, q: NDArray[np.float64]) -> None:
        # As `set_arm_positions`, which finds the joints anew in each call.
        self._positions[self._selector] = self._arm.linkage.position(q)
        self._plant.SetPositions(self._context, self._positions)


def _axis(joint: RevoluteJoint | PrismaticJoint, context: Context) -> NDArray[np.float64]:
    """Returns the axis of a joint in the base frame."""
    R = joint.frame_on_parent().CalcPoseInWorld(context).rotation()
    return np.asarray(R @ (joint.translation_axis() if isinstance(joint, PrismaticJoint) else joint.revolute_axis()))


def _rotation(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Returns the rotation matrix about an axis (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
