"""Poses that a hand follows: along a trajectory of poses, or where an arm's joints follow a trajectory."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem
from pydrake.trajectories import PiecewisePolynomial, PiecewisePose

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.models.arm import Arm


class PoseTrajectorySource(LeafSystem):
    """Gives the pose of a trajectory at the context's time; before it and after it, that of its end.

    .. pydrake_system::

        name: PoseTrajectorySource
        output_ports:
        - pose

    - `pose` (RigidTransform). Drake's TrajectorySource gives vectors only.
    """

    def __init__(self, trajectory: PiecewisePose) -> None:
        super().__init__()
        self._trajectory = trajectory
        self.DeclareAbstractOutputPort(
            name="pose",
            alloc=lambda: AbstractValue.Make(RigidTransform()),
            calc=self._calc_pose,
            prerequisites_of_calc={self.time_ticket()},
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        time = min(max(context.get_time(), self._trajectory.start_time()), self._trajectory.end_time())
        output.set_value(self._trajectory.GetPose(time))


class HandPath(LeafSystem):
    """The pose X_BG that a frame G of an arm with base B has where its joints follow a trajectory.

    .. pydrake_system::

        name: HandPath
        output_ports:
        - X_BG_desired

    - `X_BG_desired` (RigidTransform): for `Hand`'s port of that name. Before the trajectory starts and after its end it
      is not a number: the hand has let go.
    """

    def __init__(self, arm: Arm, frame_name: str, trajectory: PiecewisePolynomial) -> None:
        """Of the frame that `arm`'s SDF names so, along `trajectory` (n) of its joints [rad, m].

        Raises:
            ArmError: no such frame.
        """
        super().__init__()
        self._frame, self._trajectory = ArmFrame(arm, frame_name), trajectory
        self.DeclareAbstractOutputPort(
            name="X_BG_desired",
            alloc=lambda: AbstractValue.Make(RigidTransform()),
            calc=self._calc_pose,
            prerequisites_of_calc={self.time_ticket()},
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        time, trajectory = context.get_time(), self._trajectory
        if trajectory.start_time() <= time <= trajectory.end_time():
            output.set_value(self._frame.pose(trajectory.value(time).ravel()))
        else:
            output.set_value(RigidTransform(np.full(3, np.nan)))
