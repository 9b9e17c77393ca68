"""Plausibility checks of measurements that are finite and recent but may be stuck, jumping or inconsistent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from dvrk_drake.systems.guard.limits import ArmModel, Mask, Vector, is_any
from dvrk_drake.systems.guard.part import Part
from dvrk_drake.systems.guard.settings import PlausibilitySettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: Time between two evaluations of the mass matrix [s]. One evaluation takes as long as one step of the guard.
_MASS_MATRIX_PERIOD = 0.05

#: Time after the first measurement in which the effort may change without a motion [s]. The effort changes when the
#: motors are switched on. There is no motion if the arm lies on an object.
_POWER_ON = 0.25

#: Number of encoder counts that are added to each position tolerance.
_COUNTS = 3.0


@dataclass(slots=True)
class Sample:
    """Measurement of n joints with derived quantities.

    Attributes:
        dt: Time since the previous measurement [s].
        q: Measured positions (n,) [rad, m].
        v: Measured velocities (n,) [rad/s, m/s].
        step: Change of position (n,) [rad, m] since the previous measurement.
        speed: Larger value (n,) of the speeds in this measurement and in the previous measurement [rad/s, m/s].
        effort: Measured effort (n,) [N m, N] of the motors.
        net_effort: Measured effort (n,) [N m, N] minus the gravity effort of the model.
        commanded: Effort (n,) [N m, N] that the guard commanded in the previous step, or None if it commanded no
            effort.
    """

    dt: float
    q: Vector
    v: Vector
    step: Vector
    speed: Vector
    effort: Vector
    net_effort: Vector
    commanded: Vector | None


class Check(Part, ABC):
    """Plausibility check of successive samples.

    Attributes:
        text: Description of the error that this check detects.
        about_position: True if the position of a joint with this error is invalid.
        uses_effort: True if the check requires the measured effort.
    """

    text: ClassVar[str]
    about_position: ClassVar[bool] = True
    uses_effort: ClassVar[bool] = True

    def begin(self, sample: Sample) -> None:
        """Starts with the first sample, which is not checked. By default, a check has no state."""

    @abstractmethod
    def check(self, sample: Sample) -> Mask:
        """Returns a mask (n,) of the joints whose measurement is implausible in the next sample."""


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
    - r is the allowed error of a velocity that is estimated from the time between two encoder counts.
    """

    text, uses_effort = "position and velocity disagree", False

    def __init__(self, settings: PlausibilitySettings, tolerance: Vector, counts: Vector) -> None:
        """Creates the check with tolerances (n,) and encoder counts (n,) of the joints [rad, m]."""
        self._delay, self._memory = settings.velocity_delay, settings.velocity_memory
        self._tolerance = tolerance + self._memory * settings.velocity_counts * counts

    def begin(self, sample: Sample) -> None:
        """See `Check.begin`."""
        self._error, self._speed = np.zeros_like(sample.q), sample.speed

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        decay = max(1.0 - sample.dt / self._memory, 0.0)
        self._error = decay * self._error + sample.step - sample.dt * sample.v
        self._speed = np.maximum(decay * self._speed, sample.speed)
        return np.abs(self._error) > self._tolerance + self._delay * self._speed


class FrozenPosition(Check):
    """Check for positions that stay constant while the effort on the joint changes.

    Cables and structure between the motor encoders and the links are elastic. A large change of the effort therefore
    turns the encoder by at least one count, even if the joint presses against a stop or is held by a hand.
    """

    text = "the position does not change although the effort does"

    def __init__(self, settings: PlausibilitySettings, effort_limits: Vector, counts: Vector) -> None:
        """Creates the check with effort limits (n,) [N m, N] and encoder counts (n,) [rad, m] of the joints."""
        self._allowed = settings.frozen_effort * effort_limits
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


