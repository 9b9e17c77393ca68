"""Corrects the holding torque of a model that was identified from motions, with static poses of the same arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dvrk_drake.analysis.dynamic.estimates import DRY_KINDS
from dvrk_drake.analysis.static.static_identification import StaticIdentification
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.effects_schema import DriveEffect

#: Smallest mean residual of an actuator that is an offset: in standard errors, and as a share of the dry friction. If a
#: pose is approached from both sides by a short distance, about 12 % of the dry friction remains in the measurement.
MIN_OFFSET, MIN_FRICTION_SHARE = 2.0, 0.15


def with_offsets_at_rest(model: IdentifiedModel, poses: StaticIdentification) -> IdentifiedModel:
    """Returns a model with dynamics whose offsets at rest are those of static poses.

    In a motion, the offset of an actuator can be caused by an error of the gravity model or by direction-dependent
    friction. A motion therefore does not determine whether the offset also acts at rest
    (`DynamicModel.holding_effects`). The offset at rest is the mean difference between the holding efforts at the poses
    and those of the model. The holding torque changes only for actuators with a significant mean (`MIN_OFFSET`). The
    poses change no other parameter, because the friction that remains in single measurements is often larger than the
    errors of the model.

    Args:
        model: Model with dynamics.
        poses: Poses of the same arm with their usable measurements.
    """
    arm, recording = model.arm, poses.recording
    residual = recording.measured_effort() - model.holding_torque(recording.q)
    to_actuator = arm.transmission.inverse
    offsets = {e.coordinate: e.coefficient for e in model.holding_effects if e.kind == "offset"}
    rows, friction = arm.effect_coordinates, [e for e in model.dynamic_model.section.effects if e.kind in DRY_KINDS]
    dry = np.sum([np.abs(rows[e.coordinate] * e.coefficient) for e in friction], axis=0) * np.ones(arm.num_joints)
    effects = []
    for i, name in enumerate(arm.joint_names):
        usable = np.all(poses.usable[:, to_actuator.matrix[:, i] != 0], axis=1)
        of_pose = to_actuator.pull_back_effort(residual)[usable, i]
        if len(of_pose) < 2:
            continue
        mean, error = float(of_pose.mean()), float(of_pose.std(ddof=1) / np.sqrt(len(of_pose)))
        if abs(mean) > max(MIN_OFFSET * error, MIN_FRICTION_SHARE * dry[i]):
            coordinate = f"actuator.{name}"
            mean += offsets.get(coordinate, 0.0)
            effects.append(DriveEffect(coordinate, "offset", 0.0, mean, standard_error=error))
    provenance = replace(
        model.provenance,
        recording=f"{model.provenance.recording}, {recording.source}",
        sha256=f"{model.provenance.sha256} {recording.sha256}",
        poses=model.provenance.poses + len(recording),
    )
    return replace(model, effects=effects, provenance=provenance)
