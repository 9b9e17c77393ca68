"""Checks position limits and coupled limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm_schema import ANGLE_WIDTHS, ANGLES, TRAVEL_WIDTHS, TRAVELS, CoupledLimit
from dvrk_drake.models.ranges import number_fault


def coupled_limit_fault(
    limit: CoupledLimit,
    joint_names: Sequence[str],
    prismatic: NDArray[np.bool_],
    position_lower: NDArray[np.float64],
    position_upper: NDArray[np.float64],
) -> str:
    """Returns a message on the first fault of a coupled limit, with the accepted values, or "" if there is none.

    The other arguments are attributes of `dvrk_drake.models.arm.Arm`.
    """
    key = f"coupled_limits.{limit.name}"
    row = np.array([limit.coefficients.get(name, 0.0) for name in joint_names])
    coupled = row != 0
    if not np.any(coupled):
        return f"{key}: all coefficients are 0; allowed: at least one other value"
    slides = bool(np.all(prismatic[coupled]))
    if fault := number_fault(limit):
        return f"{key}.{fault}"
    if fault := limits_fault(key, limit.lower, limit.upper, slides):
        return fault
    ends = np.sort(row * [position_lower, position_upper], axis=0).sum(axis=1)
    if ends[1] < limit.lower or ends[0] > limit.upper:
        return (
            f"{key}: no pose within position_limits meets {limit.lower:g}..{limit.upper:g}; "
            f"allowed: limits that overlap {ends[0]:.4g}..{ends[1]:.4g}"
        )
    return ""


def can_meet_limits(A: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]) -> bool:
    """Returns whether at least one pose q meets lower <= A q <= upper. The first rows of A are the unit matrix."""
    from scipy.optimize import linprog  # slow import; few arms have two coupled limits

    n = A.shape[1]
    bounds = np.column_stack([lower[:n], upper[:n]])
    inequalities = np.vstack([A[n:], -A[n:]]), np.concatenate([upper[n:], -lower[n:]])
    return bool(linprog(np.zeros(n), *inequalities, bounds=bounds).success)


def limits_fault(key: str, lower: float, upper: float, slides: bool) -> str:
    """Returns a message on the first fault of a lower and an upper position limit, or "" if there is none."""
    positions, widths = (TRAVELS, TRAVEL_WIDTHS) if slides else (ANGLES, ANGLE_WIDTHS)
    if fault := positions.fault(f"{key}[0]", lower) or positions.fault(f"{key}[1]", upper):
        return fault
    if not lower < upper:
        return f"{key} is [{lower:g}, {upper:g}]; allowed: [lower, upper] with lower < upper"
    return widths.fault(f"{key}: upper - lower", upper - lower)
