"""A person's hand on an arm: a spring and damper between a frame of the arm and the path that the hand follows."""

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
from dvrk_drake.models.schema_fault import number_fault, within


@dataclass(frozen=True)
class Grip:
    """How firmly a hand holds.

    The defaults are of the order that is measured of people: some hundred N/m at the hand (Mussa-Ivaldi, Hogan and
    Bizzi, J. Neurosci. 5, 1985). Limits are what a person exerts without effort.

    Attributes:
        stiffness: of the position [N/m].
        damping: of the position [N s/m].
        rotational_stiffness: [N m/rad].
        rotational_damping: [N m s/rad].
        max_force: [N].
        max_torque: [N m].
    """

    stiffness: float = field(default=600.0, metadata=within(1e-6, 1e6, "N/m"))
    damping: float = field(default=25.0, metadata=within(1e-6, 1e5, "N s/m"))
    rotational_stiffness: float = field(default=2.0, metadata=within(1e-6, 1e5, "N m/rad"))
    rotational_damping: float = field(default=0.03, metadata=within(1e-6, 1e4, "N m s/rad"))
    max_force: float = field(default=20.0, metadata=within(1e-6, 2000.0, "N"))
    max_torque: float = field(default=0.6, metadata=within(1e-6, 500.0, "N m"))


class Hand(LeafSystem):
    """Pulls a frame G of an arm with base B towards a pose, as a person who holds it there.

    .. pydrake_system::

        name: Hand
        input_ports:
        - state_estimated
        - X_BG_desired (optional)
        output_ports:
        - effort_disturbance
        - spatial_force

    - `state_estimated` (2n): q, then v of the arm's joints [rad, rad/s; m, m/s on a prismatic joint].
    - `X_BG_desired` (RigidTransform): where the hand wants the frame. Unconnected: the hand has let go.
    - `effort_disturbance` (n): J' F [N m, N], for `ArmStation`'s port of that name.
    - `spatial_force` (6): F_G_B, torque [N m], then force [N] of the hand on the arm at G's origin, in B.

    Spring and damper are taken at the end of the coming step, to first order (linearly implicit Euler):
    (1 + h (D + h K) J M^-1 J') F = K (e - h V) - D V, with h the station's time step, e the way to the desired pose
    (rotation vector, then translation), V the frame's velocity and M the arm's mass matrix. So a stiff hand does not
    shake a light wrist, whatever its gains: as h goes to zero it is F = K e - D V. Where torque or force is beyond its
    limit, both are limited, and then each is solved again with the other as it is: a wrist that slips in the hand turns
    further in the step, which the force must know. So the hand gives no more energy than was put into it.

    With a state or pose that is not finite the hand lets go.
    """

    def __init__(self, arm: Arm, frame_name: str = "dh_7", grip: Grip | None = None, time_step: float = 1e-3) -> None:
        """On the frame of `arm`'s SDF of that name.

        Args:
            arm: whose station it pulls.
            frame_name: the frame G; by default an MTM's handle.
            grip: how firmly; the default of `Grip` if none is given.
            time_step: h, of the station's plant [s].

        Raises:
            ArmError: no such frame.
            StationError: a number of the grip, or the time step, that is not positive.
        """
        super().__init__()
        grip = grip or Grip()
        if fault := number_fault(grip):
            raise StationError(f"a hand's {fault}")
        if not (np.isfinite(time_step) and time_step > 0):
            raise StationError(f"a hand's time_step must be a positive number; got {time_step}")
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
        """F_G_B (6,) and J (6, n)."""
        nothing = np.zeros(6), np.zeros((6, self._num_joints))
        if not self.get_input_port(1).HasValue(context):
            return nothing
        q, v = np.split(self.get_input_port(0).Eval(context), 2)
        X_BG_desired = self.get_input_port(1).Eval(context)
        if not all(np.all(np.abs(x) < IMPLAUSIBLE) for x in (q, v, X_BG_desired.GetAsMatrix34())):
            return nothing
        X_BG, J = self._frame.pose(q), self._frame.jacobian(q)
        turn = (X_BG_desired.rotation() @ X_BG.rotation().inverse()).ToAngleAxis()
        e = np.concatenate([turn.angle() * turn.axis(), X_BG_desired.translation() - X_BG.translation()])
        V, h = J @ v, self._time_step
        mobility = J @ np.linalg.solve(self._frame.mass_matrix(q), J.T)
        A = np.eye(6) + (h * (self._D + h * self._K))[:, None] * mobility
        return self._solve(A, self._K * (e - h * V) - self._D * V), J

    def _solve(self, A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """F (6,) of A F = b, within the limits."""
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
    """`vector`, shortened to a length of `limit` if it is longer."""
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)


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
