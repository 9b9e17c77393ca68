"""Checks poses at rest: how many, which press on a stop, and whether their efforts carry the arm."""

from __future__ import annotations

import numpy as np

from dvrk_drake.analysis.check.report import Finding
from dvrk_drake.analysis.static.doubts import find_doubts
from dvrk_drake.analysis.static.static_identification import LEAST_POSES, average_repeated_poses
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions
from dvrk_drake.models.recording import Recording

#: Poses at which the SDF's gravity is compared.
MOST_COMPARED = 500
#: A sign is doubted if the joint covers a quarter of its limits, gravity is above this share of the effort, and their
#: correlation below minus the other [1].
GRAVITY_SHARE, OPPOSITE = 0.5, 0.7


def check_poses(joints: Recording, arm: Arm) -> list[Finding]:
    """What must be said of poses in joint coordinates, with efforts."""
    findings = []
    distinct = len(average_repeated_poses(joints, arm))
    if distinct < LEAST_POSES:
        advice = f"identify needs {LEAST_POSES}; 40 or more, spread over the limits, are good"
        what = f"{distinct} distinct poses in {len(joints)} rows"
        findings.append(Finding("warning", "few poses", "rows", what, advice, size=float(distinct)))
    doubts = find_doubts(joints, arm)
    if doubts:
        rows = len({doubt.row for doubt in doubts})
        what = f"{rows} poses press on a stop or exceed an effort limit, first {doubts[0].where}: {doubts[0].reason}"
        advice = "identify leaves the efforts of those joints out and lists them"
        findings.append(Finding("note", "doubted poses", "rows", what, advice, size=float(rows)))
    return findings + _wrong_sign(joints, arm)


def _wrong_sign(joints: Recording, arm: Arm) -> list[Finding]:
    rows = np.linspace(0, len(joints) - 1, min(len(joints), MOST_COMPARED)).astype(int)
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    gravity = np.empty((len(rows), arm.num_joints))
    for i, row in enumerate(rows):
        set_arm_positions(plant, context, arm, joints.q[row])
        gravity[i] = holding_torque(plant, context, arm)
    tau = joints.measured_effort()[rows]
    sizes = np.sqrt(np.sum(gravity**2, axis=0)), np.sqrt(np.sum(tau**2, axis=0))
    cosine = np.sum(gravity * tau, axis=0) / np.maximum(sizes[0] * sizes[1], np.finfo(float).tiny)
    covers = np.ptp(joints.q, axis=0) > 0.25 * (arm.position_upper - arm.position_lower)
    findings = []
    for j in np.flatnonzero(covers & (sizes[0] > GRAVITY_SHARE * sizes[1]) & (cosine < -OPPOSITE)):
        what = f"efforts are opposite to the gravity torque of the model file (correlation {cosine[j]:.2f})"
        advice = "efforts must be positive towards +q, and --gravity must be that of the mounting"
        findings.append(
            Finding("refusal", "effort sign", arm.joint_names[j], what, advice, (int(j),), float(cosine[j]))
        )
    return findings
