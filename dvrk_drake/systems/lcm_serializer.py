"""LCM messages on Drake's ports: which channel is whose, and a serializer that garbage cannot stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.lcm import PySerializer

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.command_check import decode


def command_channel(arm: Arm) -> str:
    """DVRK_COMMAND_<ARM>."""
    return f"DVRK_COMMAND_{arm.name.upper()}"


def status_channel(arm: Arm) -> str:
    """DVRK_STATUS_<ARM>."""
    return f"DVRK_STATUS_{arm.name.upper()}"


def is_status_of(arm: Arm) -> Callable[[lcmt_dvrk_status], bool]:
    """Whether a status is of `arm`, by name and size; for TolerantSerializer."""
    return lambda status: status.arm_name == arm.name and status.num_joints == arm.num_joints


class TolerantSerializer(PySerializer):
    """As Drake's for Python types, but a message that cannot be read or is not wanted leaves the last one in place.

    Drake's own lets the decoder's exception out of `HandleSubscriptions`, so that anybody on the network can stop the
    process.
    """

    def __init__(self, message_type: type, wanted: Callable[[Any], bool] = lambda message: True) -> None:
        """Of a type made by lcm-gen; messages for which `wanted` is False are ignored."""
        super().__init__(message_type)
        self._message_type, self._wanted = message_type, wanted

    def Deserialize(self, buffer: bytes, abstract_value: AbstractValue) -> None:
        """Sets the value if the buffer holds a wanted message."""
        message = decode(self._message_type, buffer)
        if message is not None and self._wanted(message):
            abstract_value.set_value(message)
