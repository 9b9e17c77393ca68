"""What a command guard tells: what the arm shall do, and what became of the commands."""

from __future__ import annotations

from dataclasses import dataclass

from dvrk_drake.systems.guard.limits import Flags, Vector


@dataclass
class GuardOutput:
    """What the arm shall do until the next step; n joints in the arm's order, always finite and inside the limits.

    Attributes:
        control_mode: lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        position: (n,) where to regulate to in HOLD and POSITION; else the measured pose [rad, m].
        velocity: (n,) feed-forward in POSITION; else zero [rad/s, m/s].
        effort: (n,) what the motors shall apply in EFFORT; else zero [N m, N].
        joint_flags: (n,) lcmt_dvrk_status.FLAG_* of what was limited.
    """

    control_mode: int
    position: Vector
    velocity: Vector
    effort: Vector
    joint_flags: Flags


@dataclass
class GuardCounts:
    """Commands since the guard was made: taken, missing, refused; and how often one in force expired."""

    accepted: int = 0
    lost: int = 0
    refused: int = 0
    expired: int = 0
