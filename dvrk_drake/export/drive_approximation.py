"""Approximates the effects in the drives of an arm by the friction and springs that file formats of simulators have."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effect_kinds import EFFECT_KINDS
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.mjcf import Drive

#: Number of random poses and velocities at which the effects are approximated.
_SAMPLES = 400
#: Largest speeds of the samples [rad/s, m/s], about those of an excitation of a dVRK.
_SPEEDS = (1.0, 0.1)


@dataclass(frozen=True, eq=False)
class DriveApproximation:
    """Friction and springs of the drives in a form that simulators have, and what this form omits.

    Attributes:
        drives: Dry friction, viscous friction and linear spring along each coordinate.
        effort: RMS effort (n,) of all effects on each joint while the arm moves [N m, N].
        difference: RMS difference (n,) between this effort and that of `drives` on each joint [N m, N].
    """

    drives: tuple[Drive, ...]
    effort: NDArray[np.float64]
    difference: NDArray[np.float64]


def approximate_drives(model: IdentifiedModel, *, coupled: bool = True) -> DriveApproximation:
    """Returns the least-squares approximation of the effects of a model, or of its arm if the model has no dynamics.

    Each coordinate has the effort F sign(v) + D v + K x with F, D and K of 0 or more. Presliding friction is
    approximated by its friction after the travel. Loads are the efforts that compensate gravity.

    Args:
        model: Model of an arm.
        coupled: Whether the format has friction along combinations of joints. Otherwise, the dry friction of a
            coordinate acts on each of its joints, viscous friction only on the diagonal, and springs are omitted.
    """
    from scipy.optimize import nnls

    arm, own = model.arm, model.arm.effects
    effects = list(model.dynamics.effects) if model.dynamics else [*own.friction, *own.cables, *own.springs]
    generator = np.random.default_rng(0)
    q = arm.sample_poses(_SAMPLES, generator)
    v = arm.per_joint(*_SPEEDS) * generator.uniform(-1.0, 1.0, q.shape)
    total, drives = np.zeros_like(q), []
    for name in dict.fromkeys(effect.coordinate for effect in effects):
        row = arm.effect_coordinates[name] @ arm.transmission.matrix
        effort = _effort(model, [effect for effect in effects if effect.coordinate == name], q, v)
        (dry, viscous, stiffness), _ = nnls(np.column_stack([np.sign(v @ row), v @ row, q @ row]), effort)
        moved = {joint: float(r) for joint, r in zip(arm.joint_names, row, strict=True) if abs(r) > 1e-12}
        drives.append(Drive(name, moved, float(dry), float(viscous), float(stiffness)))
        total += effort[:, None] * row
    if not coupled:
        drives = _of_single_joints(arm, drives)
    difference = total - sum((_on_joints(arm, drive, q, v) for drive in drives), np.zeros_like(q))
    rms = [np.sqrt(np.mean(x**2, axis=0)) for x in (total, difference)]
    return DriveApproximation(tuple(drives), *rms)


def _effort(
    model: IdentifiedModel, effects: Iterable[DriveEffect], q: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the effort (m,) of the effects of one coordinate along this coordinate, after their travels [N m, N]."""
    arm, total = model.arm, np.zeros(len(q))
    for effect in effects:
        h = arm.effect_coordinates[effect.coordinate]
        x, speed = arm.transmission.position(q) @ h, arm.transmission.velocity(v) @ h
        load = np.zeros(len(q))
        if EFFECT_KINDS[effect.kind].loaded:
            transmitted = arm.transmission.inverse.pull_back_effort(model.holding_torque(q))
            load = np.abs(transmitted @ h) / (h @ h)
        law, far = ActuatorEffect.of(effect), 1e6
        shape = [law.step(0.0, far * np.sign(s), *at) for s, *at in zip(speed, x, speed, load, strict=True)]
        total += effect.coefficient * np.array([value for _, value in shape])
    return total


def _of_single_joints(arm: Arm, drives: Sequence[Drive]) -> list[Drive]:
    singles = []
    for joint in arm.joint_names:
        own = [(drive, drive.row[joint]) for drive in drives if joint in drive.row]
        dry, viscous = sum(abs(r) * d.dry for d, r in own), sum(r**2 * d.viscous for d, r in own)
        singles.append(Drive(joint, {joint: 1.0}, dry, viscous))
    return singles


def _on_joints(arm: Arm, drive: Drive, q: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    row = np.array([drive.row.get(joint, 0.0) for joint in arm.joint_names])
    effort = drive.dry * np.sign(v @ row) + drive.viscous * (v @ row) + drive.stiffness * (q @ row)
    return effort[:, None] * row
