"""Limits of effort, rate and position that a command guard applies to accepted commands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import SoftWalls
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


def clip(x: Vector, lower: ArrayLike, upper: ArrayLike) -> Vector:
    """Returns x (n,) limited to the range from lower to upper. For small arrays, np.clip is slower."""
    return np.minimum(np.maximum(x, lower), upper)


def is_any(mask: Mask) -> bool:
    """Returns whether any element of the mask (n,) is true. For small arrays, mask.any() is slower."""
    return True in mask.tolist()


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
