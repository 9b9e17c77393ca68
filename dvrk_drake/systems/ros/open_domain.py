"""Joins a ROS 2 domain if the optional package cyclonedds is installed."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import TYPE_CHECKING

from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain

#: Largest domain whose default UDP ports exist.
MAX_DOMAIN = 232


def require_cyclonedds() -> None:
    """Checks that the package cyclonedds is installed.

    Raises:
        DvrkDrakeError: The package is missing.
    """
    if find_spec("cyclonedds") is None:
        raise DvrkDrakeError("ROS 2 needs the package cyclonedds: pip install cyclonedds")


def domain_number(domain: int | None = None) -> int:
    """Returns the number of a ROS domain.

    Args:
        domain: Number of the domain. None: the environment variable ROS_DOMAIN_ID, or else 0.

    Raises:
        DvrkDrakeError: The number is not valid.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0" if domain is None else str(domain)
    if not text.isdecimal() or int(text) > MAX_DOMAIN:
        raise DvrkDrakeError(f"ROS domain {text}: allowed: 0 to {MAX_DOMAIN} (--domain, or ROS_DOMAIN_ID)")
    return int(text)


def open_ros_domain(domain: int | None = None) -> RosDomain:
    """Joins a ROS domain, see `RosDomain`.

    Raises:
        DvrkDrakeError: The package cyclonedds is missing, or the domain cannot be used.
    """
    require_cyclonedds()
    from dvrk_drake.systems.ros.domain import RosDomain

    return RosDomain(domain_number(domain))
