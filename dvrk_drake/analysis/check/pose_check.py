"""Checks static poses: their number, poses at a joint stop, and the signs of the efforts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.estimation.motion_effects import MIN_ERRORS
from dvrk_drake.analysis.observations.finding import Finding
from dvrk_drake.analysis.observations.static_poses import (
    MIN_POSES,
    average_repeated_poses,
    find_excluded,
    usable_measurements,
)
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.recording import MAX_MOTION_STEP, Recording

#: Largest number of poses at which efforts are compared with the gravity of the SDF model. It limits the time to 30 ms.
MAX_COMPARED = 500
#: Smallest RMS gravity effort of the SDF model for a check of the sign, as a share of the measured RMS effort. With a
#: smaller share, effects of the drive are the larger part of the effort.
GRAVITY_SHARE = 0.5
#: Gravity must also exceed the effects of the drive, because the torque of a cable can exceed a smaller gravity effort.
#: The share of the effort limit is for effects that the arm file does not state. In joints of an MTM and a PSM, a
#: gravity effort above the other shares of the largest effort limit (revolute, prismatic joints) exceeds all effects.
EFFECTS_SHARE, SUFFICIENT_SHARE = 0.02, (0.03, 0.1)
#: An effort has the wrong sign if its regression coefficient on gravity is more than `MIN_ERRORS` standard errors below
#: 0, and if the correlation of effort and gravity is below minus this number. Half or twice the value changes no
#: finding on the public recordings.
MIN_OPPOSITE_CORRELATION = 0.7


def check_poses(recording: Recording, arm: Arm) -> list[Finding]:
    """Checks poses in joint or actuator coordinates, with efforts."""
    findings = []
    joints = recording.in_joint_coordinates(arm)
    distinct = len(average_repeated_poses(joints, arm))
    if distinct < MIN_POSES:
        what = f"the recording has {distinct} distinct pose{'s' * (distinct != 1)}, but identify requires {MIN_POSES}"
        advice = "Record 40 or more poses that cover the range of the arm."
        findings.append(Finding("warning", "few poses", "rows", what, advice, size=float(distinct)))
    if recording.t is None and recording.qd is None and joints.is_path(arm):
        what = f"{len(joints)} rows without times follow in steps below {100 * MAX_MOTION_STEP:g} % of the joint ranges"
        advice = "The rows seem to be a motion. State its times, or its sampling rate with --rate HZ."
        findings.append(Finding("warning", "no times", "t", what, advice))
    excluded = find_excluded(joints, arm)
    if excluded:
        rows = len({measurement.row for measurement in excluded})
        what = (
            f"{rows} pose{'s' * (rows != 1)} at a joint stop or beyond an effort limit, first "
            f"{excluded[0].where}: {excluded[0].reason}"
        )
        advice = "identify excludes these efforts and lists them."
        findings.append(Finding("note", "excluded poses", "rows", what, advice, size=float(rows)))
    return findings + _wrong_sign(recording, joints, usable_measurements(joints.q.shape, excluded), arm)


def _wrong_sign(recording: Recording, joints: Recording, usable: NDArray[np.bool_], arm: Arm) -> list[Finding]:
    """Returns a refusal for each effort with the wrong sign.

    Efforts are compared in the coordinates of the recording, because a wrong sign affects only one channel in these
    coordinates. `usable` (m, n) is False for measurements at a joint stop or beyond an effort limit.
    """
    rows = np.linspace(0, len(joints) - 1, min(len(joints), MAX_COMPARED)).astype(int)
    gravity, tau = holding_torques(arm, joints.q[rows]), recording.measured_effort()[rows]
    if recording.coordinates == "actuator":
        gravity = arm.transmission.inverse.pull_back_effort(gravity)
    findings = []
    for j, least in enumerate(_least_gravity(arm)):
        use = usable[rows, j]
        if np.sum(use) >= MIN_POSES and np.sqrt(np.mean(gravity[use, j] ** 2)) >= least:
            correlation = _significant_correlation(gravity[use, j], tau[use, j])
            if correlation < -MIN_OPPOSITE_CORRELATION:
                what = f"tau{j + 1} is opposite to the gravity effort of the arm model (correlation {correlation:.2f})"
                advice = (
                    f"Efforts must be positive in the direction of +q{j + 1}. Check the sign, and check that --gravity "
                    "matches the mounting."
                )
                findings.append(Finding("refusal", "effort sign", arm.joint_names[j], what, advice, (j,), correlation))
    return findings


def _least_gravity(arm: Arm) -> NDArray[np.float64]:
    """Returns the RMS gravity efforts (n,) from which the sign of an effort is checked [N m, N]."""
    effects = arm.dry_friction() + EFFECTS_SHARE * arm.effort_limits
    for effect in arm.effects.position_dependent:
        # The coefficient of a spring is its stiffness, and its scale is the largest deflection.
        largest = effect.coefficient * (effect.scale if effect.kind == "spring" else 1.0)
        effects += np.abs(largest * (arm.effect_coordinates[effect.coordinate] @ arm.transmission.matrix))
    strongest = [np.max(arm.effort_limits, initial=0.0, where=arm.prismatic == slides) for slides in (False, True)]
    return np.minimum(effects, arm.per_joint(*strongest) * arm.per_joint(*SUFFICIENT_SHARE))


def _significant_correlation(gravity: NDArray[np.float64], tau: NDArray[np.float64]) -> float:
    """Returns the correlation of efforts (m,) with gravity efforts (m,), or 0 if it is not significant.

    The correlation is not significant if gravity is a small share of the efforts, or if an offset can explain it.
    """
    sizes = float(np.linalg.norm(gravity)), float(np.linalg.norm(tau))
    if sizes[0] < GRAVITY_SHARE * sizes[1] or sizes[1] == 0:
        return 0.0
    slope = float(gravity @ tau) / sizes[0] ** 2
    error = float(np.linalg.norm(tau - slope * gravity)) / sizes[0] / np.sqrt(len(tau) - 1)
    covariance = float((gravity - np.mean(gravity)) @ (tau - np.mean(tau)))
    significant = abs(slope) > MIN_ERRORS * error and slope * covariance > 0
    return float(gravity @ tau) / (sizes[0] * sizes[1]) if significant else 0.0
