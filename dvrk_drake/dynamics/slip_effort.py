"""Slip effort of each joint in mode "guide": the effort up to which the virtual friction holds the joint."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.effects_schema import half_width

#: Largest slip effort as a share of the effort limit. The hand of an operator overcomes it easily, and enough effort
#: remains for gravity and for the soft walls of the guard.
MAX_SLIP_SHARE = 0.4


def slip_effort(model: IdentifiedModel) -> NDArray[np.float64]:
    """Returns the default slip effort (n,) [N m, N] of each joint.

    It is the 95 % quantile of the cross-validated error, plus the dry friction of the joint. A hand that leads a joint
    loads its friction, and after the release the friction relaxes and pulls the joint back. The error is that of the
    holding torque, if the model was identified from static poses. A model of motions only states the error of efforts
    in motion. Offsets that may act only in motion are added to it, because the holding torque omits them (see
    `DynamicModel.holding_effects`). The slip effort is at most `MAX_SLIP_SHARE` times the effort limit. If
    `is_cross_validated` is false, it is the dry friction alone.
    """
    arm = model.arm
    return np.minimum(_error(model) + arm.dry_friction(), MAX_SLIP_SHARE * arm.effort_limits)


def is_cross_validated(model: IdentifiedModel) -> bool:
    """Returns whether the cross-validated error is known for all joints, from static poses or from motions."""
    return bool(np.all(_error(model) > 0))


def _error(model: IdentifiedModel) -> NDArray[np.float64]:
    at_rest = np.array([half_width(joint.rms_cross_validation_included, None) for joint in model.joints])
    if model.dynamics is None or np.all(at_rest > 0):
        return at_rest
    J, motion, rows = model.arm.transmission.matrix, model.dynamic_model, model.arm.effect_coordinates
    in_motion = motion.combined_half_width(J.T)
    omitted = np.zeros(model.arm.num_joints)
    for i, (effect, coefficient) in enumerate(zip(motion.effects, motion.coefficients, strict=True)):
        if effect.kind == "offset" and i not in motion.holding_effects:
            omitted += np.abs(coefficient * rows[effect.coordinate] @ J)
    return np.where(in_motion > 0, in_motion + omitted, 0.0)
