"""Joins a ROS 2 domain if the optional package cyclonedds is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain


def open_ros_domain(domain: int | None = None) -> RosDomain:
    """Joins a ROS domain, see `RosDomain`.

    Raises:
        DvrkDrakeError: The package cyclonedds is missing, or the domain cannot be used.
    """
    try:
        from dvrk_drake.systems.ros.domain import RosDomain
    except ModuleNotFoundError as error:
        raise DvrkDrakeError("ROS 2 needs the package cyclonedds: pip install cyclonedds") from error
    return RosDomain(domain)
