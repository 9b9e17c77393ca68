"""Prior standard deviations of the unknowns: rigid-body parameters, effects and the direction of gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import rotor_links
from dvrk_drake.dynamics.physical_consistency import LinkScale

#: Prior standard deviation of an inertial parameter about its value in the SDF, as a share of the scale of the
#: parameter (`LinkScale`). The share was selected by cross-validation.
LINK_DEVIATION = 0.3
#: Smallest prior standard deviation of a rotor inertia [kg m^2; kg].
MIN_ROTOR_DEVIATION = 3e-6
#: Factor of the prior standard deviation of the first moments, for rotors that the SDF models as links. The factor is
#: small because rotors are balanced.
_BALANCE = 1e-6
#: Prior standard deviation of the direction of gravity [rad]. It is the accuracy with which a base is levelled.
TILT_DEVIATION = 0.05
#: Prior standard deviation of the torque of a spring or cable that the arm file lists, as a share of the RMS effort,
#: because it may balance gravity. For other effects, see `EffectKind.prior_share`.
KNOWN_SHARE = 1.0


def rigid_deviations(regressor: DynamicRegressor, num_rigid: int) -> NDArray[np.float64]:
    """Returns the prior standard deviations (num_rigid,) of the link parameters and rotor inertias."""
    rotors_as_links = rotor_links(regressor.arm)
    links = [LINK_DEVIATION * LinkScale.of(link).deviations for link in regressor.links]
    for link, deviation in zip(regressor.links, links, strict=True):
        if link.link in rotors_as_links:
            deviation[1:4] *= _BALANCE
    rotors = np.maximum(LINK_DEVIATION * regressor.values[10 * len(links) : num_rigid], MIN_ROTOR_DEVIATION)
    return np.concatenate([*links, rotors])
