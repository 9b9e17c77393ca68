"""Checks the number of poses at rest, poses at a joint stop, and the signs of the efforts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.findings import Finding
from dvrk_drake.analysis.static.excluded_measurements import find_excluded, usable_measurements
from dvrk_drake.analysis.static.static_identification import MIN_POSES, average_repeated_poses
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.recording import Recording

#: Largest number of poses at which efforts are compared with the gravity of the SDF model.
MAX_COMPARED = 500
#: Smallest gravity effort of the model file [N m], [N] and its smallest share of the effort for a check of the sign.
#: Smaller gravity may be exceeded by cables. A sign is wrong if the effort opposes gravity by the given number of
#: standard errors, and if their correlation is below minus the last value.
MIN_GRAVITY, GRAVITY_SHARE, MIN_GAIN, OPPOSITE = (0.1, 1.0), 0.5, 5.0, 0.7


def check_poses(recording: Recording, arm: Arm) -> list[Finding]:
    """Checks poses in joint or actuator coordinates, with efforts."""
    findings = []
    joints = recording.in_joint_coordinates(arm)
    distinct = len(average_repeated_poses(joints, arm))
    if distinct < MIN_POSES:
        advice = f"identify needs {MIN_POSES}; 40 or more, spread over the limits, are good"
        what = f"{distinct} distinct poses in {len(joints)} rows"
        findings.append(Finding("warning", "few poses", "rows", what, advice, size=float(distinct)))
    excluded = find_excluded(joints, arm)
    if excluded:
        rows = len({measurement.row for measurement in excluded})
        what = (
            f"{rows} poses press on a stop or exceed an effort limit, first {excluded[0].where}: {excluded[0].reason}"
        )
        advice = "identify leaves the efforts of those joints out and lists them"
        findings.append(Finding("note", "excluded poses", "rows", what, advice, size=float(rows)))
    return findings + _wrong_sign(recording, joints, usable_measurements(joints.q.shape, excluded), arm)


def _wrong_sign(recording: Recording, joints: Recording, usable: NDArray[np.bool_], arm: Arm) -> list[Finding]:
    """Reports efforts of wrong sign.

    The check uses the coordinates of the recording, in which each sign belongs to one effort. Measurements at a joint
    stop are excluded by `usable` (m, n).
    """
    rows = np.linspace(0, len(joints) - 1, min(len(joints), MAX_COMPARED)).astype(int)
    gravity, tau = holding_torques(arm, joints.q[rows]), recording.measured_effort()[rows]
    if recording.coordinates == "actuator":
        gravity = arm.transmission.inverse.pull_back_effort(gravity)
    findings = []
    for j, least in enumerate(arm.per_joint(*MIN_GRAVITY)):
        use = usable[rows, j]
        if np.sum(use) >= MIN_POSES and np.sqrt(np.mean(gravity[use, j] ** 2)) >= least:
            correlation = _sure_correlation(gravity[use, j], tau[use, j])
            if correlation < -OPPOSITE:
                what = f"efforts are opposite to the gravity torque of the model file (correlation {correlation:.2f})"
                advice = f"tau{j + 1} must be positive towards +q{j + 1}, and --gravity must be that of the mounting"
                findings.append(Finding("refusal", "effort sign", arm.joint_names[j], what, advice, (j,), correlation))
    return findings


def _sure_correlation(gravity: NDArray[np.float64], tau: NDArray[np.float64]) -> float:
    """Returns the correlation of the efforts (m,) with gravity (m,).

    The result is 0 if gravity is a small part of the efforts or if an offset may explain the correlation.
    """
    sizes = float(np.linalg.norm(gravity)), float(np.linalg.norm(tau))
    if sizes[0] < GRAVITY_SHARE * sizes[1] or sizes[1] == 0:
        return 0.0
    slope = float(gravity @ tau) / sizes[0] ** 2
    error = float(np.linalg.norm(tau - slope * gravity)) / sizes[0] / np.sqrt(len(tau) - 1)
    beside_offset = float((gravity - np.mean(gravity)) @ (tau - np.mean(tau)))
    sure = abs(slope) > MIN_GAIN * error and slope * beside_offset > 0
    return float(gravity @ tau) / (sizes[0] * sizes[1]) if sure else 0.0
