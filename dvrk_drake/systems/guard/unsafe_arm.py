"""Compares an arm with the arm of this package that has the same name, to find dangerous mistakes in arm files."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import package_arms
from dvrk_drake.models.plant import link_poses

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
#: Largest displacement of the origin of a link [m] and largest rotation of a link [rad]. The kinematics of two arms
#: differ by millimetres and milliradians. An inverted joint axis rotates a link by twice the joint position.
_MAX_DISPLACEMENT, _MAX_ROTATION = 0.02, 0.1
#: Largest difference of the gravity efforts, as a share of the effort limits. Identified links of an MTM differ from
#: the estimates of this package by up to 1.3 (wrist pitch). The guard finds smaller errors when efforts start.
_MAX_GRAVITY_DIFFERENCE = 2.0
#: Largest ratio of the diagonal elements of the mass matrices, from which the gains of the safe state follow. For the
#: identified links and rotors of an MTM, the ratios are 0.25 to 3.1.
_MAX_INERTIA_RATIO = 10.0
#: Number of random poses at which links, gravity and inertia are compared. Some gravity efforts are large at few poses.
_NUM_POSES = 20


@cache
def unsafe_difference(arm: Arm) -> str:
    """Returns a message on the first dangerous difference from the arm of this package with the same name, or "".

    A guard with these limits, gains, couplings or links would not protect that arm. If several arms have this name (two
    generations), one without a dangerous difference suffices. An arm with another name is not compared.
    """
    known = package_arms(arm)
    if any(arm is each for each in known):
        return ""
    differences = [next(filter(None, _unsafe_differences(arm, each)), "") for each in known]
    return differences[0] if differences and all(differences) else ""


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
        row = dict(zip(common, arm.transmission.matrix[i, own].tolist(), strict=True))
        known_row = dict(zip(common, known.transmission.matrix[k, other].tolist(), strict=True))
        yield from _wrong_coefficients(row, known_row, f"the transmission of {name}", hint)
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
    coefficients = {limit.name: limit.coefficients for limit in arm.coupled_limits}
    for limit in known.coupled_limits:
        own_coefficients = coefficients.get(limit.name, {})
        yield from _wrong_coefficients(own_coefficients, limit.coefficients, f"the coupled limit {limit.name}", hint)
    yield from _different_mechanics(arm, known, hint)


def _wrong_coefficients(own: dict[str, float], known: dict[str, float], where: str, hint: str) -> Iterator[str]:
    """Yields messages on the coefficients of joints that differ dangerously, the largest difference first."""
    tolerance = _MAX_COUPLING_DIFFERENCE * max(map(abs, known.values()))
    pairs = {name: (own.get(name, 0.0), known.get(name, 0.0)) for name in sorted(own.keys() | known.keys())}
    for name, (value, reference) in sorted(pairs.items(), key=lambda item: -abs(item[1][0] - item[1][1])):
        if abs(value - reference) > tolerance:
            allowed = f"allowed: {reference:.4g} +- {tolerance:.2g}, as for {hint}"
            yield f"the coefficient of joint {name} in {where} is {value:.4g}; {allowed}"


def _different_mechanics(arm: Arm, known: Arm, hint: str) -> Iterator[str]:
    """Yields messages on links, gravity efforts and inertias that differ dangerously at random poses of `known`.

    Both arms are compared with the same gravity vector, because an arm may be mounted in any orientation.
    """
    if set(arm.joint_names) != set(known.joint_names):
        return
    order = [known.joint_names.index(name) for name in arm.joint_names]
    own_model, model = (
        ControlModel(IdentifiedModel.from_arm(a)) for a in (arm, known.with_gravity(arm.gravity.tolist()))
    )
    for known_pose in known.sample_poses(_NUM_POSES, np.random.default_rng(0)):
        q = np.ascontiguousarray(known_pose[order])
        own, reference = link_poses(arm, q), link_poses(known, known_pose)
        at = f"at the pose ({', '.join(f'{x:.3g}' for x in q)}); allowed: up to"
        for name in filter(reference.__contains__, own):
            X = reference[name].InvertAndCompose(own[name])
            if (distance := float(np.linalg.norm(X.translation()))) > _MAX_DISPLACEMENT:
                yield f"link {name} is displaced by {distance:.3g} m {at} {_MAX_DISPLACEMENT:g} m from {hint}"
            if (angle := X.rotation().ToAngleAxis().angle()) > _MAX_ROTATION:
                yield f"link {name} is rotated by {angle:.3g} rad {at} {_MAX_ROTATION:g} rad from {hint}"
        difference = own_model.gravity_effort(q) - model.gravity_effort(known_pose)[order]
        share = np.abs(difference) / known.effort_limits[order]
        if share.max() > _MAX_GRAVITY_DIFFERENCE:
            j = int(share.argmax())
            yield (
                f"the gravity effort of {arm.joint_names[j]} differs by {difference[j]:.3g} {at} "
                f"{_MAX_GRAVITY_DIFFERENCE * known.effort_limits[order][j]:.3g} from {hint}"
            )
        own_inertia, inertia = np.diag(own_model.mass_matrix(q)), np.diag(model.mass_matrix(known_pose))[order]
        ratios = own_inertia / inertia
        j = int(np.abs(np.log(np.maximum(ratios, 1e-300))).argmax())
        if not 1 / _MAX_INERTIA_RATIO <= ratios[j] <= _MAX_INERTIA_RATIO:
            yield (
                f"the inertia at {arm.joint_names[j]} is {own_inertia[j]:.3g}; allowed: "
                f"{1 / _MAX_INERTIA_RATIO:g}..{_MAX_INERTIA_RATIO:g} times {inertia[j]:.3g}, as for {hint}"
            )