class Response(Check):
    """Check that accelerations agree with the efforts.

    The unexplained effort r = filter(tau - G(q)) - M(q) filter(vd) contains friction, external forces, model errors,
    and errors of sensors or motors. G(q) is the gravity effort, M(q) the mass matrix, and vd the acceleration. With a
    first-order low-pass filter of time constant T, filter(vd) = (v - filter(v)) / T, so the velocity is not
    differentiated. The slowly varying part of r is attributed to model errors and subtracted. Coriolis terms are
    omitted, because they are small at the allowed speeds.
    """

    text = "the motion does not follow from the effort"

    def __init__(self, settings: PlausibilitySettings, arm: Arm, model: ArmModel) -> None:
        """Creates the check for the joints of `arm` with the model of that arm."""
        self._allowed = settings.response * arm.effort_limits + settings.hand_efforts(arm)
        self._filter_time, self._memory, self._model = settings.response_time, settings.response_memory, model

    def begin(self, sample: Sample) -> None:
        """See `Check.begin`."""
        self._effort, self._velocity, self._lasting = sample.net_effort, sample.v, sample.net_effort
        self._age = np.inf  # of M(q) / T [s]

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        self._age += sample.dt
        if self._age > _MASS_MATRIX_PERIOD:
            self._M, self._age = self._model.mass_matrix(sample.q) / self._filter_time, 0.0
        gain = min(sample.dt / self._filter_time, 1.0)
        self._effort = self._effort + gain * (sample.net_effort - self._effort)
        self._velocity = self._velocity + gain * (sample.v - self._velocity)
        unexplained = self._effort - self._M.dot(sample.v - self._velocity) - self._lasting
        self._lasting = self._lasting + min(sample.dt / self._memory, 1.0) * unexplained
        # Negated comparison, so that NaN counts as implausible.
        return ~(np.abs(unexplained) <= self._allowed)


class SilentEffort(Check):
    """Check that measured efforts follow commanded efforts. It detects sensors that read zero, and unpowered motors."""

    text, about_position = "the measured effort does not follow the commanded effort", False

    def __init__(self, settings: PlausibilitySettings, arm: Arm) -> None:
        """Creates the check for the joints of `arm`."""
        self._commanded, self._allowed = settings.silent_effort * arm.effort_limits, settings.silent_time
        self._least = 0.1 * self._commanded
        self._J, self._J_inverse = arm.transmission.matrix, arm.transmission.inverse.matrix
        self._largest = np.array([arm.effects.saturation.get(name, np.inf) for name in arm.joint_names])

    def begin(self, sample: Sample) -> None:
        """See `Check.begin`."""
        self._time = np.zeros_like(sample.q)  # for which the measured effort has not followed the commanded one [s]

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        if sample.commanded is None:
            self._time = 0.0 * self._time
        else:
            missing = self._is_missing(sample.commanded, sample.effort)
            if is_any(missing):
                # Coupled actuators may saturate although each joint effort is inside its limit.
                actuators = np.clip(sample.commanded @ self._J_inverse, -self._largest, self._largest)
                missing &= self._is_missing(actuators @ self._J, sample.effort)
            self._time = missing * (self._time + sample.dt)
        return self._time > self._allowed

    def _is_missing(self, commanded: Vector, effort: Vector) -> Mask:
        size = np.abs(commanded)
        return (size > self._commanded) & (commanded * effort < self._least * size)


