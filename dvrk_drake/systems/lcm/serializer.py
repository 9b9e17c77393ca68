"""LCM messages on Drake's ports: a serializer that garbage cannot stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.systems.lcm import PySerializer

from dvrk_drake.models.lcm_messages import decode
from dvrk_drake.models.message_key import MessageKey


class TolerantSerializer(PySerializer):
    """As Drake's for Python types, but a message that cannot be read or is not wanted leaves the last one in place.

    What is sent is signed if there is a key.

    Drake's own lets the decoder's exception out of `HandleSubscriptions`, so that anybody on the network can stop the
    process.
    """

    def __init__(
        self,
        message_type: type,
        *,
        read: Callable[[bytes], Any] | None = None,
        key: MessageKey | None = None,
    ) -> None:
        """Serializer of a type made by lcm-gen.

        Args:
            message_type: the type.
            read: returns the message in the bytes received, or None if it is to be ignored; default: decodes it.
            key: signs what is sent.
        """
        super().__init__(message_type)
        self._read = read or (lambda data: decode(message_type, data))
        self._key = key

    def Deserialize(self, buffer: bytes, abstract_value: AbstractValue) -> None:
        """Sets the value if the buffer holds a wanted message."""
        message = self._read(buffer)
        if message is not None:
            abstract_value.set_value(message)

    def Serialize(self, abstract_value: AbstractValue) -> bytes:
        """Returns the message as it goes over the wire."""
        data: bytes = super().Serialize(abstract_value)
        return data if self._key is None else self._key.sign(data)
