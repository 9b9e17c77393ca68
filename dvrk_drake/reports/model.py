"""Page of the gravity model of an arm."""

from __future__ import annotations

from dvrk_drake.dynamics.symbolic_gravity import SymbolicGravity
from dvrk_drake.reports.page import Page, Section, Table


def symbolic_model_page(gravity: SymbolicGravity, *, command: str = "") -> Page:
    """Returns the base parameters of gravity with their nominal values from the SDF, and the joint limits.

    Args:
        gravity: Symbolic gravity.
        command: Suggested next command. "": there is none.
    """
    arm, base = gravity.arm, gravity.base
    parameters = [
        (name, f"{value:+.5f}", unit)
        for name, value, unit in zip(base.names, gravity.base_values, base.units, strict=True)
    ]
    limits = [
        (
            f"q{i + 1} {name}",
            f"{arm.position_lower[i]:+.4f}..{arm.position_upper[i]:+.4f}",
            f"{arm.effort_limits[i]:.4g}",
        )
        for i, name in enumerate(arm.joint_names)
    ]
    for limit in arm.coupled_limits:
        terms = " + ".join(f"{c:g} {joint}" if c != 1 else joint for joint, c in limit.coefficients.items())
        limits.append((f"{limit.name}: {terms}", f"{limit.lower:+.4f}..{limit.upper:+.4f}", ""))
    header = ("base parameter", "nominal value (SDF)", "unit")
    caption = "Joint limits [rad, N m; m, N if prismatic]"
    return Page(
        f"Gravity of {arm.name}",
        f"The gravity torque of {arm.name} depends on {len(base.names)} base parameters.",
        [
            Section("Base parameters", [Table(header, parameters, f"{arm.name}: base parameters of gravity")]),
            Section("Joint limits", [Table(("", "position", "effort"), limits, caption, show="details")]),
        ],
        "good",
        command,
    )
