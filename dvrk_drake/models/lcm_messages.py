"""The LCM messages of an arm: which channel is whose, and decoding that garbage cannot stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm

Message = TypeVar("Message", lcmt_dvrk_command, lcmt_dvrk_status)

STATUS_PREFIX = "DVRK_STATUS_"

_STATE_NAMES = {
    value: name.removeprefix("STATE_").lower()
    for name, value in vars(lcmt_dvrk_status).items()
    if name.startswith("STATE_")
}


def command_channel(arm: Arm) -> str:
    """DVRK_COMMAND_<ARM>."""
    return f"DVRK_COMMAND_{arm.name.upper()}"


def status_channel(arm: Arm) -> str:
    """DVRK_STATUS_<ARM>."""
    return STATUS_PREFIX + arm.name.upper()


def is_status_of(arm: Arm) -> Callable[[lcmt_dvrk_status], bool]:
    """Whether a status is of `arm`, by name and size."""
    return lambda status: status.arm_name == arm.name and status.num_joints == arm.num_joints


def decode(message_type: type[Message], data: bytes) -> Message | None:
    """The message of that type in `data`, or None if there is none.

    A decoder made by lcm-gen raises whatever the garbage makes it stumble over: ValueError, struct.error, MemoryError.
    """
    try:
        return message_type.decode(data)
    except Exception:
        return None


def describe_state(guard_state: int, fault_text: str = "") -> str:
    """A guard's state in words."""
    return _STATE_NAMES.get(guard_state, f"state {guard_state}") + (f": {fault_text}" if fault_text else "")
