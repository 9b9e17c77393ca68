"""Model of an operator's hand: spring and damper between a frame of the arm and a desired pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.trajectories import PiecewisePolynomial, PiecewisePose

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.models.ranges import number_fault, within


@dataclass(frozen=True)
class Grip:
    """Stiffness, damping and limits of a hand's grip.

    The default stiffness has the order of magnitude of human hands: a few hundred N/m (Mussa-Ivaldi, Hogan and Bizzi,
    J. Neurosci. 5, 1985). The default limits are forces that people exert easily.

    Attributes:
        stiffness: Translational stiffness [N/m].
        damping: Translational damping [N s/m].
        rotational_stiffness: Rotational stiffness [N m/rad].
        rotational_damping: Rotational damping [N m s/rad].
        max_force: Largest force [N].
        max_torque: Largest torque [N m].
    """

    stiffness: float = field(default=600.0, metadata=within(1e-6, 1e6, "N/m"))
    damping: float = field(default=25.0, metadata=within(1e-6, 1e5, "N s/m"))
    rotational_stiffness: float = field(default=2.0, metadata=within(1e-6, 1e5, "N m/rad"))
    rotational_damping: float = field(default=0.03, metadata=within(1e-6, 1e4, "N m s/rad"))
    max_force: float = field(default=20.0, metadata=within(1e-6, 2000.0, "N"))
    max_torque: float = field(default=0.6, metadata=within(1e-6, 500.0, "N m"))


class Hand(LeafSystem):
    """Operator's hand. It pulls a frame G of an arm with base B towards a desired pose.

    .. pydrake_system::

        name: Hand
        input_ports:
        - state_estimated
        - X_BG_desired (optional)
        output_ports:
        - effort_disturbance
        - spatial_force

    - `state_estimated` (2n): q, then v of the arm's joints [rad, rad/s; m, m/s on a prismatic joint].
    - `X_BG_desired` (RigidTransform): desired pose of the frame. Unconnected: the hand exerts no force.
    - `effort_disturbance` (n): joint efforts J' F [N m, N], for `ArmStation`'s port of that name.
    - `spatial_force` (6): force F of the hand on the arm at the origin of G, expressed in B: torque [N m], then
      force [N].

    F is the spring and damper force at the end of the next time step, to first order (linearly implicit Euler method):

        (1 + h (D + h K) J M^-1 J') F = K (e - h V) - D V

    - h: time step of the plant
    - e: difference from the present to the desired pose (rotation vector, then translation)
    - V: spatial velocity of the frame, J: its Jacobian (6, n) with respect to the joint velocities
    - M: mass matrix (n, n) of the arm
    - K, D: stiffness and damping

    Therefore a stiff hand causes no numerical oscillations of a light wrist, for any stiffness and damping. As h goes
    to zero, F = K e - D V.

    If the torque or the force exceeds its limit, each is first reduced to at most its limit. Each is then computed
    again with the other one fixed, because a wrist that slips in the hand rotates further during the step. This
    prevents a numerical gain of energy.

    While an input is not finite, the hand exerts no force.
    """

    def __init__(self, arm: Arm, frame_name: str = "", grip: Grip | None = None, time_step: float = 1e-3) -> None:
        """Creates a hand.

        Args:
            arm: Arm that the hand moves.
            frame_name: Name of the frame G in the arm's SDF. Default: `arm.frames.hand`.
            grip: Properties of the grip. None: `Grip()`.
            time_step: Time step h of the plant [s].

        Raises:
            ArmError: The frame does not exist.
            StationError: A number of the grip is out of range, or the time step is not positive.
        """
        super().__init__()
        grip = grip or Grip()
        if fault := number_fault(grip):
            raise StationError(f"grip of the hand: {fault}")
        if not (np.isfinite(time_step) and time_step > 0):
            raise StationError(f"time_step of the hand must be a positive number of seconds; got {time_step}")
        self._frame = ArmFrame(arm, frame_name)
        self._grip, self._time_step = grip, time_step
        self._K = np.repeat([grip.rotational_stiffness, grip.stiffness], 3)
        self._D = np.repeat([grip.rotational_damping, grip.damping], 3)
        self._num_joints = arm.num_joints
        self.DeclareVectorInputPort(name="state_estimated", size=2 * arm.num_joints)
        self.DeclareAbstractInputPort(name="X_BG_desired", model_value=AbstractValue.Make(RigidTransform()))
        inputs = {self.all_input_ports_ticket()}
        self.DeclareVectorOutputPort(
            name="effort_disturbance", size=arm.num_joints, calc=self._calc_effort, prerequisites_of_calc=inputs
        )
        self.DeclareVectorOutputPort(name="spatial_force", size=6, calc=self._calc_force, prerequisites_of_calc=inputs)

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        F, J = self._force_and_jacobian(context)
        output.SetFromVector(J.T @ F)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._force_and_jacobian(context)[0])

    def _force_and_jacobian(self, context: Context) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the spatial force F (6,) and the Jacobian J (6, n)."""
        no_force = np.zeros(6), np.zeros((6, self._num_joints))
        if not self.get_input_port(1).HasValue(context):
            return no_force
        q, v = np.split(self.get_input_port(0).Eval(context), 2)
        X_BG_desired = self.get_input_port(1).Eval(context)
        if not all(np.all(np.abs(x) < IMPLAUSIBLE) for x in (q, v, X_BG_desired.GetAsMatrix34())):
            return no_force
        X_BG, J = self._frame.pose(q), self._frame.jacobian(q)
        rotation = (X_BG_desired.rotation() @ X_BG.rotation().inverse()).ToAngleAxis()
        e = np.concatenate([rotation.angle() * rotation.axis(), X_BG_desired.translation() - X_BG.translation()])
        V, h = J @ v, self._time_step
        mobility = J @ np.linalg.solve(self._frame.mass_matrix(q), J.T)
        A = np.eye(6) + (h * (self._D + h * self._K))[:, None] * mobility
        return self._solve(A, self._K * (e - h * V) - self._D * V), J

    def _solve(self, A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the solution F (6,) of A F = b, within the limits."""
        F = np.asarray(np.linalg.solve(A, b), float)
        torque, force = slice(0, 3), slice(3, 6)
        parts = (torque, force, self._grip.max_torque), (force, torque, self._grip.max_force)
        if any(np.linalg.norm(F[part]) > limit for part, _, limit in parts):
            for part, _, limit in parts:
                F[part] = _limited(F[part], limit)
            for part, other, limit in parts:
                F[part] = _limited(np.linalg.solve(A[part, part], b[part] - A[part, other] @ F[other]), limit)
        return F


def _limited(vector: NDArray[np.floating], limit: float) -> NDArray[np.floating]:
    """Returns `vector`, scaled to the length `limit` if it is longer."""
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)


class PoseTrajectorySource(LeafSystem):
    """Outputs the pose of a trajectory at the time of the context. Outside the time span, the pose is constant.

    .. pydrake_system::

        name: PoseTrajectorySource
        output_ports:
        - pose

    - `pose` (RigidTransform): pose of the trajectory. Drake's TrajectorySource cannot output poses, only vectors.
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
    """Outputs the pose X_BG of a frame G of an arm with base B, for a joint trajectory.

    .. pydrake_system::

        name: HandPath
        output_ports:
        - X_BG_desired

    - `X_BG_desired` (RigidTransform): pose for `Hand`'s port of that name. It is NaN before the start and after the end
      of the trajectory. The hand then exerts no force.
    """

    def __init__(self, arm: Arm, frame_name: str, trajectory: PiecewisePolynomial) -> None:
        """Creates the path.

        Args:
            arm: Arm with n joints.
            frame_name: Name of the frame G in the arm's SDF. If it is empty, the frame is `arm.frames.hand`.
            trajectory: Joint trajectory (n) [rad, m].

        Raises:
            ArmError: The frame does not exist.
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
