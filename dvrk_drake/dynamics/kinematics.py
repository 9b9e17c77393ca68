"""Forward kinematics of a frame of an arm, and closed-form inverse kinematics of the PSM."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FrameIndex, JacobianWrtVariable

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant, tree_selector


def handle_frame(arm: Arm) -> str:
    """Returns the name of the last DH frame: dh_7 (handle) for an MTM, dh_6 for a PSM.

    Raises:
        ArmError: The SDF has no frames dh_0, dh_1, ...
    """
    numbered = [name for name in _frame_names(shared_plant(arm)) if re.fullmatch(r"dh_\d+", name)]
    if not numbered:
        raise ArmError(f"{arm.name}: the SDF has no frames dh_0, dh_1, ...; give the name of the handle's frame")
    return max(numbered, key=lambda name: int(name.removeprefix("dh_")))


class ArmFrame:
    """Kinematics of a frame F of an arm with base frame B.

    Joint positions q have shape (n,) [rad; m for a prismatic joint]. Threads must not share an `ArmFrame`.
    """

    def __init__(self, arm: Arm, frame_name: str) -> None:
        """Creates the kinematics of a frame of the SDF, e.g. "dh_7".

        Raises:
            ArmError: The SDF has no such frame.
        """
        self._arm = arm
        self._plant = shared_plant(arm)
        if not self._plant.HasFrameNamed(frame_name):
            known = ", ".join(_frame_names(self._plant))
            raise ArmError(f'{arm.name}: the SDF has no frame "{frame_name}"; available frames: {known}')
        self._frame = self._plant.GetFrameByName(frame_name)
        self._context = self._plant.CreateDefaultContext()
        # G maps velocities of the independent joints to velocities of the plant.
        self._G = np.zeros((self._plant.num_velocities(), arm.num_joints))
        self._G[tree_selector(self._plant, arm)] = arm.linkage.matrix

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

    def _set(self, q: ArrayLike) -> None:
        set_arm_positions(self._plant, self._context, self._arm, q)


def _frame_names(plant: MultibodyPlant) -> list[str]:
    """Returns the names of the DH frames in the SDF."""
    frames = (plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames()))
    return [frame.name() for frame in frames if frame.name().startswith("dh_")]


class PsmInverseKinematics:
    """Closed-form inverse kinematics of a PSM for the pose of a frame on its wrist yaw link.

    The solution is unique, except for full revolutions of the roll, if two conditions hold. The wrist centre is beyond
    the remote centre of motion (RCM), and |wrist_pitch| < 90 degrees.

    The wrist centre is the intersection of the shaft and the wrist pitch axis. Here, the tip is the origin of the wrist
    yaw link, which lies on the wrist yaw axis. The wrist link connects these two points and has the length L. It lies
    in a plane with the shaft and is perpendicular to the yaw axis. Therefore its direction d is the direction of the
    tip position p_tip, relative to the RCM, without the component along the yaw axis. The wrist centre p_tip - L d lies
    on the shaft, which passes through the RCM. The position of the wrist centre determines yaw, pitch and insertion.
    The remaining rotation consists of the roll about z, the wrist pitch about x and the wrist yaw about y.

    Lengths and the pose of the frame on its link are read from the arm's SDF.
    """

    def __init__(self, arm: Arm, frame_name: str = "dh_6", min_depth: float = 1e-3) -> None:
        """Creates the inverse kinematics of a frame.

        Args:
            arm: PSM.
            frame_name: Name of a frame on the wrist yaw link.
            min_depth: Minimum distance of the wrist centre beyond the RCM [m], greater than 0. Near the RCM, yaw and
                pitch change fast, and at the RCM they are not determined.

        Raises:
            ArmError: The arm does not have the kinematics of a PSM.
        """
        not_a_psm = ArmError(f"{arm.name} does not have the kinematics of a PSM with roll, wrist pitch and wrist yaw")
        if arm.num_joints < 6:
            raise not_a_psm
        plant = shared_plant(arm)
        context = plant.CreateDefaultContext()
        _, pitch_link, yaw_link = (plant.GetJointByName(name).child_body() for name in arm.joint_names[3:6])
        p_BWrist = pitch_link.EvalPoseInWorld(context).translation()
        p_BYaw = yaw_link.EvalPoseInWorld(context).translation()
        #: Distance of the wrist centre beyond the RCM at zero insertion [m].
        self.depth_at_zero = -p_BWrist[2]
        #: Distance between the wrist pitch axis and the wrist yaw axis [m].
        self.wrist_length = p_BWrist[2] - p_BYaw[2]
        self._min_depth = min_depth
        frame = ArmFrame(arm, frame_name)
        self._X_LF = plant.GetFrameByName(frame_name).GetFixedPoseInBodyFrame()
        # The formulas assume certain joint axes. Verify them at one pose.
        q = np.clip(
            [0.3, -0.2, 0.1, 0.5, -0.4, 0.6, *np.zeros(arm.num_joints - 6)], arm.position_lower, arm.position_upper
        )
        solution = self.solve(frame.pose(q), q)
        if solution is None or not np.allclose(solution, q[:6], rtol=0, atol=1e-9):
            raise not_a_psm

    def solve(self, X_BF: RigidTransform, q_near: ArrayLike) -> NDArray[np.float64] | None:
        """Returns the joint positions (6,) [rad, m], or None if there is no solution.

        There is no solution if the wrist centre is closer to the RCM than `min_depth`, or if the wrist pitch is 90
        degrees or more. Solutions with |yaw| > 135 degrees, for which the tip is above the RCM, are rejected. Joint
        limits are not checked.

        Args:
            X_BF: Pose of the frame in the base frame.
            q_near: Joint positions (n,). The returned roll differs from the roll of `q_near` by at most half a
                revolution.
        """
        X_BL = X_BF @ self._X_LF.inverse()
        R_BL, p_BL = X_BL.rotation().matrix(), X_BL.translation()
        yaw_axis = R_BL[:, 1]
        d = p_BL - (p_BL @ yaw_axis) * yaw_axis
        distance = np.linalg.norm(d)
        if distance <= self.wrist_length:
            return None
        p_wrist = (1 - self.wrist_length / distance) * d + (p_BL @ yaw_axis) * yaw_axis
        depth = np.linalg.norm(p_wrist)
        if depth < self._min_depth:
            return None
        u = p_wrist / depth
        yaw, pitch = np.arctan2(u[0], -u[2]), np.arctan2(-u[1], np.hypot(u[0], u[2]))
        if abs(yaw) > 0.75 * np.pi:
            return None
        s1, c1, s2, c2 = np.sin(yaw), np.cos(yaw), np.sin(pitch), np.cos(pitch)
        R_BS = np.array([[c1, s1 * s2, -s1 * c2], [0, c2, s2], [s1, -c1 * s2, c1 * c2]])
        R = R_BS.T @ R_BL  # = Rz(-roll) Rx(-wrist_pitch) Ry(-wrist_yaw)
        roll = np.arctan2(R[0, 1], R[1, 1])
        roll += 2 * np.pi * np.round((np.asarray(q_near, float)[3] - roll) / (2 * np.pi))
        wrist_pitch = np.arctan2(-R[2, 1], np.hypot(R[2, 0], R[2, 2]))
        wrist_yaw = np.arctan2(R[2, 0], R[2, 2])
        return np.array([yaw, pitch, depth - self.depth_at_zero, roll, wrist_pitch, wrist_yaw])
