"""Messages of an arm over LCM: command of a sender, and fields of a status that describe the guard."""

from __future__ import annotations

import secrets

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.command_stream import is_finite


def draw_id() -> int:
    """Returns a random sender_id or session_id, which is not 0 and practically unique."""
    return 1 + secrets.randbelow(2**62)


def make_command(
    status: lcmt_dvrk_status,
    sender_id: int,
    utime: int,
    mode: int,
    effort: NDArray[np.float64] | None = None,
    desired_state: NDArray[np.float64] | None = None,
    *,
    reset_fault: bool = False,
) -> lcmt_dvrk_command:
    """Returns the command that answers a status.

    The mode is HOLD if the values of the mode are missing or not finite, or with `reset_fault`. The command contains
    the session, time and sequence of the status. The arm refuses a second command for the same status, so it holds if
    the sender receives no new statuses.

    Args:
        status: Last received status.
        sender_id: Identifier of the sender.
        utime: Present time of the sender's clock [us].
        mode: lcmt_dvrk_command.OFF, HOLD, POSITION or EFFORT.
        effort: Commanded efforts (n,) [N m, N] for EFFORT.
        desired_state: Commanded q, then v (2n,) [rad, m, rad/s, m/s] for POSITION.
        reset_fault: Whether to request the reset of a fault, or the resume after a watchdog hold.
    """
    n, command = status.num_joints, lcmt_dvrk_command()
    command.utime, command.sequence, command.sender_id = utime, status.sequence, sender_id
    command.session_id, command.status_utime = status.session_id, status.utime
    command.arm_name, command.num_joints = status.arm_name, n
    efforts, q, v = [0.0] * n, [0.0] * n, [0.0] * n
    command.control_mode, command.reset_fault = lcmt_dvrk_command.HOLD, reset_fault
    values = {lcmt_dvrk_command.EFFORT: effort, lcmt_dvrk_command.POSITION: desired_state}.get(mode)
    numbers = None if values is None else values.tolist()
    if mode == lcmt_dvrk_command.OFF and not reset_fault:
        command.control_mode = mode
    elif numbers is not None and is_finite(numbers) and not reset_fault:
        command.control_mode = mode
        if mode == lcmt_dvrk_command.EFFORT:
            efforts = numbers
        else:
            q, v = numbers[:n], numbers[n:]
    command.effort, command.position, command.velocity = efforts, q, v
    return command


def fill_in_guard(status: lcmt_dvrk_status, guard: CommandGuard) -> None:
    """Sets the fields of `status` that describe the state of a guard. A bridge can call this function as well."""
    status.session_id = guard.session_id
    status.guard_state, status.accepted_modes = guard.state, guard.accepted_modes
    status.fault_code, status.fault_text = guard.fault_code, guard.fault_text or guard.blocked_reason
    status.weaker_settings = guard.weaker_settings
    status.command_sender_id = guard.sender_id
    status.command_sequence, status.command_utime = guard.last_command.sequence, guard.last_command.utime
    counts = guard.counts
    status.num_accepted, status.num_lost, status.num_refused = counts.accepted, counts.lost, counts.refused
    status.num_expired, status.refusal_code = counts.expired, guard.refusal_code
    status.num_ignored, status.ignored_code = counts.ignored, guard.ignored_code
    status.position_commanded = guard.output.position.tolist()
    status.joint_flags = guard.output.joint_flags.tolist()
