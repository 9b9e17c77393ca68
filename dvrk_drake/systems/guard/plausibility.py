"""Plausibility of measurements that are finite and recent but may be stuck, jumping or inconsistent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from dvrk_drake.systems.guard.limits import ArmModel, Mask, Part, Vector, clip, is_any
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


#: Time between two evaluations of the mass matrix [s]. One evaluation takes as long as one step of the guard.
_MASS_MATRIX_PERIOD = 0.05

#: Smallest commanded effort at which a measured effort of exactly zero is wrong, as a fraction of the effort limit. The
#: current sensors of the dVRK have resolutions below 0.001 of the limit, and a noise of about three steps.
_LEAST_EFFORT = 0.02


class Response(Check):
    """Check that accelerations agree with the efforts.

    The driving effort is x = filter(tau - G(q)), and the inertial effort is y = M(q) filter(vd). G(q) is the gravity
    effort, M(q) the mass matrix, and vd the acceleration. With a first-order low-pass filter of time constant T,
    filter(vd) = (v - filter(v)) / T, so the velocity is not differentiated. The slowly varying part of x - y is
    attributed to model errors and subtracted from x. Coriolis terms are omitted, because they are small at the allowed
    speeds. The check compares two quantities with their tolerances:

    - The unexplained effort |x - y| contains friction, external forces, model errors, and errors of sensors or motors.
    - The opposed effort is (|x - y| - 3 |x + y|) / 2, low-pass filtered. It detects an inverted encoder or motor, which
      accelerates the joint against its effort: x + y is the friction, and the opposed effort is almost |x|. It counts
      only while both x and y grow, as in the unstable loop, and while y opposes the whole driving effort. If a hand
      presses a joint against a controller or a soft wall and lets go, y opposes only the change of the effort, and
      decreases while this change grows.
    """

    text = "the motion does not follow from the effort"

    def __init__(self, settings: PlausibilitySettings, arm: Arm, model: ArmModel, counts: Vector) -> None:
        """Creates the check for the joints of `arm` with the model of that arm and encoder counts (n,) [rad, m]."""
        self._allowed = settings.response * arm.effort_limits + settings.hand_efforts(arm)
        self._opposed_allowed = settings.opposed_effort * arm.effort_limits
        self._velocity_error = settings.velocity_counts * counts
        self._filter_time, self._memory, self._model = settings.response_time, settings.response_memory, model

    def begin(self, sample: Sample) -> None:
        """See `Check.begin`."""
        self._effort, self._velocity, self._lasting = sample.net_effort, sample.v, sample.net_effort
        self._opposed = self._driving_size = self._inertial_size = np.zeros_like(sample.q)
        self._age = np.inf  # of M(q) / T [s]

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        self._age += sample.dt
        if self._age > _MASS_MATRIX_PERIOD:
            self._M, self._age = self._model.mass_matrix(sample.q) / self._filter_time, 0.0
            # An error of the velocity acts like an inertial effort.
            self._opposed_tolerance = self._opposed_allowed + self._M.diagonal() * self._velocity_error
        gain = min(sample.dt / self._filter_time, 1.0)
        self._effort = self._effort + gain * (sample.net_effort - self._effort)
        self._velocity = self._velocity + gain * (sample.v - self._velocity)
        driving, inertial = self._effort - self._lasting, self._M.dot(sample.v - self._velocity)
        unexplained = driving - inertial
        self._lasting = self._lasting + min(sample.dt / self._memory, 1.0) * unexplained
        size, driving_size, inertial_size = np.abs(unexplained), np.abs(driving), np.abs(inertial)
        opposed = 0.5 * size - 1.5 * np.abs(driving + inertial)
        self._opposed = (1.0 - gain) * self._opposed
        if is_any(opposed > 0.0):
            grows = (driving_size > self._driving_size) & (inertial_size > self._inertial_size)
            counts = grows & (self._effort * inertial < 0.0) & (opposed > 0.0)
            self._opposed = self._opposed + gain * counts * opposed
        self._driving_size = self._driving_size + gain * (driving_size - self._driving_size)
        self._inertial_size = self._inertial_size + gain * (inertial_size - self._inertial_size)
        # Negated comparison, so that NaN counts as implausible.
        return ~((size <= self._allowed) & (self._opposed <= self._opposed_tolerance))


class EffortTracking(Check):
    """Check that measured efforts follow commanded efforts. It detects wrong sensors and unpowered motors.

    The difference between the commanded and the measured effort is low-pass filtered, so that the measurement may be
    delayed. In addition, the measured effort must not be exactly zero. A sensor with noise does not measure exactly
    zero.
    """

    text, about_position = "the measured effort does not follow the commanded effort", False

    def __init__(self, settings: PlausibilitySettings, arm: Arm) -> None:
        """Creates the check for the joints of `arm`."""
        self._tolerance, self._scale = settings.tracking_error * arm.effort_limits, settings.tracking_scale
        self._filter_time, self._zero_time = settings.tracking_time, settings.zero_time
        self._least = _LEAST_EFFORT * arm.effort_limits
        self._J, self._J_inverse = arm.transmission.matrix, arm.transmission.inverse.matrix
        self._largest = np.array([arm.effects.saturation.get(name, np.inf) for name in arm.joint_names])
        # Commands below this effort saturate no actuator.
        share = np.min(self._largest / (arm.effort_limits @ np.abs(self._J_inverse)))
        self._unsaturated = share * arm.effort_limits

    def begin(self, sample: Sample) -> None:
        """See `Check.begin`."""
        self._difference = self._zero = self._time = np.zeros_like(sample.q)

    def check(self, sample: Sample) -> Mask:
        """See `Check.check`."""
        commanded = sample.commanded
        if commanded is None:
            self._difference = self._time = self._zero
            return self._zero > 0.0
        size, expected = np.abs(commanded), commanded
        if is_any(size > self._unsaturated):
            # Coupled actuators may saturate although each joint effort is inside its limit. An arm whose motors are
            # stronger than its file states has no fault.
            saturated = clip(commanded @ self._J_inverse, -self._largest, self._largest) @ self._J
            expected = clip(sample.effort, np.minimum(saturated, commanded), np.maximum(saturated, commanded))
        gain = min(sample.dt / self._filter_time, 1.0)
        self._difference = self._difference + gain * (expected - sample.effort - self._difference)
        wrong = np.abs(self._difference) > self._tolerance + self._scale * size
        if 0.0 not in sample.effort.tolist():
            self._time = self._zero
            return wrong
        self._time = ((sample.effort == 0) & (size > self._least)) * (self._time + sample.dt)
        return wrong | (self._time > self._zero_time)


#: Number of encoder counts that are added to each position tolerance.
_COUNTS = 3.0


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
            FrozenPosition(settings, arm, counts),
            Response(settings, arm, model, counts),
            EffortTracking(settings, arm),
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
        self.invalid, self.fault, self._wrong_effort = self._none, "", self._none
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
                # An effort of exactly zero was probably not measured. It proves no error of a position.
                no_effort = self._none if invalid_effort is None else invalid_effort
                no_proof = no_effort | self._wrong_effort | (effort == 0)
                for check, joints in zip(self._checks, results, strict=True):
                    ignored = no_proof if check.about_position else no_effort
                    self._report(check, joints & ~ignored if check.uses_effort else joints)
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
        else:
            self._wrong_effort = self._wrong_effort | joints

    def reject(self, joints: Mask) -> None:
        """Marks the positions of `joints` (n,) as invalid. The guard calls this method if measurements are missing."""
        # An error begins before its detection. The last valid positions are therefore taken from an earlier pose.
        self.last_valid = np.where(joints & ~self.invalid, self._poses[0], self.last_valid)
        self.invalid = self.invalid | joints
