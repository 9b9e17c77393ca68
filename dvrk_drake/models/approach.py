"""Offsets of the poses at which the approach to a static pose begins, see `coupled_limits.offset_pose`.

The same offset is subtracted for the approach from below and added for the approach from above. The offsets of all
joints have the same sign, because this reverses the dry friction of actuators that are coupled to several joints most
completely.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm

#: Proportional effort of the controller at the start of an approach, divided by the effort limit. This effort
#: determines the distance of the approach. Static friction that is at most half of this effort changes its sign during
#: the approach.
_EFFORT = 0.3
#: Length of an approach that the dVRK's controller executes, as a fraction of the range of the joint. Dry friction is
#: elastic at first, so a short approach does not reverse it completely. Random poses have at least a tenth of the range
#: on both sides.
_RANGE = 0.08


def effort_approach(arm: Arm) -> NDArray[np.float64]:
    """Returns the offsets (n,) for a collection over LCM [rad, m]."""
    return np.asarray(_EFFORT * arm.effort_limits / np.asarray(arm.gains.kp))


def range_approach(arm: Arm) -> NDArray[np.float64]:
    """Returns the offsets (n,) for a collection by the dVRK's controller [rad, m]."""
    return _RANGE * (arm.position_upper - arm.position_lower)
