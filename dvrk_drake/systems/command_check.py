"""What can be said against a command by looking at it alone, and messages that are no command at all."""

from __future__ import annotations

from typing import Any

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status

#: No joint is there, that fast or that strong [rad, m, rad/s, m/s, N m, N].
ABSURD = 1e6


def is_finite(*arrays: Any) -> bool:
    """Whether all numbers are finite and none is beyond 1e6."""
    return bool((np.abs(np.concatenate(arrays)) < ABSURD).all())


def refusal_by_itself(command: lcmt_dvrk_command | None, arm_name: str, num_joints: int, session_id: int) -> int:
    """lcmt_dvrk_status.REFUSAL_* of a command that is wrong whatever the arm is doing, else REFUSAL_NONE.

    Args:
        command: as received; None: it was not readable.
        arm_name: of the arm that it must be meant for.
        num_joints: of that arm.
        session_id: of that arm.
    """
    if command is None:
        return lcmt_dvrk_status.REFUSAL_UNREADABLE
    if command.arm_name != arm_name:
        return lcmt_dvrk_status.REFUSAL_WRONG_ARM
    vectors = (command.position, command.velocity, command.effort)
    if command.num_joints != num_joints or any(len(vector) != num_joints for vector in vectors):
        return lcmt_dvrk_status.REFUSAL_WRONG_SIZE
    if not is_finite(*vectors):
        return lcmt_dvrk_status.REFUSAL_NOT_FINITE
    if command.sender_id == 0:
        return lcmt_dvrk_status.REFUSAL_NO_SENDER
    if command.session_id != session_id:
        return lcmt_dvrk_status.REFUSAL_WRONG_SESSION
    if command.reset_fault and command.control_mode != lcmt_dvrk_command.HOLD:
        return lcmt_dvrk_status.REFUSAL_BAD_RESET
    return lcmt_dvrk_status.REFUSAL_NONE
