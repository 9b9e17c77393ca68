"""Checks poses at rest: how many, which press on a stop, and whether their efforts carry the arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.findings import Finding
from dvrk_drake.analysis.static.excluded_measurements import find_excluded, usable_measurements
from dvrk_drake.analysis.static.static_identification import MIN_POSES, average_repeated_poses
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import holding_torques
from dvrk_drake.recordings.recording import Recording

#: Poses at which the SDF's gravity is compared.
MAX_COMPARED = 500
#: A sign is told by gravity alone where the model file's is so large [N m], [N] (cables hold less), and this share of
#: the effort; it is wrong where the effort goes against it by so many standard errors, correlating by less than minus
#: this.
MIN_GRAVITY, GRAVITY_SHARE, MIN_GAIN, OPPOSITE = (0.1, 1.0), 0.5, 5.0, 0.7


def check_poses(recording: Recording, arm: Arm) -> list[Finding]:
    """What must be said of poses in either coordinates, with efforts."""
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
    """In the recording's own coordinates, where a sign is one effort's; `usable` (m, n): no stop carries it."""
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
    """Of the efforts (m,) with gravity's (m,); 0 where gravity is a small part of them, or an offset may explain it."""
    sizes = float(np.linalg.norm(gravity)), float(np.linalg.norm(tau))
    if sizes[0] < GRAVITY_SHARE * sizes[1] or sizes[1] == 0:
        return 0.0
    slope = float(gravity @ tau) / sizes[0] ** 2
    error = float(np.linalg.norm(tau - slope * gravity)) / sizes[0] / np.sqrt(len(tau) - 1)
    beside_offset = float((gravity - np.mean(gravity)) @ (tau - np.mean(tau)))
    sure = abs(slope) > MIN_GAIN * error and slope * beside_offset > 0
    return float(gravity @ tau) / (sizes[0] * sizes[1]) if sure else 0.0
