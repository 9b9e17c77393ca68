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

_REFUSALS = {
    lcmt_dvrk_status.REFUSAL_NONE: "none",
    lcmt_dvrk_status.REFUSAL_UNREADABLE: "unreadable",
    lcmt_dvrk_status.REFUSAL_WRONG_ARM: "meant for another arm",
    lcmt_dvrk_status.REFUSAL_WRONG_SIZE: "of another number of joints",
    lcmt_dvrk_status.REFUSAL_NOT_FINITE: "not finite",
    lcmt_dvrk_status.REFUSAL_BAD_MODE: "in a mode that is not accepted now",
    lcmt_dvrk_status.REFUSAL_NO_SENDER: "without a sender_id",
    lcmt_dvrk_status.REFUSAL_WRONG_SESSION: "meant for the arm before it was restarted",
    lcmt_dvrk_status.REFUSAL_STALE: "too late: the measurement is too old",
    lcmt_dvrk_status.REFUSAL_OUT_OF_ORDER: "sent twice or out of order",
    lcmt_dvrk_status.REFUSAL_CLOCK_JUMP: "after a jump of the sender's clock",
    lcmt_dvrk_status.REFUSAL_FAULT: "in a fault",
    lcmt_dvrk_status.REFUSAL_BAD_RESET: "a reset that is no hold",
    lcmt_dvrk_status.REFUSAL_START_FAR: "starting too far from the present efforts or pose",
    lcmt_dvrk_status.REFUSAL_START_OUTSIDE: "starting while the arm is beyond a position limit",
    lcmt_dvrk_status.REFUSAL_OTHER_SENDER: "from a second sender",
    lcmt_dvrk_status.REFUSAL_SUDDEN_OFF: "off without a hold before",
    lcmt_dvrk_status.REFUSAL_RESUME: "before an operator resumed",
    lcmt_dvrk_status.REFUSAL_START_GRAVITY: "starting while the measured effort is not the gravity effort",
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


def is_old(status: lcmt_dvrk_status, last: lcmt_dvrk_status) -> bool:
    """Whether `status` was sent before `last` or is it: of a log that is played on the arm's network, or overtaken."""
    return status.session_id == last.session_id and status.sequence <= last.sequence


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


def describe_refusal(refusal_code: int) -> str:
    """Why a command was refused, in words."""
    return _REFUSALS.get(refusal_code, f"refusal {refusal_code}")
