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

    It is the 95 % quantile of the cross-validated error of the holding torque, plus the dry friction of the joint. A
    hand that leads a joint loads its friction, and after the release the friction relaxes and pulls the joint back. The
    slip effort is at most `MAX_SLIP_SHARE` times the effort limit. If `is_cross_validated` is false, it is the dry
    friction alone.
    """
    arm = model.arm
    error = np.array([half_width(joint.rms_cross_validation_included, None) for joint in model.joints])
    return np.minimum(error + arm.dry_friction(), MAX_SLIP_SHARE * arm.effort_limits)


def is_cross_validated(model: IdentifiedModel) -> bool:
    """Returns whether the error of the holding torque is known for all joints, from static poses."""
    return all(joint.rms_cross_validation_included > 0 for joint in model.joints)
