"""Plausibility checks of finite, recent measurements that may be wrong: stuck, jumping or inconsistent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.systems.guard.limits import Mask, Vector, is_any
from dvrk_drake.systems.guard.settings import PlausibilitySettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

#: Period of evaluating the mass matrix [s]. It changes slowly, and its evaluation takes as long as a step of the guard.
_MASS_MATRIX_PERIOD = 0.05

#: Time after power on in which an arm that rests on an object may take up its effort without a motion [s].
_POWER_ON = 0.25

#: Encoder counts by which measured positions may deviate in addition to the tolerances.
_COUNTS = 3.0


class ArmModel(Protocol):
    """Protocol of the arm model that the guard uses, such as `dvrk_drake.dynamics.identified_model.ControlModel`."""

    def gravity_effort(self, q: Vector) -> Vector:
        """Returns the effort (n,) [N m, N] that compensates gravity at q (n,) [rad, m]."""

    def mass_matrix(self, q: Vector) -> NDArray[np.float64]:
        """Returns the mass matrix (n, n) at q (n,)."""


@dataclass(slots=True)
class Sample:
    """One measurement of n joints with related quantities. SI units; prismatic joints in m and N.

    Attributes:
        dt: Time since the previous measurement [s].
        q, v: Measured positions and velocities (n,).
        step: Change of position (n,) since the previous measurement.
        speed: Larger magnitude (n,) of the velocities of both measurements.
        effort: Measured effort (n,) of the motors.
        net_effort: Measured effort (n,) minus the model's gravity effort.
        commanded: Effort (n,) that the guard commanded before, or None while it commands positions.
    """

    dt: float
    q: Vector
    v: Vector
    step: Vector
    speed: Vector
    effort: Vector
    net_effort: Vector
    commanded: Vector | None


class Check(Protocol):
    """Protocol of one plausibility check. It has no state of its own, as Drake copies the guard at every update.

    Attributes:
        text: Description of the error of a joint that the check finds.
        about_position: True if the position of such a joint is invalid.
    """

    text: str
    about_position: bool

    def begin(self, sample: Sample) -> Any:
        """Returns the state before `sample`, the first sample."""

    def check(self, sample: Sample, state: Any) -> tuple[Any, Mask]:
        """Returns the next state and a mask (n,) of the implausible joints."""


class PositionJump:
    """Check of position steps that no joint can make: |dq| > tolerance + (dt + jitter) min(|v|, 1.5 speed limit)."""

    text, about_position = "the position jumps", True

    def __init__(self, settings: PlausibilitySettings, tolerance: Vector, speed_limit: Vector) -> None:
        """Creates the check with tolerances (n,) [rad, m] and speed limits (n,) [rad/s, m/s] of the joints."""
        self._tolerance, self._fastest, self._jitter = tolerance, 1.5 * speed_limit, settings.jitter

    def begin(self, sample: Sample) -> None:
        """Returns None: this check has no state."""

    def check(self, sample: Sample, state: None) -> tuple[None, Mask]:
        """See `Check.check`."""
        reach = (sample.dt + self._jitter) * np.minimum(sample.speed, self._fastest)
        return None, np.abs(sample.step) > self._tolerance + reach


class VelocityConsistency:
    """Check that velocities agree with the change of position.

    The difference e of the change of position and the integrated velocity decays with the time constant T,

        e' = (1 - dt/T) e + dq - v dt,    |e| <= tolerance + r T + delay s.

    s is the largest recent speed, which decays in the same way: a velocity estimate with a delay deviates while the
    joint accelerates. r is the error of a velocity that is estimated from the time between two encoder counts.
    """

    text, about_position = "position and velocity disagree", True

    def __init__(self, settings: PlausibilitySettings, tolerance: Vector, counts: Vector) -> None:
        """Creates the check with tolerances and encoder counts of the joints, both (n,) [rad, m]."""
        self._delay, self._memory = settings.velocity_delay, settings.velocity_memory
        self._tolerance = tolerance + self._memory * settings.velocity_counts * counts

    def begin(self, sample: Sample) -> tuple[Vector, Vector]:
        """Returns the difference e and the speed s, both (n,)."""
        return np.zeros_like(sample.q), sample.speed

    def check(self, sample: Sample, state: tuple[Vector, Vector]) -> tuple[tuple[Vector, Vector], Mask]:
        """See `Check.check`."""
        keep = max(1.0 - sample.dt / self._memory, 0.0)
        error = keep * state[0] + sample.step - sample.dt * sample.v
        speed = np.maximum(keep * state[1], sample.speed)
        return (error, speed), np.abs(error) > self._tolerance + self._delay * speed


class FrozenPosition:
    """Check of positions that stay constant while the effort on the joint changes.

    Between the motor encoders and the links there are elastic cables and structure. A change of the effort by a
    considerable part of its limit therefore turns the encoder by at least one count. This also holds for a joint that
    presses against a stop or is held by a hand.
    """

    text, about_position = "the position does not change although the effort does", True

    def __init__(self, settings: PlausibilitySettings, effort_limits: Vector, counts: Vector) -> None:
        """Creates the check with effort limits [N m, N] and encoder counts [rad, m] of the joints, both (n,)."""
        self._allowed = settings.frozen_effort * effort_limits
        self._least_time = settings.frozen_time + counts / settings.frozen_speed

    def begin(self, sample: Sample) -> tuple[Vector, Vector, float]:
        """Returns effort at the last position change, time of excessive difference (n,), and time since the start."""
        return sample.net_effort, np.zeros_like(sample.q), 0.0

    def check(self, sample: Sample, state: tuple[Vector, Vector, float]) -> tuple[tuple[Vector, Vector, float], Mask]:
        """See `Check.check`."""
        effort, time, age = state
        moved = (sample.step != 0) | (age < _POWER_ON)
        effort = np.where(moved, sample.net_effort, effort)
        time = (np.abs(sample.net_effort - effort) > self._allowed) * (time + sample.dt)
        return (effort, time, age + sample.dt), time > self._least_time


class Response:
    """Check that accelerations agree with the efforts.

    The unexplained effort r = filter(tau - G(q)) - M(q) filter(vd) contains friction, external forces, model errors,
    and errors of sensors or motors. With a first-order filter of time constant T, filter(vd) = (v - filter(v)) / T
    needs no differentiation. A lasting part is attributed to the model and subtracted. Coriolis terms are omitted. They
    are small at the speeds that the guard allows.
    """

    text, about_position = "the motion does not follow from the effort", True

    def __init__(self, settings: PlausibilitySettings, arm: Arm, model: ArmModel) -> None:
        """Creates the check for the joints of `arm` with its model."""
        hand_effort = arm.per_joint(settings.hand_effort, 10 * settings.hand_effort)
        self._allowed, self._time = settings.response * arm.effort_limits + hand_effort, settings.response_time
        self._memory, self._model = settings.response_memory, model

    def begin(self, sample: Sample) -> tuple[Vector, Vector, Vector, NDArray[np.float64], float]:
        """Returns filtered effort, filtered velocity, lasting effort (n,), M / T (n, n), and the age of M / T [s]."""
        M = self._model.mass_matrix(sample.q) / self._time
        return sample.net_effort, sample.v, sample.net_effort, M, 0.0

    def check(self, sample: Sample, state: tuple) -> tuple[tuple, Mask]:
        """See `Check.check`."""
        effort, velocity, lasting, M, age = state
        age += sample.dt
        if age > _MASS_MATRIX_PERIOD:
            M, age = self._model.mass_matrix(sample.q) / self._time, 0.0
        gain = min(sample.dt / self._time, 1.0)
        effort = effort + gain * (sample.net_effort - effort)
        velocity = velocity + gain * (sample.v - velocity)
        unexplained = effort - M.dot(sample.v - velocity) - lasting
        lasting = lasting + min(sample.dt / self._memory, 1.0) * unexplained
        # Negated comparison, so that an effort that is NaN is unexplained, too.
        return (effort, velocity, lasting, M, age), ~(np.abs(unexplained) <= self._allowed)


class SilentEffort:
    """Check that measured efforts follow the commanded ones. Finds sensors that read zero and motors without power."""

    text, about_position = "the measured effort does not follow the commanded effort", False

    def __init__(self, settings: PlausibilitySettings, arm: Arm) -> None:
        """Creates the check for the joints of `arm`."""
        self._commanded, self._time = settings.silent_effort * arm.effort_limits, settings.silent_time
        self._least = 0.1 * self._commanded
        self._J, self._J_inverse = arm.transmission.matrix, arm.transmission.inverse.matrix
        self._largest = np.array([arm.effects.saturation.get(name, np.inf) for name in arm.joint_names])

    def begin(self, sample: Sample) -> Vector:
        """Returns the time (n,) for which the commanded effort has not appeared [s]."""
        return np.zeros_like(sample.q)

    def check(self, sample: Sample, state: Vector) -> tuple[Vector, Mask]:
        """See `Check.check`."""
        if sample.commanded is None:
            state = 0.0 * state
        else:
            hidden = self._hidden(sample.commanded, sample.effort)
            if is_any(hidden):
                # Coupled actuators may be unable to apply the effort although each joint is inside its limit.
                actuators = np.clip(sample.commanded @ self._J_inverse, -self._largest, self._largest)
                hidden &= self._hidden(actuators @ self._J, sample.effort)
            state = hidden * (state + sample.dt)
        return state, state > self._time

    def _hidden(self, commanded: Vector, effort: Vector) -> Mask:
        size = np.abs(commanded)
        return (size > self._commanded) & (commanded * effort < self._least * size)


class Plausibility:
    """All plausibility checks of an arm's measurements, applied sample by sample.

    Attributes:
        gravity: The model's gravity effort (n,) at the last sample [N m, N].
        invalid: Mask (n,) of joints without a valid position since the last `restart`.
        fault: Description of the error of the last sample. Empty: no error.
        last_valid: Positions (n,) of the `invalid` joints before their fault [rad, m]; undefined for the others.
    """

    def __init__(self, arm: Arm, model: ArmModel, settings: PlausibilitySettings, speed_limit: Vector) -> None:
        """Creates the checks for `arm`.

        Args:
            arm: Arm with n joints.
            model: Model of that arm as mounted.
            settings: Tolerances.
            speed_limit: Speed limits (n,) that the guard enforces [rad/s, m/s].
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

    def restart(self) -> None:
        """Marks all positions as valid and restarts the checks with the next sample."""
        self.invalid, self.fault = self._none, ""
        self.forget()

    @property
    def begins(self) -> bool:
        """Returns whether the next sample is compared with no previous sample."""
        return self._before is None

    def forget(self) -> None:
        """Excludes the previous samples from the comparison with the next one."""
        self._before: tuple[Vector, Vector] | None = None

    def check(self, dt: float, q: Vector, v: Vector, effort: Vector, commanded: Vector | None) -> str:
        """Checks one measurement. All arrays are (n,), finite and not changed in place.

        Args:
            dt: Time since the previous measurement [s].
            q, v, effort: Measured positions, velocities and efforts.
            commanded: Effort that the guard commanded before, or None.

        Returns:
            `fault`.
        """
        self.gravity, self.fault = self.model.gravity_effort(q), ""
        speed = np.abs(v)
        if self._before is None:
            sample = Sample(dt, q, v, 0.0 * q, speed, effort, effort - self.gravity, commanded)
            self._states = [check.begin(sample) for check in self._checks]
            self._poses, self._pose_age = (q, q), 0.0
        else:
            q_before, speed_before = self._before
            fastest = np.maximum(speed, speed_before)
            sample = Sample(dt, q, v, q - q_before, fastest, effort, effort - self.gravity, commanded)
            results = [check.check(sample, state) for check, state in zip(self._checks, self._states, strict=True)]
            self._states = [state for state, _ in results]
            if any(is_any(joints) for _, joints in results):
                for check, (_, joints) in zip(self._checks, results, strict=True):
                    self._find(check, joints)
            self._pose_age += dt
            if self._pose_age > self._detection_time:
                self._poses, self._pose_age = (self._poses[1], q), 0.0
        self._before = q, speed
        return self.fault

    def reject_all(self) -> None:
        """Marks the positions of all joints as invalid, for lost measurements."""
        self._reject(~self._none)

    def _find(self, check: Check, joints: Mask) -> None:
        if not is_any(joints):
            return
        if not self.fault:
            self.fault = f"{', '.join(self._names[j] for j in np.flatnonzero(joints))}: {check.text}"
        if check.about_position:
            self._reject(joints)

    def _reject(self, joints: Mask) -> None:
        # An error began before its detection. The last valid pose is the one at that earlier time.
        self.last_valid = np.where(joints & ~self.invalid, self._poses[0], self.last_valid)
        self.invalid = self.invalid | joints
