"""Compares an arm with the arm of this package that has the same name, to find dangerous mistakes in arm files."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import is_package_arm, load_arm
from dvrk_drake.models.plant import link_positions

#: Accepted differences between an arm and the arm of this package with the same name, in `unsafe_difference`.
#: Largest ratio of effort limits: the motors are the same, but an amplifier may be configured for a larger current.
_MAX_EFFORT_RATIO = 1.5
#: Largest ratio of gains. The gains of this package are stable up to a delay of 8 ms, and a loop has a delay of 2 ms.
_MAX_GAIN_RATIO = 4.0
#: Largest difference in a row of the transmission, as a share of its largest coefficient: an inverted or missing
#: coefficient of the arms of this package differs by more, another instrument by less.
_MAX_COUPLING_DIFFERENCE = 0.25
#: Largest distance of a position limit beyond that of this package, as a share of the range of the joint. In a larger
#: distance, the guard would not detect a wrong unit or zero position (`GuardLimits.implausible_pose`).
_MAX_EXTENSION = 0.25
#: Largest displacement of the origin of a link [m]. The kinematics of two arms differ by millimetres.
_MAX_DISPLACEMENT = 0.02


@cache
def unsafe_difference(arm: Arm) -> str:
    """Returns a message on the first dangerous difference from the arm of this package with the same name, or "".

    A guard with these limits, gains or couplings would not protect that arm. An arm with another name is not compared.
    """
    if not is_package_arm(arm):
        return ""
    known = load_arm(arm.name.lower())
    return next(filter(None, _unsafe_differences(arm, known)), "") if arm is not known else ""


def _unsafe_differences(arm: Arm, known: Arm) -> Iterator[str]:
    hint = f"the arm {known.name} of dvrk_drake; correct the file, or give the arm another name"
    common = [name for name in known.joint_names if name in arm.joint_names]
    own, other = ([a.joint_names.index(name) for name in common] for a in (arm, known))
    for name, i, k in zip(common, own, other, strict=True):
        largest = _MAX_EFFORT_RATIO * known.effort_limits[k]
        if arm.effort_limits[i] > largest:
            yield f"the effort limit of {name} is {arm.effort_limits[i]:g}; allowed: up to {largest:g}, as for {hint}"
        for gain, least in (("kp", 1 / _MAX_GAIN_RATIO), ("kd", 1 / _MAX_GAIN_RATIO), ("ki", 0.0)):
            value, reference = getattr(arm.gains, gain)[i], getattr(known.gains, gain)[k]
            if not least * reference <= value <= _MAX_GAIN_RATIO * reference:
                allowed = f"{least * reference:.4g}..{_MAX_GAIN_RATIO * reference:.4g}"
                yield f"gain {gain} of {name} is {value:g}; allowed: {allowed}, as for {hint}"
        row = known.transmission.matrix[k, other]
        difference = arm.transmission.matrix[i, own] - row
        if np.abs(difference).max() > _MAX_COUPLING_DIFFERENCE * np.abs(row).max():
            worst = int(np.abs(difference).argmax())
            value = arm.transmission.matrix[i, own[worst]]
            yield (
                f"the coefficient of joint {common[worst]} in the transmission of {name} is {value:.4g}; allowed: "
                f"{row[worst]:.4g} +- {_MAX_COUPLING_DIFFERENCE * np.abs(row).max():.2g}, as for {hint}"
            )
    limits = {name: (arm.position_lower[i], arm.position_upper[i]) for name, i in zip(common, own, strict=True)}
    limits |= {limit.name: (limit.lower, limit.upper) for limit in arm.coupled_limits}
    references = {n: (known.position_lower[k], known.position_upper[k]) for n, k in zip(common, other, strict=True)}
    references |= {limit.name: (limit.lower, limit.upper) for limit in known.coupled_limits}
    for name, (lower, upper) in references.items():
        extension = _MAX_EXTENSION * (upper - lower)
        allowed = f"allowed: inside {lower - extension:.4g}..{upper + extension:.4g}, as for {hint}"
        if name not in limits:
            yield f"the coupled limit {name} is missing; {allowed}"
        elif limits[name][0] < lower - extension or limits[name][1] > upper + extension:
            yield f"the position limits of {name} are {limits[name][0]:.4g}..{limits[name][1]:.4g}; {allowed}"
    yield from _displaced_links(arm, known, hint)


def _displaced_links(arm: Arm, known: Arm, hint: str) -> Iterator[str]:
    """Yields messages on links with a dangerous displacement in the middle of the position limits of `known`."""
    middle = dict(zip(known.joint_names, 0.5 * (known.position_lower + known.position_upper), strict=True))
    own, reference = (link_positions(a, [middle.get(name, 0.0) for name in a.joint_names]) for a in (arm, known))
    for name in own.keys() & reference.keys():
        if (distance := float(np.linalg.norm(own[name] - reference[name]))) > _MAX_DISPLACEMENT:
            yield (
                f"link {name} is displaced by {distance:.3g} m at the pose in the middle of the position limits; "
                f"allowed: up to {_MAX_DISPLACEMENT:g} m from {hint}"
            )
