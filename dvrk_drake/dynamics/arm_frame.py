"""One frame of an arm as a function of the independent joints alone, linkage included: pose, Jacobian, inertia."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FrameIndex, JacobianWrtVariable

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions, tree_selector


def handle_frame(arm: Arm) -> str:
    """Name of the frame that a hand takes an arm at: the last of its DH frames, dh_7 of an MTM, dh_6 of a PSM.

    Raises:
        ArmError: the SDF has no frame dh_0, dh_1, ...
    """
    numbered = [name for name in _frame_names(make_arm_plant(arm)) if re.fullmatch(r"dh_\d+", name)]
    if not numbered:
        raise ArmError(f"{arm.name}: its SDF has no frames dh_0, dh_1, ...; name the handle's frame")
    return max(numbered, key=lambda name: int(name.removeprefix("dh_")))


class ArmFrame:
    """A frame F of an arm with base frame B; poses q are (n,), in the arm's order [rad; m on a prismatic joint].

    It owns a plant and its context, so it is not to be shared between threads.
    """

    def __init__(self, arm: Arm, frame_name: str) -> None:
        """Of the frame that the arm's SDF names so, e.g. "dh_7".

        Raises:
            ArmError: the SDF has no such frame.
        """
        self._arm = arm
        self._plant = make_arm_plant(arm)
        if not self._plant.HasFrameNamed(frame_name):
            known = ", ".join(_frame_names(self._plant))
            raise ArmError(f'{arm.name}: its SDF has no frame "{frame_name}"; it has {known}')
        self._frame = self._plant.GetFrameByName(frame_name)
        self._context = self._plant.CreateDefaultContext()
        # G maps rates of the independent joints to those of the plant's.
        self._G = np.zeros((self._plant.num_velocities(), arm.num_joints))
        self._G[tree_selector(self._plant, arm)] = arm.linkage.matrix

    def pose(self, q: ArrayLike) -> RigidTransform:
        """X_BF."""
        self._set(q)
        return self._frame.CalcPoseInWorld(self._context)

    def jacobian(self, q: ArrayLike) -> NDArray[np.float64]:
        """J (6, n) with V_BF = J v: angular velocity [rad/s], then that of F's origin [m/s], in B."""
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
    """Of the frames that the SDF names beside its links."""
    frames = (plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames()))
    return [frame.name() for frame in frames if frame.name().startswith("dh_")]
