"""Teleoperation of an arm by a master arm: scaled translation, unscaled rotation, clutch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.models.plant import make_arm_plant

#: Minimum distance [m] of the end of the follower's shaft beyond the remote centre of motion. At the remote centre, the
#: joints that rotate the shaft are singular.
MIN_DEPTH = 0.02
#: Tolerance of this distance for commanded positions [m], for rounding errors.
_DEPTH_TOLERANCE = 1e-6
#: Steps of the inverse kinematics per period. One suffices, because the next period continues.
_MAX_STEPS = 1
#: Largest lag of the follower [s]. The allowed position error of a joint is its velocity limit times this lag.
MAX_LAG = 0.1


class Teleoperation(LeafSystem):
    """Commands a follower from the handle of a master that an operator moves, e.g. a PSM from an MTM.

    .. pydrake_system::

        name: Teleoperation
        input_ports:
        - master_position
        - follower_position
        - engaged
        - jaw_angle (optional)
        output_ports:
        - desired_state
        - following
        - fault

    Ports [rad, rad/s; m, m/s on a prismatic joint], joints in the arms' order:

    - `master_position` (n of the master), `follower_position` (n of the follower): measured joint positions.
    - `engaged` (1): clutch state. Above 0.5, the clutch is closed and the follower follows. On a dVRK, pressing the
      clutch pedal opens the clutch.
    - `jaw_angle` (1): desired position of the follower's `separate_joint`, e.g. the master's gripper angle for a jaw.
      Unconnected: this joint does not move. An arm without this joint ignores the input.
    - `desired_state` (2n of the follower): commanded joint positions, then their rates, for `GravityPidController`.
    - `following` (1): 1 while the follower follows the master, else 0.
    - `fault` (1): 1 while an input is not valid or the follower is not at its commanded position, else 0.

    **Control law.** X_MG is the pose of the handle in the master's base. X_FT is the pose of the tip in the follower's
    base. Handle and tip are the frames `Arm.frames.hand` of both arms. Both poses are stored when the clutch closes;
    the stored poses have the index 0. R_FM is the rotation from the master's to the follower's base, as seen by the
    operator:

        p_FT = p_FT0 + scale R_FM (p_MG - p_MG0),    R_FT = R_FM R_MG R_MG0' R_FM' R_FT0

    Closing the clutch therefore does not move the follower, and the difference of the two orientations stays constant.
    (The software of the dVRK instead moves the master's wrist to align both orientations. A master in gravity
    compensation has no controller for this motion.)

    **Limits.** `ArmFrame.approach` finds joint positions within the limits at which the tip is nearest to the desired
    pose. Each commanded position moves towards them within the velocity limit of the joint. If the shaft would be drawn
    into the cannula (see below), only the jaw moves. If the handle moves beyond a limit, the tip stops at the limit.
    When the handle returns, the tip moves again as defined by the control law.

    **Hold.** `desired_state` is constant with zero rates in any of these cases:

    - The clutch is open.
    - A number of an input is not finite, or its magnitude exceeds 1e6.
    - A joint of the follower is farther from its commanded position than its velocity limit times `MAX_LAG`. The jaw is
      not checked, because it may press on an object.
    - The instrument is inside the cannula, i.e. the end of its shaft (`Frames.shaft`) is less than `MIN_DEPTH` beyond
      the remote centre. An arm without these frames has no cannula.

    After each of these cases, X_MG and X_FT are stored again, as when the clutch closes. If the follower was moved
    externally while the clutch was open, the command is set to the measured position. Before the first finite
    follower_position, `desired_state` is NaN, which the controller rejects.

    The input ports do not contain the age of a value. A program that receives the inputs as messages must therefore
    open the clutch if messages are delayed. Inputs are sampled and outputs change every `period` seconds and at
    initialization, which resets the state.
    """

    def __init__(
        self,
        master: Arm,
        follower: Arm,
        *,
        scale: float = 0.3,
        R_FM: RotationMatrix | None = None,
        period: float = 1e-3,
    ) -> None:
        """Creates the system.

        Args:
            master: Arm that the operator moves.
            follower: Arm that follows.
            scale: Ratio of the tip's displacement to the handle's displacement, above 0 and at most 1; see `SetScale`.
            R_FM: Rotation from the master's base to the follower's base. None: identity, for parallel bases.
            period: Period of the update [s].

        Raises:
            ControllerError: Scale or period is out of range, or the follower has no velocity limits.
        """
        super().__init__()
        if not (np.isfinite(period) and period > 0):
            raise ControllerError(f"period must be a positive number of seconds; got {period}")
        self._period = float(period)
        self._master, self._follower = ArmFrame(master), ArmFrame(follower)
        frames = follower.frames
        self._shaft, self._p_remote = None, np.zeros(3)
        if frames.shaft and frames.remote_center:
            self._shaft = ArmFrame(follower, frames.shaft)
            self._p_remote = ArmFrame(follower, frames.remote_center).pose(np.zeros(follower.num_joints)).translation()
        self._R_FM = R_FM or RotationMatrix()
        self._lower, self._upper = follower.position_lower, follower.position_upper
        self._speed = _velocity_limits(follower)
        self._is_jaw = np.array([name == follower.separate_joint for name in follower.joint_names])
        self._max_lag = np.where(self._is_jaw, np.inf, MAX_LAG * self._speed)

        n = follower.num_joints
        self.DeclareVectorInputPort(name="master_position", size=master.num_joints)
        self.DeclareVectorInputPort(name="follower_position", size=n)
        self.DeclareVectorInputPort(name="engaged", size=1)
        self.DeclareVectorInputPort(name="jaw_angle", size=1)
        desired = self.DeclareDiscreteState(model_vector=BasicVector(np.full(2 * n, np.nan)))
        following = self.DeclareDiscreteState(num_state_variables=1)
        fault = self.DeclareDiscreteState(num_state_variables=1)
        self.DeclareDiscreteState(model_vector=BasicVector([self._checked(scale)]))
        self.DeclareDiscreteState(num_state_variables=24)  # X_MG0 and X_FT0, 3 x 4 each
        for name, state in (("desired_state", desired), ("following", following), ("fault", fault)):
            self.DeclareStateOutputPort(name=name, state_index=state)
        self.DeclareInitializationDiscreteUpdateEvent(update=self._restart)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec=self._period, offset_sec=0.0, update=self._update)
        self.DeclareForcedDiscreteUpdateEvent(update=self._update)

    def SetScale(self, context: Context, scale: float) -> None:
        """Changes the scale. The tip does not jump.

        Raises:
            ControllerError: The scale is not above 0 and at most 1.
        """
        context.get_mutable_discrete_state(_SCALE).SetAtIndex(0, self._checked(scale))
        context.get_mutable_discrete_state(_FOLLOWING).SetAtIndex(0, 0.0)

    @staticmethod
    def _checked(scale: float) -> float:
        if not 0 < scale <= 1:
            raise ControllerError(f"scale must be above 0 and at most 1; got {scale}")
        return float(scale)

    def _restart(self, context: Context, state: DiscreteValues) -> None:
        state.get_mutable_value(_DESIRED)[:] = np.nan
        state.get_mutable_value(_FOLLOWING)[0] = 0.0
        self._update(context, state)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        desired = state.get_mutable_value(_DESIRED)
        q_d, v_d = np.split(desired, 2)  # views
        q_master, q_follower, engaged = (self._read(context, port) for port in range(3))
        jaw = self._read(context, _JAW) if self.get_input_port(_JAW).HasValue(context) else q_d[self._is_jaw]
        is_engaged = engaged[0] > 0.5

        lags = not np.all(np.abs(q_follower - q_d) <= self._max_lag)  # also true for NaN
        if lags and _is_valid(q_follower) and (not is_engaged or np.isnan(q_d[0])):
            q_d[:] = q_follower
            lags = False
        fault = lags or not (_is_valid(q_master) and _is_valid(jaw) and _is_valid(engaged))
        depth = self._depth(q_d) if is_engaged and not fault else -np.inf
        follows = depth >= MIN_DEPTH - _DEPTH_TOLERANCE
        v_d[:] = 0.0
        if follows:
            X_FT = self._target(q_master, q_d, state)
            v_d[:] = self._rates(X_FT, jaw, q_d)
            if self._depth(q_d + self._period * v_d) < min(MIN_DEPTH, depth):
                v_d[~self._is_jaw] = 0.0
            q_d += self._period * v_d
        state.get_mutable_value(_FOLLOWING)[0] = float(follows)
        state.get_mutable_value(_FAULT)[0] = float(fault)

    def _target(self, q_master: NDArray[np.float64], q_d: NDArray[np.float64], state: DiscreteValues) -> RigidTransform:
        """Returns the desired X_FT. When following begins, stores the present poses and returns the present pose."""
        X_MG = self._master.pose(q_master)
        poses = state.get_mutable_value(_POSES).reshape(2, 3, 4)  # a view
        if state.get_value(_FOLLOWING)[0] == 0.0:
            poses[0], poses[1] = X_MG.GetAsMatrix34(), self._follower.pose(q_d).GetAsMatrix34()
        R_MG0, p_MG0, R_FT0, p_FT0 = poses[0, :, :3], poses[0, :, 3], poses[1, :, :3], poses[1, :, 3]
        R_FM, scale = self._R_FM.matrix(), state.get_value(_SCALE)[0]
        R_FT = R_FM @ X_MG.rotation().matrix() @ R_MG0.T @ R_FM.T @ R_FT0
        return RigidTransform(
            RotationMatrix.ProjectToRotationMatrix(R_FT), p_FT0 + scale * R_FM @ (X_MG.translation() - p_MG0)
        )

    def _rates(self, X_FT: RigidTransform, jaw: NDArray[np.float64], q_d: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the joint rates (n,) for one period towards the pose and jaw angle, inside all limits."""
        target = self._follower.approach(X_FT, q_d, _MAX_STEPS)
        target[self._is_jaw] = np.clip(jaw, self._lower[self._is_jaw], self._upper[self._is_jaw])
        return np.clip((target - q_d) / self._period, -self._speed, self._speed)

    def _depth(self, q: NDArray[np.float64]) -> float:
        """Returns the distance of the end of the shaft beyond the remote centre [m]; infinite without a shaft."""
        if self._shaft is None:
            return np.inf
        X_FS = self._shaft.pose(q)
        return float(X_FS.rotation().col(2) @ (X_FS.translation() - self._p_remote))

    def _read(self, context: Context, port: int) -> NDArray[np.float64]:
        vector = self.EvalVectorInput(context, port)
        if vector is None:
            raise ControllerError(f"input port {self.get_input_port(port).get_name()} is not connected")
        return vector.get_value()


_JAW = 3  # index of the input port
_DESIRED, _FOLLOWING, _FAULT, _SCALE, _POSES = range(5)  # indices of the discrete state groups


def _is_valid(values: NDArray[np.float64]) -> bool:
    return bool(np.all(np.abs(values) < IMPLAUSIBLE))  # false for NaN


def _velocity_limits(arm: Arm) -> NDArray[np.float64]:
    """Returns the velocity limits (n,) from `<velocity>` in the SDF."""
    plant = make_arm_plant(arm)
    limits = np.array([plant.GetJointByName(name).velocity_upper_limits()[0] for name in arm.joint_names])
    if not np.all(np.isfinite(limits)):
        raise ControllerError(
            f"{arm.name}: a joint has no velocity limit (<velocity> in the SDF). A follower requires one for each joint"
        )
    return limits
