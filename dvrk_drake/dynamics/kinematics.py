"""Kinematics of an arm: pose and Jacobian of one frame, and the PSM's inverse kinematics in closed form."""

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
    """Returns the name of the handle's frame, the last DH frame: dh_7 for an MTM, dh_6 for a PSM.

    Raises:
        ArmError: the SDF has no frame dh_0, dh_1, ...
    """
    numbered = [name for name in _frame_names(shared_plant(arm)) if re.fullmatch(r"dh_\d+", name)]
    if not numbered:
        raise ArmError(f"{arm.name}: its SDF has no frames dh_0, dh_1, ...; give the name of the handle's frame")
    return max(numbered, key=lambda name: int(name.removeprefix("dh_")))


class ArmFrame:
    """A frame F of an arm with base frame B; poses q are (n,), in the arm's order [rad; m on a prismatic joint].

    It owns a context of the arm's plant, so threads must not share it.
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
            raise ArmError(f'{arm.name}: its SDF has no frame "{frame_name}"; it has {known}')
        self._frame = self._plant.GetFrameByName(frame_name)
        self._context = self._plant.CreateDefaultContext()
        # G maps rates of the independent joints to those of the plant's.
        self._G = np.zeros((self._plant.num_velocities(), arm.num_joints))
        self._G[tree_selector(self._plant, arm)] = arm.linkage.matrix

    def pose(self, q: ArrayLike) -> RigidTransform:
        """Returns the pose X_BF."""
        self._set(q)
        return self._frame.CalcPoseInWorld(self._context)

    def jacobian(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns J (6, n) with V_BF = J v: angular velocity [rad/s], then velocity of F's origin [m/s], in B."""
        self._set(q)
        world = self._plant.world_frame()
        J = self._plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._frame, np.zeros(3), world, world
        )
        return J @ self._G

    def mass_matrix(self, q: ArrayLike) -> NDArray[np.float64]:
        """Mass matrix (n, n) of the independent joints, with all that moves along: G' M G."""
        self._set(q)
        return self._G.T @ self._plant.CalcMassMatrix(self._context) @ self._G

    def _set(self, q: ArrayLike) -> None:
        set_arm_positions(self._plant, self._context, self._arm, q)


def _frame_names(plant: MultibodyPlant) -> list[str]:
    """Returns the names of the DH frames in the SDF."""
    frames = (plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames()))
    return [frame.name() for frame in frames if frame.name().startswith("dh_")]


class PsmInverseKinematics:
    """Joint positions of a PSM whose tip (the wrist yaw frame) is at a given pose.

    With the instrument inserted beyond the remote centre of motion (RCM) and |wrist_pitch| < 90 degrees there is one
    solution, up to turns of the roll. The shaft's line passes through the RCM; the link between the two wrist axes, of
    length L, lies in one plane with it and is perpendicular to the yaw axis. So the direction d from the pitch axis to
    the yaw axis is that of the tip's position without its part along the yaw axis; p_wrist = p_tip - L d lies on the
    shaft and gives yaw, pitch and insertion; what rotation remains is roll, wrist pitch and wrist yaw about z, x, y.

    Lengths and the fixed tip frame are read from the arm's SDF.
    """

    def __init__(self, arm: Arm, frame_name: str = "dh_6", min_depth: float = 1e-3) -> None:
        """Creates the inverse kinematics of `arm` for a frame on its wrist yaw link.

        Args:
            arm: a PSM.
            frame_name: the tip.
            min_depth: how far beyond the RCM the wrist centre must be to have a solution [m], above 0: at the RCM yaw
            and pitch are not determined, near it they whirl.

        Raises:
            ArmError: the arm has not the kinematics of a PSM.
        """
        not_a_psm = ArmError(f"{arm.name} does not have the kinematics of a PSM with roll, wrist pitch and wrist yaw")
        if arm.num_joints < 6:
            raise not_a_psm
        plant = shared_plant(arm)
        context = plant.CreateDefaultContext()
        _, pitch_link, yaw_link = (plant.GetJointByName(name).child_body() for name in arm.joint_names[3:6])
        p_BWrist = pitch_link.EvalPoseInWorld(context).translation()
        p_BYaw = yaw_link.EvalPoseInWorld(context).translation()
        #: Wrist centre below the RCM [m] at insertion 0; length between the wrist axes [m].
        self.depth_at_zero, self.wrist_length = -p_BWrist[2], p_BWrist[2] - p_BYaw[2]
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
        """Joint positions (6,) [rad, m], not limited to the arm's range; the roll is that turn which is nearest to
        q_near's.

        None where the wrist centre would be nearer to the RCM than min_depth, the wrist pitch 90 degrees or more, or
        the shaft point more than 45 degrees upward (|yaw| > 135 degrees): that is what a tip above the RCM comes to.
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
