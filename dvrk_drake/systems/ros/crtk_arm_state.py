"""State machine of a simulated dVRK arm: operating state, control modes and commands."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.systems.cubic_trajectory import CubicTrajectory

State = Literal["DISABLED", "ENABLED", "PAUSED", "FAULT"]
#: Function that returns the joint positions (n,) for a commanded pose of the tool in the base frame and the present
#: set-point (n,), or None if the arm cannot reach the pose.
Inverse = Callable[[RigidTransform, NDArray[np.float64]], NDArray[np.float64] | None]

_STATE_COMMANDS = ("enable", "disable", "pause", "resume", "home", "unhome")
#: Mapping from each command of joints to its values, for messages.
#: Word in each line on a refused command.
REFUSED = "refused:"
_POSE_COMMANDS = ("servo_cp", "move_cp")
_JOINT_COMMANDS = {"servo_jp": "positions", "move_jp": "positions", "servo_jf": "efforts"}
#: Shortest time between two lines on refused commands [s].
_QUIET = 2.0
#: Tolerance for the norm of a quaternion.
_QUATERNION_TOLERANCE = 0.01
#: Largest number of characters of a text in a message.
_MAX_TEXT = 40


#: "none": the motors have no power. "free": effort mode with zero effort.
ControlMode = Literal["none", "position", "effort", "free"]

#: Time in which `move_jp` may move a joint over its full range [s].
_TRAVERSE_TIME = 3.0
#: Time in which `servo_jp` may move a joint over its full range [s].
_SERVO_TRAVERSE_TIME = 0.1


class JointGroup:
    """Control mode, set-point and commanded effort of some joints of an arm.

    Vectors have k elements, one per joint of the group [rad, rad/s, N m; m, m/s, N]. Arrays are replaced and not
    modified in place, because copies of a group share them.

    Attributes:
        joints: Indices (k,) of the joints in the arm.
        mode: Control mode.
        q, v: Positions and velocities of the set-point. In the modes "none", "effort" and "free", they are the measured
            positions and zero.
        effort: Commanded efforts inside the effort limits.
    """

    def __init__(self, arm: Arm, joints: Sequence[int]) -> None:
        """Creates a group in control mode "none".

        Args:
            arm: Arm of the group.
            joints: Indices (k,) of the joints in the arm.
        """
        self.joints = np.array(joints, int)
        self._names = [arm.joint_names[i] for i in joints]
        self._lower, self._upper = arm.position_lower[self.joints], arm.position_upper[self.joints]
        self._effort_limits = arm.effort_limits[self.joints]
        self._speed = (self._upper - self._lower) / _TRAVERSE_TIME
        self.mode: ControlMode = "none"
        self.q, self.v = np.clip(0.0, self._lower, self._upper), np.zeros(len(joints))
        self.effort = np.zeros(len(joints))
        self._trajectory: CubicTrajectory | None = None
        self._start = 0.0

    def __deepcopy__(self, memo: object) -> JointGroup:
        return copy.copy(self)

    @property
    def is_moving(self) -> bool:
        """True while the set-point follows a trajectory."""
        return self._trajectory is not None

    @property
    def is_effort_controlled(self) -> bool:
        """True if the commanded effort acts."""
        return self.mode in ("effort", "free")

    def fault(self, values: Sequence[float], quantity: str) -> str:
        """Returns the reason why commanded numbers are not accepted, or "" if they are accepted.

        Args:
            values: Commanded numbers. Accepted are k finite numbers.
            quantity: Name of the numbers for the message, e.g. "positions".
        """
        if len(values) != len(self._names):
            return f"{len(values)} {quantity}, allowed: {len(self._names)} for {', '.join(self._names)}"
        for name, value in zip(self._names, values, strict=True):
            if not abs(value) < IMPLAUSIBLE:  # also true for NaN
                return f"{name} is {value}; allowed: finite numbers with a magnitude below {IMPLAUSIBLE:g}"
        return ""

    def release(self) -> None:
        """Ends control."""
        self._change("none")

    def servo_jp(self, q: Sequence[float], v: Sequence[float] = ()) -> None:
        """Sets the set-point q (k,), v (k,), clipped to the position limits. Without velocities, they are zero."""
        self._change("position")
        self.q = np.clip(q, self._lower, self._upper)
        # A set-point at a limit does not move beyond the limit. The speed limit prevents extreme efforts of damping.
        largest = (self._upper - self._lower) / _SERVO_TRAVERSE_TIME
        self.v = np.where(self.q == q, np.clip(v, -largest, largest), 0.0) if len(v) else np.zeros(len(self.q))

    def servo_jf(self, effort: Sequence[float]) -> None:
        """Sets the effort (k,), clipped to the effort limits."""
        self._change("effort")
        self.effort = np.clip(effort, -self._effort_limits, self._effort_limits)

    def free(self) -> None:
        """Sets the effort to zero."""
        self._change("free")

    def hold(self) -> None:
        """Stops at the set-point. Outside position control, the set-point is the measured pose."""
        self.servo_jp(self.q)

    def move_jp(self, goal: Sequence[float] | None, time: float) -> None:
        """Moves the set-point to a goal (k,), clipped to the position limits, on a cubic trajectory.

        Args:
            goal: Positions at the end, at rest. None: the home pose, which is zero or the nearest position limit.
            time: Present time [s].
        """
        q, v = self.q, self.v
        self._change("position")
        q_end = np.clip(np.zeros(len(self._names)) if goal is None else goal, self._lower, self._upper)
        duration = CubicTrajectory.rest_to_rest(q, q_end, self._speed).duration
        self.q, self.v = q, v
        self._trajectory, self._start = CubicTrajectory(q, v, q_end, duration), time

    def step(self, time: float, q: NDArray[np.float64]) -> None:
        """Advances the set-point to `time` [s]. q (k,) is the measured pose."""
        if self.is_effort_controlled or self.mode == "none":
            self.q, self.v = q, np.zeros(len(q))
        elif self._trajectory is not None:
            elapsed = time - self._start
            position, self.v = np.split(self._trajectory.state(elapsed), 2)
            # A trajectory that replaces another one begins in motion and may exceed the limits.
            self.q = np.clip(position, self._lower, self._upper)
            if elapsed >= self._trajectory.duration:
                self._trajectory, self.v = None, np.zeros(len(q))

    def _change(self, mode: ControlMode) -> None:
        self.mode, self._trajectory = mode, None
        self.effort = np.zeros(len(self._names))


@dataclass(frozen=True)
class CrtkCommand:
    """Command to an arm.

    Attributes:
        name: Name of the topic in the namespace of the arm, e.g. "servo_jp" or "jaw/servo_jp".
        values: Positions or efforts [rad, m, N m, N]. `servo_cp` and `move_cp`: x, y, z [m], then the
            quaternion x, y, z, w.
        velocities: Velocities for `servo_jp` [rad/s, m/s]. Empty: zero.
        text: Text of `state_command`.
        is_on: Value of `use_gravity_compensation`.
    """

    name: str
    values: Sequence[float] = ()
    velocities: Sequence[float] = ()
    text: str = ""
    is_on: bool = False


@dataclass(frozen=True)
class ArmValues:
    """Values that an arm publishes, in the arm's order of joints [rad, rad/s, N m; m, m/s, N].

    Attributes:
        q, v, effort: Measured values (n,).
        setpoint_q, setpoint_v: Set-point (n,).
        setpoint_effort: Commanded motor efforts (n,).
        gravity_effort: Gravity compensation (n,) that is added to commanded efforts.
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]
    effort: NDArray[np.float64]
    setpoint_q: NDArray[np.float64]
    setpoint_v: NDArray[np.float64]
    setpoint_effort: NDArray[np.float64]
    gravity_effort: NDArray[np.float64]