class Plausibility(Part):
    """All plausibility checks of an arm's measurements, applied sample by sample.

    Attributes:
        gravity: Gravity effort (n,) [N m, N] of the model at the last sample.
        invalid: Mask (n,) of joints whose position was found invalid since the last `restart`.
        fault: Description of the error of the last sample, or "" for a plausible sample.
        last_valid: Last valid positions (n,) [rad, m] of the `invalid` joints; undefined for all other joints.
    """

    def __init__(self, arm: Arm, model: ArmModel, settings: PlausibilitySettings, speed_limit: Vector) -> None:
        """Creates the checks for `arm`.

        Args:
            arm: Arm with n joints.
            model: Model of that arm with its actual base orientation.
            settings: Tolerances of the checks.
            speed_limit: Speed limits (n,) [rad/s, m/s] that the guard enforces.
        """
        self.model, self._names = model, arm.joint_names
        counts = arm.encoder_counts()
        tolerance = arm.per_joint(settings.position_tolerance, 0.1 * settings.position_tolerance) + _COUNTS * counts
        self._detection_time = settings.detection_time
        self._checks: tuple[Check, ...] = (
            PositionJump(settings, tolerance, speed_limit),
            VelocityConsistency(settings, tolerance, counts),
            FrozenPosition(settings, arm.effort_limits, counts),
            Response(settings, arm, model),
            SilentEffort(settings, arm),
        )
        self._none = np.zeros(arm.num_joints, bool)
        self.gravity = self.last_valid = np.zeros(arm.num_joints)
        self._poses, self._pose_age = (self.last_valid, self.last_valid), 0.0
        self.restart()

    def __deepcopy__(self, memo: object) -> Self:
        """Returns a copy whose checks change independently as well."""
        other = super().__deepcopy__(memo)
        other._checks = tuple(check.__deepcopy__(memo) for check in self._checks)
        return other

    def restart(self) -> None:
        """Marks all positions as valid. The checks restart with the next sample."""
        self.invalid, self.fault = self._none, ""
        self.forget()

    @property
    def is_first(self) -> bool:
        """True if the next sample will not be compared with a previous sample."""
        return self._before is None

    def forget(self) -> None:
        """Discards the previous samples, so that the next sample is not compared with them."""
        self._before: tuple[Vector, Vector] | None = None

    def check(
        self,
        dt: float,
        q: Vector,
        v: Vector,
        effort: Vector,
        commanded: Vector | None,
        invalid_effort: Mask | None = None,
    ) -> str:
        """Checks one measurement. All arrays must be finite, and the caller must not change them afterwards.

        Args:
            dt: Time since the previous measurement [s].
            q: Measured positions (n,) [rad, m].
            v: Measured velocities (n,) [rad/s, m/s].
            effort: Measured efforts (n,) [N m, N].
            commanded: Effort (n,) [N m, N] that the guard commanded in the previous step, or None if it commanded no
                effort.
            invalid_effort: Mask (n,) of joints without a valid effort, whose efforts are not checked. None: all efforts
                are valid.

        Returns:
            Description of the detected error, or "" if the measurement is plausible.
        """
        self.gravity, self.fault = self.model.gravity_effort(q), ""
        speed = np.abs(v)
        if self._before is None:
            sample = Sample(dt, q, v, 0.0 * q, speed, effort, effort - self.gravity, commanded)
            for check in self._checks:
                check.begin(sample)
            self._poses, self._pose_age = (q, q), 0.0
        else:
            q_before, speed_before = self._before
            fastest = np.maximum(speed, speed_before)
            sample = Sample(dt, q, v, q - q_before, fastest, effort, effort - self.gravity, commanded)
            results = [check.check(sample) for check in self._checks]
            if any(is_any(joints) for joints in results):
                for check, joints in zip(self._checks, results, strict=True):
                    ignored = invalid_effort if check.uses_effort else None
                    self._report(check, joints if ignored is None else joints & ~ignored)
            self._pose_age += dt
            if self._pose_age > self._detection_time:
                self._poses, self._pose_age = (self._poses[1], q), 0.0
        self._before = q, speed
        return self.fault

    def _report(self, check: Check, joints: Mask) -> None:
        if not is_any(joints):
            return
        if not self.fault:
            self.fault = f"{', '.join(self._names[j] for j in np.flatnonzero(joints))}: {check.text}"
        if check.about_position:
            self.reject(joints)

    def reject(self, joints: Mask) -> None:
        """Marks the positions of `joints` (n,) as invalid. The guard calls this method if measurements are missing."""
        # An error begins before its detection. The last valid positions are therefore taken from an earlier pose.
        self.last_valid = np.where(joints & ~self.invalid, self._poses[0], self.last_valid)
        self.invalid = self.invalid | joints
