"""Joins a ROS 2 domain if the optional package cyclonedds is installed."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain


def require_cyclonedds() -> None:
    """Checks that the package cyclonedds is installed.

    Raises:
        DvrkDrakeError: The package is missing.
    """
    if find_spec("cyclonedds") is None:
        raise DvrkDrakeError("ROS 2 needs the package cyclonedds: pip install cyclonedds")


def open_ros_domain(domain: int | None = None) -> RosDomain:
    """Joins a ROS domain, see `RosDomain`.

    Raises:
        DvrkDrakeError: The package cyclonedds is missing, or the domain cannot be used.
    """
    require_cyclonedds()
    from dvrk_drake.systems.ros.domain import RosDomain

    return RosDomain(domain)
