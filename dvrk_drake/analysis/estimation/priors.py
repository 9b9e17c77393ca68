"""Prior standard deviations of the unknowns: rigid-body parameters, effects and the direction of gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.inertial_parameters import rotor_links
from dvrk_drake.dynamics.physical_consistency import LinkScale
from dvrk_drake.models.arm import Arm

#: Prior standard deviation of an inertial parameter about its value in the SDF, as a share of the scale of the
#: parameter (`LinkScale`). Half or twice the value increases the mean cross-validated errors of the public motions
#: `mtm_one` and `psm_one`.
LINK_DEVIATION = 0.3
#: Smallest prior standard deviation of a rotor inertia, as a share of the smallest rotor that the model states for the
#: same type of joints. It is for rotors without a stated inertia beside others: the model contains them as links. For
#: an MTM, the deviation is 3e-6 kg m^2.
UNSTATED_ROTOR_SHARE = 0.22
#: Acceleration of a rotor by the effort limit of its joint [rad/s^2, m/s^2] at one prior standard deviation of its
#: inertia, if the model states no rotors. The drives of published robots (UR, Franka, Staubli) reach 10 to 100 rad/s^2.
ROTOR_ACCELERATION = 100.0, 30.0
#: Factor of the prior standard deviation of the first moments, for rotors that the SDF models as links. The factor is
#: small because rotors are balanced. Zero would have no reciprocal.
_BALANCE = 1e-6
#: Prior standard deviation of the direction of gravity [rad]. It is the accuracy with which a base is levelled.
TILT_DEVIATION = 0.05
#: Prior standard deviation of a known coefficient of an effect, as a share of the coefficient. The friction power of
#: one PSM on two days is 0.96 to 1.54 times that of its arm file (`FRICTION_FACTOR`).
EFFECT_DEVIATION = 0.5
#: Prior standard deviation of the torque of a spring or cable that the arm file lists, as a share of the RMS effort,
#: because it may balance gravity. For other effects, see `EffectKind.prior_share`.
KNOWN_SHARE = 1.0


def rigid_deviations(regressor: DynamicRegressor, num_rigid: int, link_scale: float = 1.0) -> NDArray[np.float64]:
    """Returns the prior standard deviations (num_rigid,) of the link parameters and rotor inertias.

    Args:
        regressor: Regressor of the arm.
        num_rigid: Number of link parameters and rotor inertias.
        link_scale: Factor of the deviations of the links.
    """
    rotors_as_links = rotor_links(regressor.arm)
    links = [link_scale * LINK_DEVIATION * LinkScale.of(link).deviations for link in regressor.links]
    for link, deviation in zip(regressor.links, links, strict=True):
        if link.link in rotors_as_links:
            deviation[1:4] *= _BALANCE
    stated, rotors = regressor.values[10 * len(links) : num_rigid], _unstated_rotor_deviations(regressor.arm)
    for joints in (regressor.arm.prismatic, ~regressor.arm.prismatic):
        if np.any(of_type := joints & (stated > 0)):
            rotors[joints] = np.maximum(LINK_DEVIATION * stated[joints], UNSTATED_ROTOR_SHARE * np.min(stated[of_type]))
    return np.concatenate([*links, rotors])


def _unstated_rotor_deviations(arm: Arm) -> NDArray[np.float64]:
    """Returns the prior standard deviations (n,) of rotor inertias about 0, for a model that states no rotors.

    Most model files omit the rotors, although those of geared joints often exceed the inertia of the links.
    """
    acceleration = arm.per_joint(*ROTOR_ACCELERATION)
    # The joint that first reaches its limit bounds the effort of the actuator.
    J = np.abs(arm.transmission.matrix)
    shares = arm.effort_limits / np.where(J > 0, J, np.nan)
    joint = np.nanargmin(shares, axis=1)
    return np.array([arm.effort_limits[j] / (J[i, j] ** 2 * acceleration[j]) for i, j in enumerate(joint)])
