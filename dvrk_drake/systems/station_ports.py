"""The ports that an arm has, in simulation and on hardware alike."""

from __future__ import annotations

from dataclasses import dataclass

from dvrk_drake.models.arm import Arm


@dataclass(frozen=True)
class StationPorts:
    """Name -> size of the ports that a station of one arm has, in simulation and on hardware alike."""

    inputs: dict[str, int]
    outputs: dict[str, int]


def station_ports(arm: Arm) -> StationPorts:
    """The ports of `arm`'s station, named like the fields of the iiwa's driver in Drake.

    Prefixed with the arm's lower-case name; n numbers in the arm's order of joints [rad, rad/s, N m; m, m/s,
    N].
    """
    n, name = arm.num_joints, arm.name.lower()
    return StationPorts(
        inputs={f"{name}.effort_commanded": n},
        outputs={
            f"{name}.position_measured": n,
            f"{name}.velocity_estimated": n,
            f"{name}.state_estimated": 2 * n,
            f"{name}.effort_measured": n,
        },
    )
