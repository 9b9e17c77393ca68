"""Systems that connect a Diagram to one arm over LCM."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem, PySerializer

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import MessageKey, StatusFilter, command_channel, decode, status_channel
from dvrk_drake.systems.lcm.dvrk_command import DvrkCommandSender
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.lcm.dvrk_status import DvrkStatusReceiver


class TolerantSerializer(PySerializer):
    """Serializer that keeps the last accepted message if a new message is rejected. With a key, it signs messages.

    With Drake's serializer for Python types, `HandleSubscriptions` raises the exception of the decoder. Any process on
    the network could therefore stop this process by an invalid message.
    """

    def __init__(
        self,
        message_type: type,
        *,
        read: Callable[[bytes], Any] | None = None,
        key: MessageKey | None = None,
    ) -> None:
        """Creates a serializer for a message type that lcm-gen generated.

        Args:
            message_type: Type of the message.
            read: Function that decodes received bytes. It returns the message, or None if the message is rejected. If
                `read` is None, the decoder of `message_type` is used.
            key: Key that signs sent messages. None: messages are not signed.
        """
        super().__init__(message_type)
        self._read = read or (lambda data: decode(message_type, data))
        self._key = key

    def Deserialize(self, buffer: bytes, abstract_value: AbstractValue) -> None:
        """Sets the value if the buffer contains an accepted message."""
        message = self._read(buffer)
        if message is not None:
            abstract_value.set_value(message)

    def Serialize(self, abstract_value: AbstractValue) -> bytes:
        """Returns the encoded message, signed if there is a key."""
        data: bytes = super().Serialize(abstract_value)
        return data if self._key is None else self._key.sign(data)


def connect_arm(
    builder: DiagramBuilder, arm: Arm, driver: DvrkDriver, lcm: DrakeLcmInterface | None = None
) -> tuple[DvrkStatusReceiver, DvrkCommandSender]:
    """Adds the systems that receive the status of an arm and send a command every `driver.status_period`.

    Args:
        builder: Builder of the Diagram.
        arm: Arm that is connected. Only statuses of the first received session are used, in the order of their
            sequence; see `StatusFilter`.
        driver: Configuration of the driver. Its key verifies statuses and signs commands.
        lcm: LCM interface whose `HandleSubscriptions` the caller calls. If it is None, a new interface at
            `driver.lcm_url` is added, and the Simulator handles its messages.

    Returns:
        Receiver of the status and sender of the command.

    Raises:
        KeyFileError: The driver's key cannot be used.
    """
    key = driver.load_key()
    statuses = StatusFilter(arm.name, arm.num_joints, key)
    if lcm is None:
        lcm = builder.AddNamedSystem("lcm", LcmInterfaceSystem(lcm=DrakeLcm(driver.lcm_url)))
    serializer = TolerantSerializer(lcmt_dvrk_status, read=lambda data: statuses.accept(data, time.monotonic()))
    subscriber = builder.AddNamedSystem("status_subscriber", LcmSubscriberSystem(status_channel(arm), serializer, lcm))
    receiver = builder.AddNamedSystem("status_receiver", DvrkStatusReceiver(arm))
    sender = builder.AddNamedSystem("command_sender", DvrkCommandSender(arm))
    publisher = builder.AddNamedSystem(
        "command_publisher",
        LcmPublisherSystem(
            command_channel(arm),
            TolerantSerializer(lcmt_dvrk_command, key=key),
            lcm,
            publish_period=driver.status_period,
        ),
    )
    for system in (receiver, sender):
        builder.Connect(subscriber.get_output_port(), system.GetInputPort("lcmt_dvrk_status"))
    builder.Connect(sender.GetOutputPort("lcmt_dvrk_command"), publisher.get_input_port())
    return receiver, sender
