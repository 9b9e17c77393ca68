"""Simulated teleoperation: a hand moves a master arm in gravity compensation, and another arm follows it.

The force on the follower can be reflected to the master.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.primitives import Adder, DiscreteTimeDelay

from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import Contact
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import set_joint_damping
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.external_force_estimator import ExternalForceEstimator
from dvrk_drake.systems.force_feedback import ForceFeedback
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.hand import Hand
from dvrk_drake.systems.teleoperation import Teleoperation

#: Period of the controllers and of messages [s].
PERIOD = 1e-3
#: Viscous friction of the simulated master's joints, divided by their effort limits [s].
MASTER_DAMPING = 0.03
#: Stated error of `exact_model`, as a share of the effort limits. The simulated follower has no friction and no noise.
_EXACT_ERROR = 0.002


def exact_model(arm: Arm) -> IdentifiedModel:
    """Returns the model of a simulated arm without effects, with small stated errors."""
    model = IdentifiedModel.from_arm(arm, dynamics=True)
    assert model.dynamics is not None
    errors = [
        ActuatorStatistics(name, limit, rms_cross_validation=_EXACT_ERROR * limit)
        for name, limit in zip(arm.joint_names, arm.effort_limits.tolist(), strict=True)
    ]
    return replace(model, dynamics=replace(model.dynamics, effects=[], actuators=errors))


class Wall(LeafSystem):
    """Elastic half-space that pushes the tip of an arm out: a spring and a damper that do not pull.

    .. pydrake_system::

        name: Wall
        input_ports:
        - state_true
        output_ports:
        - effort_disturbance
        - force

    - `state_true`, `effort_disturbance`: ports of an `ArmStation` with n joints.
    - `force` (3): force on the tip, the origin of `arm.frames.hand`, in the base frame [N].

    Example:
        >>> import dvrk_drake as dvrk
        >>> wall = dvrk.Wall(dvrk.load_arm("psm"), point=[0, 0, -0.15], normal=[0, 0, 1])
        >>> context = wall.CreateDefaultContext()
        >>> home = wall.GetInputPort("state_true").FixValue(context, [0.0] * 14)  # the tip is above the surface
        >>> wall.GetOutputPort("force").Eval(context).tolist()
        [0.0, 0.0, 0.0]
    """

    def __init__(
        self, arm: Arm, point: ArrayLike, normal: ArrayLike, *, stiffness: float = 2000.0, damping: float = 5.0
    ) -> None:
        """Creates a wall.

        Args:
            arm: Arm with n joints.
            point: Point (3,) on the surface, in the base frame [m].
            normal: Normal (3,) of the surface out of the wall, in the base frame.
            stiffness: Stiffness [N/m].
            damping: Damping [N s/m].
        """
        super().__init__()
        self._tip, self._point = Contact(arm), np.array(point, float)
        self._normal = np.array(normal, float) / np.linalg.norm(normal)
        self._stiffness, self._damping, self._n = stiffness, damping, arm.num_joints
        self.DeclareVectorInputPort("state_true", 2 * self._n)
        self.DeclareVectorOutputPort("effort_disturbance", self._n, self._calc_effort)
        self.DeclareVectorOutputPort("force", 3, self._calc_force)

    def _force(self, context: Context) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the force (3,), and the Jacobian (3, n) of the tip."""
        q, v = np.split(self.get_input_port().Eval(context), 2)
        J, depth = self._tip.jacobian(q), self._normal @ (self._point - self._tip.point(q))
        size = self._stiffness * depth - self._damping * (self._normal @ J @ v) if depth > 0 else 0.0
        return max(size, 0.0) * self._normal, J

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        force, J = self._force(context)
        output.SetFromVector(J.T @ force)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._force(context)[0])


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
        - force
        - force_covariance
        - feedback_effort
        - feedback_energy
        - feedback_active

    `mtml` and `psm` are examples: the names are the arms' lower-case names.

    - `X_MG_desired` (RigidTransform): desired pose of the master's handle in the master's base, towards which the hand
      pulls. Unconnected: the hand exerts no force.
    - `engaged`, `jaw_angle`, `desired_state`, `following`, `fault`: ports of `Teleoperation`.
    - `state_estimated`: ports of the two stations.
    - `force`, `force_covariance`: ports of the follower's `ExternalForceEstimator`, in the follower's base.
      `feedback_effort`, `feedback_energy`, `feedback_active`: ports of `ForceFeedback`. Only with a `force_model`.

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
        force_model: IdentifiedModel | Literal["exact"] | None = None,
        wall: Wall | None = None,
        delay: float = 0.0,
    ) -> None:
        """Builds the diagram. The controllers have exact gravity models. The master has viscous joint friction.

        Args:
            master: Arm that the hand moves, e.g. an MTM.
            follower: Arm that follows, e.g. a PSM.
            scale: Ratio of the displacements; see `Teleoperation`.
            R_FM: Rotation from the master's base to the follower's base; see `Teleoperation`.
            meshcat: Meshcat in which both arms are drawn, below paths of their lower-case names. `SetTransform` places
                them.
            force_model: Model of the follower with which its external force is estimated and reflected to the master.
                "exact": the exact model. None: no force feedback.
            wall: Object that the follower's tip can touch. None: there is no object.
            delay: Delay of the messages in each direction [s], a multiple of 1 ms.
        """
        super().__init__()
        builder = DiagramBuilder()

        def delayed(port: OutputPort) -> OutputPort:
            if delay == 0.0:
                return port
            steps = DiscreteTimeDelay(PERIOD, round(delay / PERIOD), port.size())
            builder.Connect(port, builder.AddSystem(steps).get_input_port())
            return steps.get_output_port()

        damping = partial(set_joint_damping, arm=master, damping=MASTER_DAMPING * master.effort_limits)
        self.master = ArmStation(master, meshcat=meshcat, modify_plant=damping)
        self.follower = ArmStation(follower, meshcat=meshcat)
        controller = GravityPidController(IdentifiedModel.from_arm(follower))
        compensation = GravityPidController(IdentifiedModel.from_arm(master), mode="gravity")
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
        builder.AddSystem(self.master)
        builder.AddSystem(compensation)
        connect(state_M, compensation.GetInputPort("state_estimated"))
        connect(state_M, hand.GetInputPort("state_estimated"))
        connect(hand.GetOutputPort("effort_disturbance"), self.master.GetInputPort(f"{M}.effort_disturbance"))
        position_M = delayed(self.master.GetOutputPort(f"{M}.position_measured"))
        connect(position_M, self.teleoperation.GetInputPort("master_position"))
        connect(
            self.follower.GetOutputPort(f"{F}.position_measured"), self.teleoperation.GetInputPort("follower_position")
        )
        connect(self.teleoperation.GetOutputPort("desired_state"), controller.GetInputPort("desired_state"))

        builder.ExportInput(hand.GetInputPort("X_BG_desired"), "X_MG_desired")
        for name in ("engaged", "jaw_angle"):
            builder.ExportInput(self.teleoperation.GetInputPort(name), name)
        effort_M = compensation.GetOutputPort("effort")
        if force_model is not None:
            model = exact_model(follower) if force_model == "exact" else force_model
            estimator = builder.AddNamedSystem("estimator", ExternalForceEstimator(model, same_day=True))
            feedback = builder.AddNamedSystem("feedback", ForceFeedback(master, R_FM=R_FM))
            connect(state_F, estimator.GetInputPort("state_estimated"))
            connect(self.follower.GetOutputPort(f"{F}.effort_measured"), estimator.GetInputPort("effort_measured"))
            for name in ("force", "measurable", "fault"):
                connect(delayed(estimator.GetOutputPort(name)), feedback.GetInputPort(name))
            connect(self.teleoperation.GetOutputPort("following"), feedback.GetInputPort("following"))
            connect(state_M, feedback.GetInputPort("master_state"))
            builder.ConnectInput("engaged", feedback.GetInputPort("engaged"))
            total = builder.AddSystem(Adder(2, master.num_joints))
            for port, source in enumerate((effort_M, feedback.GetOutputPort("effort"))):
                connect(source, total.get_input_port(port))
            effort_M = total.get_output_port()
            for name in ("force", "force_covariance"):
                builder.ExportOutput(estimator.GetOutputPort(name), name)
            for name in ("effort", "energy", "active"):
                builder.ExportOutput(feedback.GetOutputPort(name), f"feedback_{name}")
        connect(effort_M, self.master.GetInputPort(f"{M}.effort_commanded"))
        if wall is not None:
            builder.AddSystem(wall)
            connect(self.follower.GetOutputPort(f"{F}.state_true"), wall.get_input_port())
            connect(wall.GetOutputPort("effort_disturbance"), self.follower.GetInputPort(f"{F}.effort_disturbance"))
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
