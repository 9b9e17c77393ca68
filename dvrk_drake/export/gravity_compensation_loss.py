"""Torque differences between a gravity-compensation file of the dVRK and the model from which it was computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm

#: Smallest default tolerance [N m, N], for an arm file without friction. It exceeds rounding errors.
LEAST_TOLERANCE = 1e-6
#: Largest difference [N m, N] that is a rounding error.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class CompensationLoss:
    """Largest torque differences between a file and its model at rest, for the k joints that the file describes.

    Attributes:
        joints: Names (k,) of the joints.
        units: Units (k,) of the differences, "N m" or "N".
        difference: Largest differences (k,) at random poses within the joint limits [N m, N].
        share: Largest differences (k,), divided by the effort limits of the joints.
        poses: Poses (k, n) at which the differences are largest [rad, m].
        causes: Part of the model (k,) that contributes most to each difference. "" if the difference is a rounding
            error.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    difference: NDArray[np.float64]
    share: NDArray[np.float64]
    poses: NDArray[np.float64]
    causes: tuple[str, ...]

    @property
    def worst(self) -> int:
        """Index of the joint with the largest difference relative to its effort limit."""
        return int(np.argmax(self.share))

    def check(self, tolerance: NDArray[np.float64]) -> None:
        """Raises ModelError if a difference exceeds the tolerance (k,) of its joint [N m, N]."""
        excess = np.flatnonzero(self.difference > tolerance)
        if not len(excess):
            return
        faults = ", ".join(
            f"{self.joints[j]} {self.difference[j]:.2g} {self.units[j]} ({100 * self.share[j]:.1f} % of the effort "
            f"limit, allowed: {tolerance[j]:.3g} {self.units[j]}, cause: {self.causes[j]})"
            for j in excess
        )
        raise ModelError(
            f"the controller's file cannot represent this model. Largest torque differences: {faults}. "
            f"To accept them, repeat the command with --gc-tolerance {round_up(self.difference.max()):g}"
        )


def make_loss(
    arm: Arm, poses: NDArray[np.float64], error: NDArray[np.float64], contributions: dict[str, NDArray[np.float64]]
) -> CompensationLoss:
    """Finds the largest differences and their causes.

    Args:
        arm: Arm of the model.
        poses: Poses (m, n) [rad, m].
        error: Torque of the file minus torque of the model (m, k) for the first k joints [N m, N].
        contributions: Mapping from a cause to its contribution (m, k) to `error`.
    """
    count = error.shape[1]
    rows = np.abs(error).argmax(axis=0)
    difference = np.abs(error).max(axis=0)
    causes = tuple(
        max(contributions, key=lambda cause: contributions[cause][row, j] * np.sign(error[row, j]))
        if difference[j] > ROUNDING and contributions
        else ""
        for j, row in enumerate(rows)
    )
    return CompensationLoss(
        arm.joint_names[:count],
        tuple("N" if prismatic else "N m" for prismatic in arm.prismatic[:count]),
        difference,
        difference / arm.effort_limits[:count],
        poses[rows],
        causes,
    )


def accepted_differences(arm: Arm, tolerance: float | None) -> NDArray[np.float64]:
    """Returns the largest accepted torque differences (n,) between a file and its model [N m, N].

    The default is the dry friction of each joint, because this friction holds a joint at rest despite such a
    difference. The friction is read from `effects` in the arm's files. It was measured on one real arm.

    Args:
        arm: Arm of the model.
        tolerance: Largest accepted difference on any joint [N m, N]. None: the default of each joint.

    Raises:
        ModelError: The tolerance is negative or not finite.
    """
    if tolerance is None:
        return np.maximum(arm.dry_friction(), LEAST_TOLERANCE)
    if not 0 <= tolerance < np.inf:
        raise ModelError(f"--gc-tolerance is {tolerance:g}; allowed: a finite number of 0 or more [N m, N]")
    return np.full(arm.num_joints, tolerance)


def round_up(x: float) -> float:
    """Returns x, rounded up to two significant digits."""
    unit = 10.0 ** (np.floor(np.log10(x)) - 1)
    return float(np.ceil(x / unit) * unit)
