"""Simulated teleoperation: a hand moves a master arm in gravity compensation, and another arm follows it."""

from __future__ import annotations

from functools import partial

from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import set_joint_damping
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.hand import Hand
from dvrk_drake.systems.teleoperation import Teleoperation

#: Viscous friction of the simulated master's joints, divided by their effort limits [s].
MASTER_DAMPING = 0.03


class TeleoperatedArms(Diagram):
    """Two simulated arms, coupled by `Teleoperation`.

    .. pydrake_system::

        name: TeleoperatedArms
        input_ports:
        - X_MG_desired (optional)
        - engaged
        - jaw_angle (optional)
        output_ports:
        - mtml.state_estimated
        - psm.state_estimated
        - desired_state
        - following
        - fault

    `mtml` and `psm` are examples: the names are the arms' lower-case names.

    - `X_MG_desired` (RigidTransform): desired pose of the master's handle in the master's base, towards which the hand
      pulls. Unconnected: the hand exerts no force.
    - `engaged`, `jaw_angle`, `desired_state`, `following`, `fault`: ports of `Teleoperation`.
    - `state_estimated`: ports of the two stations.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arms = dvrk.TeleoperatedArms(dvrk.load_arm("mtml"), dvrk.load_arm("psm"), scale=1 / 3)
        >>> arms.CalcX_MG(arms.CreateDefaultContext()).translation().shape  # [m] handle in the master's base
        (3,)
    """

    def __init__(
        self,
        master: Arm,
        follower: Arm,
        *,
        scale: float = 0.3,
        R_FM: RotationMatrix | None = None,
        meshcat: Meshcat | None = None,
    ) -> None:
        """Builds the diagram. The controllers have exact gravity models. The master has viscous joint friction.

        Args:
            master: Arm that the hand moves, e.g. an MTM.
            follower: Arm that follows, e.g. a PSM.
            scale: Ratio of the displacements; see `Teleoperation`.
            R_FM: Rotation from the master's base to the follower's base; see `Teleoperation`.
            meshcat: Meshcat in which both arms are drawn, below paths of their lower-case names. `SetTransform` places
                them.
        """
        super().__init__()
        builder = DiagramBuilder()
        damping = partial(set_joint_damping, arm=master, damping=MASTER_DAMPING * master.effort_limits)
        self.master = ArmStation(master, meshcat=meshcat, modify_plant=damping)
        self.follower = ArmStation(follower, meshcat=meshcat)
        controller = GravityPidController(IdentifiedModel.from_arm(follower))
        add_closed_loop(builder, self.master, GravityPidController(IdentifiedModel.from_arm(master), mode="gravity"))
        add_closed_loop(builder, self.follower, controller)
        self.teleoperation = builder.AddNamedSystem(
            "teleoperation", Teleoperation(master, follower, scale=scale, R_FM=R_FM)
        )
        hand = builder.AddNamedSystem("hand", Hand(master))

        M, F = master.name.lower(), follower.name.lower()
        state_M, state_F = (
            self.master.GetOutputPort(f"{M}.state_estimated"),
            self.follower.GetOutputPort(f"{F}.state_estimated"),
        )
        connect = builder.Connect
        connect(state_M, hand.GetInputPort("state_estimated"))
        connect(hand.GetOutputPort("effort_disturbance"), self.master.GetInputPort(f"{M}.effort_disturbance"))
        connect(self.master.GetOutputPort(f"{M}.position_measured"), self.teleoperation.GetInputPort("master_position"))
        connect(
            self.follower.GetOutputPort(f"{F}.position_measured"), self.teleoperation.GetInputPort("follower_position")
        )
        connect(self.teleoperation.GetOutputPort("desired_state"), controller.GetInputPort("desired_state"))

        builder.ExportInput(hand.GetInputPort("X_BG_desired"), "X_MG_desired")
        for name in ("engaged", "jaw_angle"):
            builder.ExportInput(self.teleoperation.GetInputPort(name), name)
        builder.ExportOutput(state_M, f"{M}.state_estimated")
        builder.ExportOutput(state_F, f"{F}.state_estimated")
        for name in ("desired_state", "following", "fault"):
            builder.ExportOutput(self.teleoperation.GetOutputPort(name), name)
        builder.BuildInto(self)

    def SetPositions(self, context: Context, q_master: ArrayLike, q_follower: ArrayLike) -> None:
        """Sets the poses of both arms, and all velocities to zero. `context` is the context of this system.

        Raises:
            StationError: A pose does not have n finite numbers.
        """
        for station, q in ((self.master, q_master), (self.follower, q_follower)):
            station.SetPositions(self.GetMutableSubsystemContext(station, context), q)

    def CalcX_MG(self, context: Context) -> RigidTransform:
        """Returns the pose of the master's handle in the master's base."""
        return self._pose(self.master, context)

    def CalcX_FT(self, context: Context) -> RigidTransform:
        """Returns the pose of the follower's tip in the follower's base."""
        return self._pose(self.follower, context)

    def _pose(self, station: ArmStation, context: Context) -> RigidTransform:
        plant_context = station.GetSubsystemContext(station.plant, self.GetSubsystemContext(station, context))
        return station.plant.GetFrameByName(station.arm.frames.hand).CalcPoseInWorld(plant_context)
