"""Last measurement of an arm with checks of its clock and numbers, and monitors of periods, ages and oscillations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.systems.guard.limits import Mask, Part, Vector, is_any, is_finite

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.systems.guard.settings import GuardSettings

#: Largest number of steps without an advance of the arm's clock. While this clock stands still, commands do not expire
#: by it. Several steps are allowed, because Drake updates the guard twice at time zero.
_MAX_STEPS_AT_ONE_TIME = 10


@dataclass
class Measurement(Part):
    """Last measurement of an arm with n joints. All times in us are on the arm's clock.

    Attributes:
        joint_names: Names of the n joints.
        max_age: Largest age of a valid measurement [us].
        utime: Time of the last step [us], or None before the first step.
        q: Last valid position (n,) of each joint [rad, m], or None before the first valid measurement.
        v: Last valid velocity (n,) of each joint [rad/s, m/s].
        effort: Last valid motor effort (n,) [N m, N] of each joint.
        invalid_pose: Mask (n,) of the joints whose position and velocity the last measurement does not contain.
        invalid_effort: Mask (n,) of the joints whose effort in the last measurement is not finite.
        dt: Time between the last two valid measurements [s]; 0 for a repeated measurement, inf for the first
            measurement.
        num_invalid: Number of consecutive invalid measurements up to now.
    """

    joint_names: tuple[str, ...]
    max_age: int
    utime: int | None = None
    q: Vector | None = None
    v: Vector = field(init=False)
    effort: Vector = field(init=False)
    invalid_pose: Mask = field(init=False)
    invalid_effort: Mask = field(init=False)
    dt: float = math.inf
    num_invalid: int = 0
    _measured_utime: int | None = None
    _steps_at_one_time: int = 0
    _effort_problem: str = ""

    def __post_init__(self) -> None:
        self.v = self.effort = np.zeros(len(self.joint_names))
        self.invalid_effort = self._none = np.zeros(len(self.joint_names), bool)
        self.invalid_pose = ~self._none

    @property
    def is_pose_valid(self) -> bool:
        """True if the last measurement has a valid pose. Its efforts may nevertheless be invalid."""
        return not self.invalid_pose.any()

    def advance(self, utime: int) -> tuple[float, str]:
        """Advances to `utime` [us]. Returns the elapsed time [s] and the description of a clock fault, or ""."""
        dt = 0.0 if self.utime is None else 1e-6 * (utime - self.utime)
        self._steps_at_one_time = 0 if dt else self._steps_at_one_time + 1
        self.utime = utime
        if dt < 0:
            self._measured_utime = None
            return dt, f"the arm's clock went back by {-dt:.6f} s"
        return dt, "the arm's clock stands still" if self._steps_at_one_time > _MAX_STEPS_AT_ONE_TIME else ""

    def time_since(self, measured_utime: int) -> float:
        """Returns the time [s] from the last valid measurement to `measured_utime` [us], or inf without a valid one."""
        return math.inf if self._measured_utime is None else 1e-6 * (measured_utime - self._measured_utime)

    def store(
        self,
        measured_utime: int,
        q: ArrayLike,
        v: ArrayLike,
        effort: ArrayLike,
        implausible_pose: Callable[[Vector], str] | None = None,
    ) -> str:
        """Stores a measurement. A position or an effort that is not finite is replaced by the last valid one.

        If some positions or velocities are not finite, the measurement is invalid, but the other joints can be
        regulated.

        Args:
            measured_utime: Time of the measurement [us].
            q: Positions (n,) [rad, m].
            v: Velocities (n,) [rad/s, m/s].
            effort: Applied motor efforts (n,) [N m, N].
            implausible_pose: Function that returns the reason why a pose is implausible, or "" for a plausible pose.
                The caller passes this function for a measurement that will not be compared with an earlier one. None:
                the pose is not checked.

        Returns:
            Reason why the measurement is invalid, or "" for a valid measurement.
        """
        assert self.utime is not None
        age, dt = self.utime - measured_utime, self.time_since(measured_utime)
        is_recent = 0 <= age <= self.max_age
        if dt == 0 and is_recent:
            self.dt = 0.0
            return self._effort_problem
        self.num_invalid += 1
        self.invalid_pose = ~self._none
        if not is_recent:
            return f"the measurement is {1e-6 * age:.3f} s old; allowed: 0 to {1e-6 * self.max_age:g} s"
        if dt < 0:
            return f"the measurement is {-dt:.6f} s older than the previous one"
        q, v, effort = (np.array(numbers, float) for numbers in (q, v, effort))
        n = len(self.joint_names)
        if not q.shape == v.shape == effort.shape == (n,):
            return f"the measurement is not {n} positions, velocities and efforts"
        if is_finite([*q.tolist(), *v.tolist()]):
            if implausible_pose is not None and (problem := implausible_pose(q)):
                return problem
            self.dt, self.q, self.v, self._measured_utime, self.invalid_pose = dt, q, v, measured_utime, self._none
            if is_finite(effort.tolist()):
                self.effort, self.invalid_effort, self.num_invalid, self._effort_problem = effort, self._none, 0, ""
                return ""
        self.invalid_effort = _is_invalid(effort)
        self.effort = np.where(self.invalid_effort, self.effort, effort)
        if self.is_pose_valid:
            self._effort_problem = f"{self._names(self.invalid_effort)}: the measured effort is not a finite number"
            return self._effort_problem
        invalid = _is_invalid(q) | _is_invalid(v)
        if self.q is not None:
            self.q, self.v = np.where(invalid, self.q, q), np.where(invalid, self.v, v)
            self.invalid_pose = invalid
        return f"{self._names(invalid)}: the measured position or velocity is not a finite number"

    def _names(self, joints: Mask) -> str:
        return ", ".join(self.joint_names[j] for j in np.flatnonzero(joints))


def _is_invalid(numbers: Vector) -> Mask:
    """Returns a mask (n,) of the numbers that are not finite, or too large, see `is_finite`."""
    # Negated comparison, so that NaN counts as invalid.
    return ~(np.abs(numbers) < IMPLAUSIBLE / len(numbers))


#: Number of periods whose median is checked.
_PERIODS = 100

#: Number of commands whose median age is checked.
_AGES = 20

#: Time constant [s] of the low-pass filter whose output is subtracted from the effort. Changes of the effort below
#: about 1 Hz therefore do not count as oscillations.
_MEAN_TIME = 0.2


class _MedianMonitor(Part):
    """Monitor of the median of the last values."""

    def __init__(self, limit: float, count: int) -> None:
        """Creates a monitor without any value, which compares the median of `count` values with `limit`."""
        self._limit, self._count = limit, count
        self.restart()

    def restart(self) -> None:
        """Discards all values."""
        # One bit per value, set for a value above the limit. An int is fast to copy, shift and count.
        self._large = 0

    def _exceeds(self, value: float) -> bool:
        """Adds a value. Returns whether more than half of the last values exceed the limit."""
        self._large = (self._large << 1 | (value > self._limit)) & ((1 << self._count) - 1)
        return self._large.bit_count() > self._count // 2


class PeriodMonitor(_MedianMonitor):
    """Monitor of the time between two steps of the guard. It checks the last period and the median of 100 periods.

    Attributes:
        fault: Description of the fault in the last periods, or "" if they are valid.
    """

    def __init__(self, settings: GuardSettings) -> None:
        """Creates a monitor without any period."""
        super().__init__(settings.slow_period, _PERIODS)
        self._longest_period = settings.longest_period
        self.fault = ""

    def add(self, period: float) -> str:
        """Adds one period [s]. Returns the description of a fault, or "" without a fault."""
        is_slow = self._exceeds(period)
        self.fault = ""
        if period > self._longest_period:
            self.fault = (
                f"the guard was not stepped for {1e3 * period:.0f} ms; {1e3 * self._longest_period:g} ms are allowed"
            )
        elif is_slow:
            self.fault = f"the median period of the guard is above the allowed {1e3 * self._limit:g} ms"
        return self.fault


class AgeMonitor(_MedianMonitor):
    """Monitor of the ages of commands at their arrival, e.g. during a flood of messages. It checks their median.

    A command that answers an old measurement closes a control loop with a delay. The loop may be unstable although the
    command has not expired.
    """

    def __init__(self, settings: GuardSettings) -> None:
        """Creates a monitor without any command."""
        super().__init__(1e6 * settings.command_age, _AGES)

    def add(self, age: int) -> str:
        """Adds the age of a command at its arrival [us]. Returns the description of a fault, or "" without a fault."""
        if not self._exceeds(age):
            return ""
        return (
            f"commands arrive too late: the median age of the last {_AGES} is above the allowed "
            f"{1e-3 * self._limit:g} ms"
        )


class OscillationMonitor(Part):
    """Monitor that counts reversals of the efforts of the joints. The count decays exponentially.

    The alternating part of an effort is x = tau - filter(tau), with a first-order low-pass filter. A reversal is a
    change of x from above h to below -h, or from below -h to above h. The threshold h is the fraction `oscillation` of
    the effort limit. The monitor counts the reversals of each signal, e.g. those of the commands and those of the
    output, which includes soft walls and the speed limit.
    """

    def __init__(self, settings: GuardSettings, arm: Arm, *texts: str) -> None:
        """Creates a monitor for the joints of `arm`, with one description of an oscillation per signal."""
        self._scale, self._time = 1.0 / (settings.oscillation * arm.effort_limits), settings.oscillation_time
        self._allowed, self._names, self._texts = settings.oscillation_reversals, arm.joint_names, texts
        self._mean: Vector | None = None

    def restart(self) -> None:
        """Resets the counts and filters."""
        self._mean = None

    def add(self, dt: float, *efforts: Vector) -> str:
        """Adds the efforts of each signal (n,) [N m, N] that act for `dt` [s].

        Returns:
            Joint and description of its oscillation, or "" if no joint oscillates. If several signals of this joint
            oscillate, the description is that of the first.
        """
        scaled = np.concatenate([self._scale * effort for effort in efforts])
        if self._mean is None:
            self._mean = scaled
            self._side = self._reversals = np.zeros_like(scaled)
            self._since = 0.0
            return ""
        alternating = scaled - self._mean
        self._mean = self._mean + dt / _MEAN_TIME * alternating
        self._since += dt
        large = np.abs(alternating) >= 1.0
        if not is_any(large):
            return ""
        side = np.where(large, np.sign(alternating), self._side)
        self._reversals = math.exp(-self._since / self._time) * self._reversals + (side * self._side < 0)
        self._since = 0.0
        self._side = side
        worst = int(self._reversals.argmax())
        if not self._reversals[worst] > self._allowed:
            return ""
        joint = worst % len(self._names)
        # The cause of an oscillation comes first in the signals. Its count may be behind that of the effect.
        counts = self._reversals[joint :: len(self._names)]
        return f"{self._names[joint]}: {self._texts[int(np.argmax(counts > 0.5 * self._allowed))]}"
