"""A pose that follows a trajectory."""

from __future__ import annotations

from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem
from pydrake.trajectories import PiecewisePose


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
