"""Makes arms with locked joints, for recordings of only some of the joints."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ArmError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import CoupledLimit, Gains, LinearMap
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.immutable import cached
from dvrk_drake.models.ranges import suggest_name

#: Largest distance of a locked joint from its stated position in a recording [rad, m].
MAX_LOCKED_ERROR = 0.02


def lock_joints(arm: Arm, positions: Mapping[str, float]) -> Arm:
    """Returns the arm with locked joints, as with `pydrake.multibody.tree.Joint.Lock`.

    The returned arm has only the other joints. Its dynamics are valid while the locked joints are at rest at the given
    positions. Use it for recordings of only some of the joints.

    Args:
        arm: Arm with the joints.
        positions: Mapping from the name of each locked joint to its position [rad, m].

    Raises:
        ArmError: A joint is unknown or already locked, a position violates a limit, all joints are locked, or a motor
            or a position-dependent effect acts on a locked joint and on another joint.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.lock_joints(dvrk.load_arm("psm"), {"roll": 0, "wrist_pitch": 0, "wrist_yaw": 0, "jaw": 0})
        >>> arm.num_joints, arm.joint_names
        (3, ('yaw', 'pitch', 'insertion'))
    """
    positions = {name: float(position) for name, position in positions.items()}
    accepted = f"allowed: {', '.join(arm.joint_names)}"
    for name, position in positions.items():
        if name in arm.locked_joints:
            raise ArmError(f"{arm.name}: joint {name} is already locked at {arm.locked_joints[name]:g}")
        if name not in arm.joint_names:
            raise ArmError(f'{arm.name} has no joint "{name}" to lock; {suggest_name(name, arm.joint_names)}{accepted}')
        j = arm.joint_names.index(name)
        lower, upper, unit = arm.position_lower[j], arm.position_upper[j], "m" if arm.prismatic[j] else "rad"
        if not lower <= position <= upper:
            raise ArmError(
                f"{arm.name}: locked joint {name} = {position:g} is outside its limits; "
                f"allowed: {lower:.4g}..{upper:.4g} {unit}"
            )
    if len(positions) == arm.num_joints:
        raise ArmError(f"{arm.name}: all joints are locked; allowed: at least one joint that is not locked")
    return _locked(arm, tuple((name, positions[name]) for name in arm.joint_names if name in positions))


def lock_hint(arm: Arm, num_recorded: int) -> str:
    """Returns advice for a recording that contains only the first `num_recorded` joints of an arm.

    The advice names the joints that are not recorded, and the option that states their positions. It is "" if all
    joints are recorded, or none.
    """
    if not 0 < num_recorded < arm.num_joints:
        return ""
    J = arm.transmission.matrix
    # One motor may move several joints, which must be locked together.
    while num_recorded and (np.any(J[num_recorded:, :num_recorded]) or np.any(J[:num_recorded, num_recorded:])):
        num_recorded -= 1
    if not num_recorded:
        return ""
    home = np.clip(np.zeros(arm.num_joints), arm.position_lower, arm.position_upper)
    names = arm.joint_names[num_recorded:]
    stated = " ".join(f"{name}={x:g}" for name, x in zip(names, home[num_recorded:], strict=True))
    return (
        f"If {', '.join(names)} {'were' if len(names) > 1 else 'was'} held, state the positions [rad, m], e.g. "
        f"--locked {stated}"
    )


def locked_option(arm: Arm) -> str:
    """Returns the option --locked for the arm, with a leading space, or "" if no joint is locked."""
    stated = " ".join(f"{name}={x:g}" for name, x in arm.locked_joints.items())
    return f" --locked {stated}" if stated else ""


def check_held(where: str, names: Sequence[str], q: NDArray[np.float64], arm: Arm) -> None:
    """Checks that the recorded locked joints were held at their stated positions.

    Args:
        where: Source of the positions, for the message.
        names: Names of the recorded joints.
        q: Positions (m, k) of the recorded joints [rad, m].
        arm: Arm with locked joints.

    Raises:
        RecordingError: A locked joint was more than `MAX_LOCKED_ERROR` from its stated position.
    """
    for joint, position in arm.locked_joints.items():
        if joint in names:
            measured = q[:, names.index(joint)]
            if np.any(np.abs(measured - position) > MAX_LOCKED_ERROR):
                raise RecordingError(
                    f"{where}: --locked states {joint}={position:g}, but the recorded positions are "
                    f"{measured.min():.4g}..{measured.max():.4g}; allowed deviation: {MAX_LOCKED_ERROR:g} rad or m"
                )


@cached
def _locked(arm: Arm, positions: tuple[tuple[str, float], ...]) -> Arm:
    """Returns the arm with locked joints. Calls with equal arguments return the same Arm object."""
    if not positions:
        return arm
    stated = dict(positions)
    is_free = np.array([name not in stated for name in arm.joint_names])
    free, locked = np.flatnonzero(is_free), np.flatnonzero(~is_free)
    names = [arm.joint_names[j] for j in free]
    q_locked = np.array([stated[arm.joint_names[j]] for j in locked])
    J, G = arm.transmission.matrix, arm.linkage.matrix
    _refuse_coupled_motors(arm, J, is_free)
    coordinates = {name: row[free] for name, row in arm.friction_coordinates.items() if np.any(row[free])}
    reduced = {name for name in coordinates if np.any(arm.friction_coordinates[name][locked])}
    kept = {f"{kind}.{name}" for kind in ("joint", "actuator") for name in names} | coordinates.keys()
    settings = arm.identification
    _refuse_position_effects(arm, reduced)
    return dataclasses.replace(
        arm,
        joint_names=tuple(names),
        position_lower=arm.position_lower[free],
        position_upper=arm.position_upper[free],
        effort_limits=arm.effort_limits[free],
        prismatic=arm.prismatic[free],
        coupled_limits=tuple(_coupled_limits(arm, names, stated)),
        linkage=LinearMap(G[:, free], arm.linkage.offset + G[:, locked] @ q_locked),
        transmission=LinearMap(J[np.ix_(free, free)], arm.transmission.offset[free]),
        published_gains=Gains(),  # they are those of all joints
        gains=Gains(*([getattr(arm.gains, key)[j] for j in free] for key in ("kp", "kd", "ki"))),
        friction_coordinates=coordinates,
        identification=dataclasses.replace(
            settings,
            acceleration_cut_off=[settings.acceleration_cut_off[j] for j in free],
            effort_delay=[settings.effort_delay[j] for j in free],
            day_deviation=[settings.day_deviation[j] for j in free],
            known_effects={name: kinds for name, kinds in settings.known_effects.items() if name in kept},
        ),
        effects=_effects(arm.effects, kept, names),
        locked_joints=arm.locked_joints | stated,
    )


def _refuse_coupled_motors(arm: Arm, J: NDArray[np.float64], is_free: NDArray[np.bool_]) -> None:
    """Raises ArmError if a motor acts on a locked joint and on a joint that is not locked.

    The joint that is not locked would then need the effort of a motor that was not recorded.
    """
    coupled = np.argwhere((J != 0) & (is_free[:, None] != is_free[None, :]))
    if len(coupled):
        group = {int(coupled[0][0])}
        while len(grown := {int(j) for i in group for j in np.flatnonzero(J[i] + J[:, i])} | group) > len(group):
            group = grown
        names = ", ".join(arm.joint_names[j] for j in sorted(group))
        raise ArmError(f"{arm.name}: {names} are coupled by the transmission; lock all of these joints or none")


def _refuse_position_effects(arm: Arm, reduced: Iterable[str]) -> None:
    """Raises ArmError if an effect depends on a sum of the positions of a locked joint and of another joint.

    Friction depends only on the velocity and the travel along a coordinate, so it is not affected by locked joints.
    """
    laws = {effect.coordinate for effect in (*arm.effects.cables, *arm.effects.springs)}
    if found := sorted((laws | arm.identification.known_effects.keys()).intersection(reduced)):
        raise ArmError(
            f"{arm.name}: {found[0]} has position-dependent effects and depends on locked and on other joints; lock "
            "all of these joints or none of them"
        )


def _coupled_limits(arm: Arm, free: list[str], stated: Mapping[str, float]) -> Iterable[CoupledLimit]:
    """Yields the coupled limits of the joints that are not locked. Their bounds include the locked positions."""
    for limit in arm.coupled_limits:
        constant = sum(coefficient * stated.get(name, 0.0) for name, coefficient in limit.coefficients.items())
        coefficients = {name: x for name, x in limit.coefficients.items() if name in free}
        if any(coefficients.values()):
            lower, upper = limit.lower - constant, limit.upper - constant
            yield dataclasses.replace(limit, coefficients=coefficients, lower=lower, upper=upper)
        elif not limit.lower <= constant <= limit.upper:
            raise ArmError(
                f"{arm.name}: the locked joints violate the limit {limit.name} = {constant:.4g}; "
                f"allowed: {limit.lower:g}..{limit.upper:g}"
            )


def _effects(effects: ArmEffects, coordinates: Iterable[str], actuators: list[str]) -> ArmEffects:
    """Returns only the effects along `coordinates` and those of `actuators`."""

    def only(table: dict[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in table.items() if name in actuators}

    encoder, effort = effects.encoder, effects.effort
    return dataclasses.replace(
        effects,
        friction=[effect for effect in effects.friction if effect.coordinate in coordinates],
        cables=[effect for effect in effects.cables if effect.coordinate in coordinates],
        springs=[effect for effect in effects.springs if effect.coordinate in coordinates],
        saturation=only(effects.saturation),
        encoder=encoder and dataclasses.replace(encoder, resolution=only(encoder.resolution)),
        effort=effort and dataclasses.replace(effort, **{key: only(value) for key, value in vars(effort).items()}),
    )
