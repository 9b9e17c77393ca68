"""Plausibility checks of positions: jumps, disagreement with the velocity, and constant positions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dvrk_drake.systems.guard.limits import Mask, Vector, clip, is_any
from dvrk_drake.systems.guard.part import Check, Sample
from dvrk_drake.systems.guard.settings import PlausibilitySettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: Time after the first measurement in which the effort may change without a motion [s]. The effort changes when the
#: motors are switched on. There is no motion if the arm lies on an object.
_POWER_ON = 0.25

#: Number of encoder counts that are added to the tolerance of the second difference of position and velocity. With this
#: number, the largest difference in recordings of a real MTM, whose wrist has coarse encoders, is 0.7 of the tolerance.
_ROUNDING_COUNTS = 3.0

#: Largest change of effort without a change of position on a coarse encoder, as a fraction of the effort limit. In
#: normal use of the simulated MTM, the effort of the wrist yaw changes by 0.3 of its limit before the next count.
_LARGEST_FROZEN_EFFORT = 0.45


class PositionJump(Check):
    """Check for impossible position steps: |dq| > tolerance + (dt + jitter) min(|v|, 1.5 speed limit)."""

    text, uses_effort = "the position jumps", False

    def __init__(self, settings: PlausibilitySettings, tolerance: Vector, speed_limit: Vector) -> None:
        """Creates the check with tolerances (n,) [rad, m] and speed limits (n,) [rad/s, m/s] of the joints."""
        self._tolerance, self._fastest, self._jitter = tolerance, 1.5 * speed_limit, settings.jitter

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        allowed = (sample.dt + self._jitter) * np.minimum(sample.speed, self._fastest)
        return np.abs(sample.step) > self._tolerance + allowed


class VelocityConsistency(Check):
    """Check that the measured velocity agrees with the change of the measured position.

    The difference e between the change of position and the integrated velocity decays with the time constant T:

        e[k] = (1 - dt/T) e[k-1] + dq - v dt,    |e[k]| <= tolerance + r T + delay s

    - s is the largest recent speed. It decays with the same time constant. The term `delay s` accounts for the delay of
      the velocity estimate while the joint accelerates.
    - r is the allowed error of a velocity that is estimated from the time between two encoder counts. Such a velocity
      stays almost constant until the next count, also if the joint has stopped. On a coarse encoder, r is large.

    On joints with a coarse encoder, a second difference changes only with the position. It needs no allowance r T, and
    detects slow motions that the velocity does not contain. The change dq since the previous count is compared with
    the smaller of two travels, if they have the same sign: the integral of v since that count, and the present v times
    the time since that count. The second travel is correct for a velocity that was held. The tolerance contains a few
    counts, because each position is rounded, and a relative error `velocity_scale` of the speed.
    """

    text, uses_effort = "position and velocity disagree", False

    def __init__(self, settings: PlausibilitySettings, tolerance: Vector, counts: Vector) -> None:
        """Creates the check with tolerances (n,) and encoder counts (n,) of the joints [rad, m]."""
        self._delay, self._memory = settings.velocity_delay, settings.velocity_memory
        self._tolerance = tolerance + self._memory * settings.velocity_counts * counts
        self._count_tolerance = tolerance + _ROUNDING_COUNTS * counts
        self._count_delay = self._delay + settings.velocity_scale * self._memory
        self._is_coarse = self._tolerance > 2.0 * self._count_tolerance
        self._has_coarse = is_any(self._is_coarse)

    def begin(self, sample: Sample) -> None:
        """See `Check.begin`."""
        self._error = self._count_error = self._count_speed = self._travel = self._time = np.zeros_like(sample.q)
        self._speed = sample.speed

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        decay = max(1.0 - sample.dt / self._memory, 0.0)
        travel = sample.dt * sample.v
        self._error = decay * self._error + sample.step - travel
        self._speed = np.maximum(decay * self._speed, sample.speed)
        wrong = np.abs(self._error) > self._tolerance + self._delay * self._speed
        if not self._has_coarse:
            return wrong
        self._travel, self._time = self._travel + travel, self._time + sample.dt
        self._count_error, self._count_speed = decay * self._count_error, decay * self._count_speed
        moved = (sample.step != 0) & self._is_coarse
        return wrong | self._compare_at_counts(sample, moved) if is_any(moved) else wrong

    def _compare_at_counts(self, sample: Sample, moved: Mask) -> Mask:
        """Adds the difference since the previous count of the joints that `moved` (n,). Returns the mask (n,)."""
        travel = clip(self._time * sample.v, np.minimum(self._travel, 0.0), np.maximum(self._travel, 0.0))
        self._count_error = self._count_error + moved * (sample.step - travel)
        self._count_speed = np.maximum(self._count_speed, moved * np.abs(travel) / self._time)
        self._travel, self._time = np.where(moved, 0.0, self._travel), np.where(moved, 0.0, self._time)
        return np.abs(self._count_error) > self._count_tolerance + self._count_delay * self._count_speed


class FrozenPosition(Check):
    """Check for positions that stay constant while the effort on the joint changes.

    Cables and structure between the motor encoders and the links are elastic. A large change of the effort therefore
    turns the encoder by at least one count, even if the joint presses against a stop or is held by a hand. The change
    is large if it exceeds the hysteresis `frozen_effort` plus the effort for one count. The stiffness follows from the
    setting `frozen_deflection`.
    """

    text = "the position does not change although the effort does"

    def __init__(self, settings: PlausibilitySettings, arm: Arm, counts: Vector) -> None:
        """Creates the check for the joints of `arm` with encoder counts (n,) [rad, m]."""
        deflection = arm.per_joint(settings.frozen_deflection, 0.1 * settings.frozen_deflection)
        share = np.minimum(settings.frozen_effort + counts / deflection, _LARGEST_FROZEN_EFFORT)
        self._allowed = np.maximum(share, settings.frozen_effort) * arm.effort_limits
        self._least_time = settings.frozen_time + counts / settings.frozen_speed

    def begin(self, sample: Sample) -> None:
        """See `Check.begin`."""
        self._age, self._effort = 0.0, sample.net_effort  # effort at the last change of the position
        self._time = np.zeros_like(sample.q)  # since the change of effort became too large [s]

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        moved = (sample.step != 0) | (self._age < _POWER_ON)
        self._effort = np.where(moved, sample.net_effort, self._effort)
        self._time = (np.abs(sample.net_effort - self._effort) > self._allowed) * (self._time + sample.dt)
        self._age += sample.dt
        return self._time > self._least_time
