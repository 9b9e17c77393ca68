"""LCM messages on Drake's ports: a serializer that garbage cannot stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.lcm import PySerializer

from dvrk_drake.models.lcm_messages import decode


class TolerantSerializer(PySerializer):
    """As Drake's for Python types, but a message that cannot be read or is not wanted leaves the last one in place.

    Drake's own lets the decoder's exception out of `HandleSubscriptions`, so that anybody on the network can stop the
    process.
    """

    def __init__(self, message_type: type, wanted: Callable[[Any, Any], bool] = lambda message, last: True) -> None:
        """Of a type made by lcm-gen; messages for which `wanted`, of one and the last taken, is False are ignored."""
        super().__init__(message_type)
        self._message_type, self._wanted = message_type, wanted

    def Deserialize(self, buffer: bytes, abstract_value: AbstractValue) -> None:
        """Sets the value if the buffer holds a wanted message."""
        message = decode(self._message_type, buffer)
        if message is not None and self._wanted(message, abstract_value.get_value()):
            abstract_value.set_value(message)
