"""Names and units of the joints of an arm, for plots and tables."""

from __future__ import annotations

from dvrk_drake.dynamics.actuator_effects import is_prismatic
from dvrk_drake.models.arm import Arm

#: Space at which no line is broken, for units.
NO_BREAK = "\N{NO-BREAK SPACE}"


def joint_label(arm: Arm, joint: int) -> str:
    """Returns the number and the name of a joint, e.g. "J1 outer_yaw"."""
    return f"J{joint + 1} {arm.joint_names[joint]}"


def effort_unit(arm: Arm, joint: int) -> str:
    """Returns "N" for a prismatic joint, otherwise "N m"."""
    return "N" if arm.prismatic[joint] else f"N{NO_BREAK}m"


def length_unit(arm: Arm, joint: int) -> str:
    """Returns "m" for a prismatic joint, otherwise "rad"."""
    return "m" if arm.prismatic[joint] else "rad"


def coordinate_units(arm: Arm, coordinate: str) -> tuple[str, str]:
    """Returns the units of the effort along a coordinate of `Arm.effect_coordinates` and of its position."""
    return ("N", "m") if is_prismatic(arm, coordinate) else ("N m", "rad")
