"""Limits of effort, rate and position of a command guard, and the output of the guard inside these limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import SoftWalls
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.systems.guard.settings import GuardSettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

Vector = NDArray[np.float64]
Flags = NDArray[np.int8]
Mask = NDArray[np.bool_]

#: Tolerance of the check of coupled limits for rounding errors [rad, m].
_ROUNDING = 1e-12

#: Largest delay [s] of the loop in the safe state: 30 ms of a measurement, 5 ms of a velocity filter with a cut-off of
#: 30 Hz, and five periods for sensors, messages and motors.
SAFE_DELAY = 0.04

#: Gains of the safe state at the delay T: damping per inertia, times T, and stiffness per damping, times T. For the
#: arms of this package, the loop has a phase margin of at least 30 degrees at the delay T, and is stable at 2 T.
_SAFE_DAMPING, _SAFE_STIFFNESS = 0.6, 0.12

#: Number of random poses for the largest ratio of damping to inertia.
_INERTIA_POSES = 50

_CLAMPED, _RATE_LIMITED = np.int8(lcmt_dvrk_status.FLAG_EFFORT_CLAMPED), np.int8(lcmt_dvrk_status.FLAG_RATE_LIMITED)


class Part:
    """Object with a state that changes in each step of the guard.

    A deep copy shares all attributes with the original, in particular arrays, except those that `_find_parts` found. A
    subclass must therefore replace an array instead of changing it in place. Drake copies the state of a Context before
    every update, and a copy of each array would take longer than the update.
    """

    _parts: tuple[str, ...] = ()

    def __deepcopy__(self, memo: object) -> Self:
        """Returns a copy that changes independently of this object."""
        other = object.__new__(type(self))
        other.__dict__ = attributes = self.__dict__.copy()
        for name in self._parts:
            attributes[name] = attributes[name].__deepcopy__(memo)
        return other

    def _find_parts(self) -> None:
        """Finds the attributes that are parts themselves. A constructor calls this method last."""
        self._parts = tuple(name for name, value in vars(self).items() if isinstance(value, Part))


def clip(x: Vector, lower: ArrayLike, upper: ArrayLike) -> Vector:
    """Returns x (n,) limited to the range from lower to upper. For small arrays, np.clip is slower."""
    return np.minimum(np.maximum(x, lower), upper)


def is_any(mask: Mask) -> bool:
    """Returns whether any element of the mask (n,) is true. For small arrays, mask.any() is slower."""
    return True in mask.tolist()


def is_finite(numbers: list[float]) -> bool:
    """Returns whether all numbers are finite and the sum of their magnitudes is below 1e6.

    The argument is a list, because numpy is slower for a few numbers and warns of an overflow.
    """
    return sum(map(abs, numbers)) < IMPLAUSIBLE


class ArmModel(Protocol):
    """Protocol of the arm model that the guard uses, such as `dvrk_drake.dynamics.identified_model.ControlModel`."""

    def gravity_effort(self, q: Vector) -> Vector:
        """Returns the effort (n,) [N m, N] that compensates gravity at the pose q (n,) [rad, m]."""

    def mass_matrix(self, q: Vector) -> NDArray[np.float64]:
        """Returns the mass matrix (n, n) at the pose q (n,)."""


class GuardLimits:
    """Limits of one arm with n joints, in the arm's order of joints.

    **Effort commands.** The position limits lower <= A q <= upper are the limits of the joints and the coupled limits.
    A soft wall acts before each position limit. The wall is a virtual spring and damper along the coordinate c = A_k q
    of limit k, where A_k is row k of A. At an upper limit, its effort is:

        lambda = 2 F_k clip(depth, 0, 1),  tau -= A_k' lambda

    - F_k is the largest ratio of effort limit to |A_kj| among the joints j of the limit. At a depth of 1/2, the wall
      therefore cancels the full motor effort of each of these joints.
    - depth is the relative position of c + T_k dc/dt in the wall: 0 where the wall begins, 1 at the limit.
    - T_k is the largest ratio Kd/Kp of the position controllers of these joints. The wall therefore acts earlier on a
      fast joint.

    At the limit, the joint is therefore pushed inward by the full motor effort, even if the command is the full effort
    outward. The width of the wall is the margin. It is larger if the gain of the wall would otherwise exceed four times
    the gain of the position controller. Larger gains cause chatter, because the output has a delay of one period.

    The wall only pushes inward. It also acts if the commanded effort is zero, e.g. on a falling arm. Joints above their
    speed limit are braked. Above 1.25 times the speed limit, no commanded effort accelerates a joint further. Commanded
    efforts are clamped and limited in rate before the effort of the wall is added. The effort of the wall is not
    limited in rate.

    **Position commands.** A position command moves a target. The target is limited in rate and stays inside the
    position limits. If the target starts outside a limit, it does not move further outward. With a feedforward velocity
    v and a constant target, a position controller settles at a distance of Kd/Kp v beyond the target. The feedforward
    velocity is therefore reduced until this point is also inside the limits.
    """

    def __init__(self, arm: Arm, settings: GuardSettings) -> None:
        """Creates the limits of `arm`."""
        n = arm.num_joints
        self.effort_limits = np.array(arm.effort_limits)
        self.command_limits = settings.effort_fraction * self.effort_limits
        self.A, self.lower, self.upper = arm.limit_matrix()
        self._prismatic = arm.prismatic
        self.names = [*arm.joint_names, *(limit.name for limit in arm.coupled_limits)]
        width = self.upper - self.lower
        self.margin = np.minimum(settings.margin, settings.margin_fraction * width)
        self._middle, self._allowed = 0.5 * (self.upper + self.lower), 0.5 * (width + self.margin)
        self.start_position = self.margin[:n]
        self.start_effort = settings.start_effort * self.effort_limits
        self.speed = width[:n] / settings.traverse_time
        self.following_error = settings.following_error * width[:n]
        self.following_time = settings.following_time
        self._effort_rate = self.effort_limits / settings.effort_rise_time
        self.kp, self.kd = np.array(arm.gains.kp), np.array(arm.gains.kd)
        self._acceleration = np.divide(self._effort_rate, self.kd, out=np.full(n, np.inf), where=self.kd > 0)
        walls = SoftWalls.of(arm)
        self._wall_effort, self._wall_look_ahead = walls.effort, walls.look_ahead
        self.wall_width = np.maximum(self.margin, walls.width)
        self.fault_effort = settings.fault_effort * self.effort_limits
        checks = settings.plausibility
        self.start_gravity = checks.start_gravity * self.effort_limits + arm.dry_friction()
        self.start_gravity += checks.hand_efforts(arm)
        self._look_ahead = self.kd / self.kp
        self._free = 0.5 * width - self.wall_width
        self._wall_flags = np.full(len(self.A), lcmt_dvrk_status.FLAG_COUPLED_LIMIT, np.int8)
        self._wall_flags[:n] = lcmt_dvrk_status.FLAG_POSITION_LIMIT

    def safe_gains(self, arm: Arm, model: ArmModel) -> tuple[Vector, Vector]:
        """Returns the stiffness (n,) and damping (n,) of the safe state, which are stable up to the delay `SAFE_DELAY`.

        The damping is D = c Kd with the gains Kd of the arm, and the stiffness is k D. For each eigenvalue m of
        M(q)^-1 D, the loop M a = -D (v + k e) with a delay T of v and e has a mode a = -m (v + k e). It is stable for
        all m from 0 to `_SAFE_DAMPING` / T, so c follows from the largest eigenvalue over the poses of the arm. The
        gains are zero if a mass matrix is singular or not finite.
        """
        poses = arm.sample_poses(_INERTIA_POSES, np.random.default_rng(0))
        kd = np.diag(self.kd)
        try:
            ratio = max(np.abs(np.linalg.eigvals(np.linalg.solve(model.mass_matrix(q), kd))).max() for q in poses)
        except np.linalg.LinAlgError:
            ratio = np.inf
        damping = min(_SAFE_DAMPING / (SAFE_DELAY * ratio), 1.0) * self.kd
        return _SAFE_STIFFNESS / SAFE_DELAY * damping, damping

    def position_limit_fault(self, q: Vector) -> str:
        """Returns a description of the limit that q (n,) exceeds most.

        Returns "" if no limit is exceeded by more than half of its margin.
        """
        c = self.A.dot(q)
        excess = np.abs(c - self._middle) - self._allowed
        k = int(excess.argmax())
        if not excess[k] > 0:
            return ""
        return (
            f"{self.names[k]} is at {c[k]:.4g} {self.unit(k)}, outside its limits "
            f"{self.lower[k]:.4g}..{self.upper[k]:.4g} {self.unit(k)}"
        )

    def implausible_pose(self, q: Vector) -> str:
        """Returns a description of the first limit that q (n,) exceeds by more than half of the range, or "".

        An arm may rest slightly outside a limit, because limits depend on calibration. Half of the range is far beyond
        any mechanical stop.
        """
        c = self.A @ q
        far = np.flatnonzero(np.abs(c - self._middle) > self.upper - self.lower)
        if not far.size:
            return ""
        k = int(far[0])
        wrong_unit = "mm" if self.unit(k) == "m" else "degrees"
        return (
            f"{self.names[k]} is at {c[k]:.4g} {self.unit(k)}, far outside its limits {self.lower[k]:.4g}.."
            f"{self.upper[k]:.4g} {self.unit(k)}; check its unit ({wrong_unit}?) and its zero position"
        )

    def unit(self, k: int) -> str:
        """Returns the unit of the coordinate of limit `k`: "m" for a prismatic joint, otherwise "rad"."""
        return "m" if k < len(self._prismatic) and self._prismatic[k] else "rad"

    def refusal_to_start(self, command: lcmt_dvrk_command, q: Vector, effort: Vector, gravity: Vector) -> int:
        """Checks a command that would begin to act in the present state.

        Args:
            command: POSITION or EFFORT command.
            q: Measured positions (n,) [rad, m].
            effort: Measured efforts (n,) [N m, N].
            gravity: Gravity effort (n,) of the model at q [N m, N].

        Returns:
            Reason of the refusal, lcmt_dvrk_status.REFUSAL_START_*, or REFUSAL_NONE.
        """
        if command.control_mode == lcmt_dvrk_command.EFFORT:
            if self.position_limit_fault(q):
                return lcmt_dvrk_status.REFUSAL_START_OUTSIDE
            if not np.all(np.abs(effort - gravity) <= self.start_gravity):
                return lcmt_dvrk_status.REFUSAL_START_GRAVITY
            far = np.abs(np.asarray(command.effort) - effort) > self.start_effort
            far |= np.abs(effort) > self.command_limits + self.start_effort
        else:
            away = np.asarray(command.position) - q
            ahead = away + self._look_ahead * np.asarray(command.velocity)
            far = np.maximum(np.abs(away), np.abs(ahead)) > self.start_position
        return lcmt_dvrk_status.REFUSAL_START_FAR if np.any(far) else lcmt_dvrk_status.REFUSAL_NONE

    def follow_effort(self, command: Vector, last: Vector, dt: float) -> tuple[Vector, Flags]:
        """Clamps an effort command and limits its rate.

        Args:
            command: Commanded effort (n,) [N m, N], finite.
            last: Previous effort (n,) [N m, N], inside the effort limits.
            dt: Time since the previous effort [s].

        Returns:
            Effort (n,) [N m, N] and joint flags (n,).
        """
        clamped = clip(command, -self.command_limits, self.command_limits)
        effort = self.limit_effort_rate(clamped, last, dt)
        if not is_any(effort != command):
            return effort, np.zeros(len(effort), np.int8)
        return effort, (clamped != command) * _CLAMPED | (effort != clamped) * _RATE_LIMITED

    def limit_effort_rate(self, effort: Vector, last: Vector, dt: float) -> Vector:
        """Returns `effort` (n,) [N m, N] with a limited change from `last` (n,) during `dt` [s]."""
        step = self._effort_rate * dt
        return clip(effort, last - step, last + step)

    def wall_effort(self, q: Vector, v: Vector) -> tuple[Vector, Flags]:
        """Returns the effort of the walls (n,) [N m, N] at q and v (n,), and the joint flags (n,)."""
        flags = np.zeros(len(q), np.int8)
        c = self.A.dot(q) + self._wall_look_ahead * self.A.dot(v)
        if not is_any(np.abs(c - self._middle) > self._free):
            return np.zeros(len(q)), flags
        to_upper, to_lower = (self.upper - c) / self.wall_width, (c - self.lower) / self.wall_width
        walls = 2 * self._wall_effort * (clip(1 - to_lower, 0, 1) - clip(1 - to_upper, 0, 1))
        for k in np.flatnonzero(walls):
            flags[self.A[k] != 0] |= self._wall_flags[k]
        return walls @ self.A, flags

    def restrain_effort(
        self, effort: Vector, q: Vector, v: Vector, withheld: Vector | None = None
    ) -> tuple[Vector, Flags]:
        """Adds the efforts of the walls and of the speed limit, without a rate limit that would delay them.

        Args:
            effort: Effort (n,) [N m, N] that follows the command.
            q: Measured positions (n,) [rad, m].
            v: Measured velocities (n,) [rad/s, m/s].
            withheld: Effort (n,) [N m, N] by which the effort of the walls is reduced, at most to zero. None: the
                effort of the walls is not reduced.

        Returns:
            Effort (n,) [N m, N] inside the effort limits, and joint flags (n,).
        """
        limit = self.effort_limits
        added, flags = self.wall_effort(q, v)
        if withheld is not None:
            added = added - clip(withheld, np.minimum(added, 0.0), np.maximum(added, 0.0))
        too_fast = np.abs(v) > self.speed
        if is_any(too_fast):
            added = added - 4 * limit * np.sign(v) * clip(np.abs(v) / self.speed - 1, 0.0, 0.5)
            flags[too_fast] |= lcmt_dvrk_status.FLAG_SPEED_LIMIT
        return clip(effort + added, -limit, limit), flags

    def limit_position(self, command: Vector, last: Vector, dt: float) -> tuple[Vector, Flags]:
        """Returns the next target (n,) [rad, m] of a position command, and the joint flags (n,).

        Args:
            command: Commanded positions (n,) [rad, m].
            last: Previous target (n,) [rad, m].
            dt: Time since the previous target [s].
        """
        step = self.speed * dt
        target = clip(command, last - step, last + step)
        flags = np.where(target != command, lcmt_dvrk_status.FLAG_RATE_LIMITED, 0).astype(np.int8)
        inside, limited = self._inside(target, last)
        return inside, flags | limited

    def follow_velocity(self, command: Vector, last: Vector, flags: Flags, dt: float) -> Vector:
        """Limits a feedforward velocity and its rate, so that the effort of Kd times it is limited in rate.

        Args:
            command: Commanded velocity (n,) [rad/s, m/s].
            last: Previous velocity (n,) [rad/s, m/s].
            flags: Joint flags (n,) of the target. Joints with flags slow down to zero.
            dt: Time since the previous velocity [s].
        """
        velocity = np.where(flags == 0, clip(command, -self.speed, self.speed), 0.0)
        step = self._acceleration * dt
        return clip(velocity, last - step, last + step)

    def limit_velocity(self, velocity: Vector, target: Vector) -> Vector:
        """Returns a feedforward velocity (n,) that is reduced near the position limits, at `target` (n,)."""
        lead = self._look_ahead * velocity
        ahead, _ = self._inside(target + lead, target)
        share = np.divide(ahead - target, lead, out=np.ones_like(lead), where=lead != 0)
        return velocity * clip(share, 0, 1)

    def _inside(self, target: Vector, last: Vector) -> tuple[Vector, Flags]:
        """Limits `target` (n,) to the position limits.

        If the previous target `last` (n,) is outside a limit, the target does not move further outward.

        Returns:
            Limited target (n,) and joint flags (n,).
        """
        n = len(last)
        flags = np.zeros(n, np.int8)
        c = self.A @ last
        lower, upper = np.minimum(self.lower, c), np.maximum(self.upper, c)
        inside = clip(target, lower[:n], upper[:n])
        flags[inside != target] |= lcmt_dvrk_status.FLAG_POSITION_LIMIT
        for k in range(n, len(self.A)):
            row = self.A[k]
            change = row @ inside - c[k]
            allowed = clip(change, lower[k] - c[k], upper[k] - c[k])
            if allowed != change:
                # All joints of this limit move by the same fraction of their change, so that they reach the limit
                # together.
                share = np.where(row != 0, allowed / change, 1.0)
                inside = last + share * (inside - last)
                flags[row != 0] |= lcmt_dvrk_status.FLAG_COUPLED_LIMIT
        c = self.A @ inside
        if np.any((c > upper + _ROUNDING) | (c < lower - _ROUNDING)):
            # The corrections for two coupled limits with a common joint can conflict. The target then does not move.
            return last.copy(), flags
        return inside, flags


@dataclass
class GuardOutput:
    """Output of the guard until the next step, for n joints in the arm's order.

    All numbers are finite and inside the limits.

    Attributes:
        control_mode: Mode lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        position: Target (n,) [rad, m] of the position controller in HOLD and POSITION; otherwise the measured pose.
        velocity: Feedforward velocity (n,) [rad/s, m/s] in POSITION; otherwise zero.
        effort: Motor effort (n,) [N m, N] in EFFORT; otherwise zero.
        joint_flags: Flags lcmt_dvrk_status.FLAG_* (n,) of the limits that acted on each joint.
    """

    control_mode: int
    position: Vector
    velocity: Vector
    effort: Vector
    joint_flags: Flags

    def is_finite(self) -> bool:
        """Returns whether all numbers are finite."""
        return is_finite([*self.position.tolist(), *self.velocity.tolist(), *self.effort.tolist()])


class Follower(Part):
    """Computes outputs that follow the commands inside the limits. Each mode starts from the present state of the arm.

    Attributes:
        target: Target (n,) [rad, m] of the position controller in HOLD and POSITION.
        effort: Effort (n,) [N m, N] that follows the commands, without soft walls and speed limit.
    """

    def __init__(self, limits: GuardLimits, safe_gains: tuple[Vector, Vector]) -> None:
        """Creates a follower at rest.

        Args:
            limits: Limits of the arm.
            safe_gains: Stiffness (n,) and damping (n,) of the safe state, see `GuardLimits.safe_gains`.
        """
        self._stiffness, self._damping = safe_gains
        self._limits, self._zero = limits, np.zeros(len(limits.effort_limits))
        self.target = self._filtered_target = self.effort = self._start_wall_effort = self._velocity = self._zero

    def off(self, q: Vector) -> GuardOutput:
        """Returns the output without motor power, at the measured pose q (n,) [rad, m]."""
        return self._output(lcmt_dvrk_command.OFF, q)

    def latch(self, q: Vector, v: Vector) -> None:
        """Sets the target to the measured pose q (n,) [rad, m] of an arm that moves with v (n,) [rad/s, m/s].

        The filtered target (see `following_fault`) starts ahead of q in the direction of v, so that the motion during
        braking causes no fault.
        """
        self.target = q.copy()
        speed = self._limits.speed
        self._filtered_target = q + self._limits.following_time * clip(v, -speed, speed)

    def hold(self, dt: float) -> GuardOutput:
        """Returns the next output, which holds the target. `dt` is the time since the previous output [s]."""
        self._filter_target(dt)
        return self._output(lcmt_dvrk_command.HOLD, self.target)

    def begin_safe_state(self, effort: Vector) -> None:
        """Starts the safe state from the present `effort` (n,) [N m, N]."""
        self.effort = clip(effort, -self._limits.effort_limits, self._limits.effort_limits)

    def hold_valid_joints(self, q: Vector, v: Vector, valid: Mask, gravity: Vector, dt: float) -> GuardOutput:
        """Returns the output of the safe state. It is damped also if the measurement is late.

        Joints with a valid position are regulated with the gains of `GuardLimits.safe_gains`. All other joints get only
        the gravity effort.

        Args:
            q: Measured positions (n,) [rad, m].
            v: Measured velocities (n,) [rad/s, m/s].
            valid: Mask (n,) of joints with a valid position.
            gravity: Gravity effort (n,) [N m, N] of the model at q, in which the last valid position replaces each
                invalid position.
            dt: Time since the previous output [s].
        """
        limits = self._limits
        largest, least = limits.fault_effort, limits.fault_effort / 3
        upper = np.minimum(np.maximum(largest, gravity + least), limits.effort_limits)
        lower = np.maximum(np.minimum(-largest, gravity - least), -limits.effort_limits)
        feedback = self._stiffness * (self.target - q) - self._damping * v
        effort = clip(gravity + np.where(valid, feedback, 0.0), lower, upper)
        self.effort = limits.limit_effort_rate(effort, self.effort, dt)
        flags = np.where(valid, 0, lcmt_dvrk_status.FLAG_IMPLAUSIBLE).astype(np.int8)
        return self._output(lcmt_dvrk_command.EFFORT, q, effort=self.effort.copy(), joint_flags=flags)

    def is_near(self, q: Vector) -> bool:
        """Returns whether q is near the target. The tolerance is that of the start check for position commands."""
        return bool(np.all(np.abs(self.target - q) <= self._limits.start_position))

    def begin_position(self) -> None:
        """Starts following position commands from the present target."""
        self._filtered_target, self._velocity = self.target, self._zero

    def follow_position(self, position: Vector, velocity: Vector, dt: float) -> GuardOutput:
        """Returns the next output for a position command.

        Args:
            position: Commanded position (n,) [rad, m].
            velocity: Commanded feedforward velocity (n,) [rad/s, m/s].
            dt: Time since the previous output [s].
        """
        self.target, flags = self._limits.limit_position(position, self.target, dt)
        self._filter_target(dt)
        self._velocity = self._limits.follow_velocity(velocity, self._velocity, flags, dt)
        velocity = self._limits.limit_velocity(self._velocity, self.target)
        return self._output(lcmt_dvrk_command.POSITION, self.target, velocity=velocity, joint_flags=flags)

    def _filter_target(self, dt: float) -> None:
        self._filtered_target = self._filtered_target + min(dt / self._limits.following_time, 1.0) * (
            self.target - self._filtered_target
        )

    def following_fault(self, q: Vector) -> str:
        """Returns a description of the joint with the largest following error, or "" if all errors are allowed.

        A position controller without feedforward follows a moving target with a delay of Kd/Kp. All positions between
        the target and the filtered target are therefore accepted. The filter is a first-order low-pass filter with time
        constant `following_time`. The accepted range is extended on both sides by the allowed error.
        """
        ahead = q - np.maximum(self.target, self._filtered_target)
        behind = np.minimum(self.target, self._filtered_target) - q
        share = np.maximum(ahead, behind) / self._limits.following_error
        j = int(np.argmax(share))
        if not share[j] > 1.0:
            return ""
        name, unit = self._limits.names[j], self._limits.unit(j)
        return (
            f"{name} is at {q[j]:.4g} {unit} and does not follow its target {self.target[j]:.4g} {unit} "
            f"(allowed difference {self._limits.following_error[j]:.3g} {unit})"
        )

    def begin_effort(self, effort: Vector, q: Vector) -> None:
        """Starts following effort commands from the measured `effort` (n,) [N m, N] at the pose q (n,) [rad, m]."""
        limit = self._limits.command_limits
        self.effort = clip(effort, -limit, limit)
        # Effort of the walls at the start for zero velocity. `follow_effort` subtracts a decreasing fraction of this
        # effort.
        self._start_wall_effort = self._limits.wall_effort(q, self._zero)[0]

    def follow_effort(self, effort: Vector, q: Vector, v: Vector, dt: float, start_share: float) -> GuardOutput:
        """Returns the next output for an effort command.

        Args:
            effort: Commanded effort (n,) [N m, N].
            q: Measured positions (n,) [rad, m].
            v: Measured velocities (n,) [rad/s, m/s].
            dt: Time since the previous output [s].
            start_share: Elapsed fraction (0 to 1) of the time in which the effort of the walls increases.
        """
        self.effort, flags = self._limits.follow_effort(effort, self.effort, dt)
        withheld = None if start_share == 1.0 else (1.0 - start_share) * self._start_wall_effort
        applied, walls = self._limits.restrain_effort(self.effort, q, v, withheld)
        return self._output(lcmt_dvrk_command.EFFORT, q, effort=applied, joint_flags=flags | walls)

    def _output(self, mode: int, position: Vector, **arrays: NDArray[Any]) -> GuardOutput:
        """Returns an output with `arrays`, whose arrays the caller may change. Arrays that are not given are zero."""
        zero, no_flags = self._zero, np.zeros(len(position), np.int8)
        zeros: dict[str, NDArray[Any]] = {"velocity": zero.copy(), "effort": zero.copy(), "joint_flags": no_flags}
        return GuardOutput(mode, position.copy(), **(zeros | arrays))
