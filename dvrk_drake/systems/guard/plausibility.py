"""Plausibility of measurements that are finite and recent but may be stuck, jumping or inconsistent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import numpy as np

from dvrk_drake.systems.guard.check_effort import EffortTracking, Response
from dvrk_drake.systems.guard.check_position import FrozenPosition, PositionJump, VelocityConsistency
from dvrk_drake.systems.guard.limits import ArmModel, Mask, Vector, is_any
from dvrk_drake.systems.guard.part import Check, Part, Sample
from dvrk_drake.systems.guard.settings import PlausibilitySettings

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm

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
