"""Plausibility checks of efforts: motions that do not follow from them, and efforts that do not follow the command."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dvrk_drake.systems.guard.limits import ArmModel, Mask, Vector, clip, is_any
from dvrk_drake.systems.guard.part import Check, Sample
from dvrk_drake.systems.guard.settings import PlausibilitySettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

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
        size = np.abs(commanded)
        if is_any(size > self._unsaturated):
            # Coupled actuators may saturate although each joint effort is inside its limit.
            commanded = clip(commanded @ self._J_inverse, -self._largest, self._largest) @ self._J
        gain = min(sample.dt / self._filter_time, 1.0)
        self._difference = self._difference + gain * (commanded - sample.effort - self._difference)
        wrong = np.abs(self._difference) > self._tolerance + self._scale * size
        if 0.0 not in sample.effort.tolist():
            self._time = self._zero
            return wrong
        self._time = ((sample.effort == 0) & (size > self._least)) * (self._time + sample.dt)
        return wrong | (self._time > self._zero_time)