class CrtkArmState:
    """Operating state and control modes of a simulated dVRK arm, without ROS.

    Vectors have n elements in the arm's order [rad, rad/s, N m; m, m/s, N].

    The arm is initially DISABLED and not homed. `enable` supplies power, and the arm regulates the measured pose.
    `home` moves the arm to the home pose. After this motion, the arm accepts commands. In FAULT and DISABLED, the
    motors have no power.

    Differences from a dVRK: A command with a wrong number of values or a value that is not finite changes nothing.
    `pause` can be repeated. `home` after `unhome` homes the arm again. The jaw has its own control mode, but `hold`
    and `free` also apply to the jaw.

    Attributes:
        state: Operating state.
        is_homed: Whether the arm was homed since it was last enabled.
        is_biased: Whether the measured positions are valid, i.e. the arm was homed and not unhomed.
        gravity_compensation: Whether gravity compensation is added to commanded efforts.
    """

    def __init__(self, arm: Arm, *, gravity_compensation: bool = False, inverse: Inverse | None = None) -> None:
        """Creates the state machine.

        Args:
            arm: Arm with limits and joint names. Its `separate_joint` has topics of its own.
            gravity_compensation: Initial state of the gravity compensation.
            inverse: Inverse kinematics for `servo_cp` and `move_cp`. None: these commands are refused.
        """
        n = arm.num_joints
        separate = [i for i in range(n) if arm.joint_names[i] == arm.separate_joint]
        self._main = JointGroup(arm, [i for i in range(n) if i not in separate])
        self._jaw: JointGroup | None = JointGroup(arm, separate) if separate else None
        self._jaw_name, self._effort_limits, self._inverse = arm.separate_joint, arm.effort_limits, inverse
        self.state: State = "DISABLED"
        self.is_homed = self.is_biased = False
        self.gravity_compensation = gravity_compensation
        self._is_homing = False
        self._lines: tuple[str, ...] = ()
        self._described = ""
        self._num_refused, self._next_refusal = 0, 0.0

    def __deepcopy__(self, memo: object) -> CrtkArmState:
        # Drake copies the state of a context before every update, so copying must be fast.
        other = copy.copy(self)
        other._main = copy.copy(self._main)
        other._jaw = copy.copy(self._jaw)
        return other

    @property
    def groups(self) -> list[JointGroup]:
        """Groups of joints: the joints of the arm, then its separate joint if there is one."""
        return [self._main] if self._jaw is None else [self._main, self._jaw]

    @property
    def is_busy(self) -> bool:
        """True while the arm moves to the home pose or to the goal of `move_jp` or `move_cp`."""
        return any(group.is_moving for group in self.groups)

    @property
    def is_powered(self) -> bool:
        """True if the motors have power."""
        return self.state in ("ENABLED", "PAUSED")

    @property
    def desired_state(self) -> NDArray[np.float64]:
        """Set-point (2n,): q, then v."""
        n = len(self._effort_limits)
        desired = np.empty(2 * n)
        for group in self.groups:
            desired[group.joints], desired[n + group.joints] = group.q, group.v
        return desired

    def motor_effort(self, position_control: NDArray[np.float64], gravity: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the motor efforts (n,) inside the effort limits.

        Args:
            position_control: Efforts (n,) of the position controller at the set-point.
            gravity: Efforts (n,) that compensate gravity.
        """
        if not self.is_powered:
            return np.zeros(len(gravity))
        effort = position_control.copy()
        for group in self.groups:
            if group.is_effort_controlled:
                effort[group.joints] = group.effort + self.gravity_compensation * gravity[group.joints]
        return np.clip(effort, -self._effort_limits, self._effort_limits)

    def step(
        self, time: float, q: NDArray[np.float64], v: NDArray[np.float64], commands: Sequence[CrtkCommand] = ()
    ) -> None:
        """Processes a measurement, then commands, and advances the set-point.

        Args:
            time: Present time [s].
            q, v: Measured positions and velocities (n,).
            commands: Commands in the order of their publication.
        """
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
            q = self.desired_state[: len(q)]
            if self.is_powered:
                self._remove_power("FAULT")
        for group in self.groups:
            group.step(time, q[group.joints])
        for command in commands:
            if refusal := self._receive(command, time):
                self._report_refusal(f"{command.name[:_MAX_TEXT]} {REFUSED} {refusal}", time)
        if self._is_homing and not self.is_busy:
            self._is_homing, self.is_homed, self.is_biased = False, True, True
        if (described := self.describe()) != self._described:
            self._lines, self._described = (*self._lines, described), described

    def take_lines(self) -> tuple[str, ...]:
        """Returns lines on changes of state or mode and on refused commands since the last call."""
        lines, self._lines = self._lines, ()
        return lines

    def describe(self) -> str:
        """Returns a line on operating state and control modes, e.g. "ENABLED, homed, control mode position"."""
        parts: list[str] = [self.state]
        if self.is_powered:
            parts.append("homing" if self._is_homing else "homed" if self.is_homed else "not homed")
        if self.is_ready:
            parts.append(f"control mode {self._main.mode}")
            if self._jaw is not None and self._jaw.mode != self._main.mode:
                parts.append(f"{self._jaw_name} {self._jaw.mode}")
            if self.gravity_compensation:
                parts.append("gravity compensation on")
        return ", ".join(parts)

    @property
    def is_ready(self) -> bool:
        """True if the arm accepts commands."""
        return self.state == "ENABLED" and self.is_homed

    def _receive(self, command: CrtkCommand, time: float) -> str:
        """Executes a command. Returns the reason why it is refused, or ""."""
        name = command.name
        if name == "state_command":
            return self._change_state(command.text, time)
        if name == "use_gravity_compensation":
            self.gravity_compensation = command.is_on
            return ""
        if not self.is_ready:
            return f"the arm is {self.describe()}; allowed: ENABLED, homed"
        if name in ("hold", "free"):
            for each in self.groups:
                each.hold() if name == "hold" else each.free()
            return ""
        prefix, _, verb = name.rpartition("/")
        group = self._group(prefix)
        if group is None or verb not in _JOINT_COMMANDS:
            return self._to_pose(name, command.values, time) if name in _POSE_COMMANDS else "unknown command"
        fault = group.fault(command.values, _JOINT_COMMANDS[verb])
        if not fault and len(command.velocities):
            fault = group.fault(command.velocities, "velocities")
        if fault:
            return fault
        if verb == "servo_jp":
            group.servo_jp(command.values, command.velocities)
        elif verb == "move_jp":
            group.move_jp(command.values, time)
        else:
            group.servo_jf(command.values)
        return ""

    def _group(self, prefix: str) -> JointGroup | None:
        """Returns the group of the topics below `prefix`, or None if there is no such group."""
        return self._main if not prefix else self._jaw if prefix == self._jaw_name else None

    def _to_pose(self, name: str, pose: Sequence[float], time: float) -> str:
        is_plausible = len(pose) == 7 and all(abs(value) < IMPLAUSIBLE for value in pose)
        if not (is_plausible and abs(np.linalg.norm(pose[3:]) - 1.0) < _QUATERNION_TOLERANCE):
            return f"the pose must have finite numbers below {IMPLAUSIBLE:g} and a unit quaternion"
        n = len(self._effort_limits)
        x, y, z, w = np.asarray(pose[3:], float) / np.linalg.norm(pose[3:])
        X_BT = RigidTransform(Quaternion(wxyz=[w, x, y, z]), pose[:3])
        q = None if self._inverse is None else self._inverse(X_BT, self.desired_state[:n])
        if q is None:
            return "the arm cannot reach the pose from the present set-point"
        if name == "servo_cp":
            self._main.servo_jp(q[self._main.joints])
        else:
            self._main.move_jp(q[self._main.joints], time)
        return ""

    def _change_state(self, command: str, time: float) -> str:
        if command not in _STATE_COMMANDS:
            # JSON shows a text with line breaks on one line.
            return f"{json.dumps(command[:_MAX_TEXT])}; allowed: {', '.join(_STATE_COMMANDS)}"
        if command == "disable":
            if self.is_powered:
                self._remove_power("DISABLED")
            self.state = "DISABLED"
        elif command == "unhome":
            self.is_homed = self.is_biased = self._is_homing = False
            if self.is_powered:
                self._regulate()
        elif command == "enable" and not self.is_powered:
            self.state, self.is_homed = "ENABLED", False
            self._regulate()
        elif command == "home" and self.state == "ENABLED":
            if not self.is_homed and not self._is_homing:
                self._is_homing = True
                for group in self.groups:
                    group.move_jp(None, time)
        elif command == "pause" and self.is_powered:
            self.state, self._is_homing = "PAUSED", False
            self._regulate()
        elif command == "resume" and self.state == "PAUSED":
            self.state = "ENABLED"
        elif not (command == "enable" and self.state == "ENABLED"):
            return f'"{command}" is not supported in the state {self.state}'
        return ""

    def _regulate(self) -> None:
        """Regulates the present pose."""
        for group in self.groups:
            group.hold()

    def _remove_power(self, state: State) -> None:
        self.state, self._is_homing = state, False
        for group in self.groups:
            group.release()

    def _report_refusal(self, line: str, time: float) -> None:
        if time < self._next_refusal:
            self._num_refused += 1
            return
        more = f" ({self._num_refused} more commands refused before)" if self._num_refused else ""
        self._lines = (*self._lines, line + more)
        self._num_refused, self._next_refusal = 0, time + _QUIET
