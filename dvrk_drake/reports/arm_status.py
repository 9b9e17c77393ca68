"""Page of the state of an arm over LCM, and of what its operator can do next."""

from __future__ import annotations

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import describe_state
from dvrk_drake.processes.arm_operator import ArmObservation
from dvrk_drake.reports.page import Block, Level, Page, Section, Table, Text

#: Bits of `joint_flags` and what they mean.
_FLAGS = {
    lcmt_dvrk_status.FLAG_EFFORT_CLAMPED: "effort limit",
    lcmt_dvrk_status.FLAG_RATE_LIMITED: "rate limit",
    lcmt_dvrk_status.FLAG_POSITION_LIMIT: "soft wall",
    lcmt_dvrk_status.FLAG_COUPLED_LIMIT: "coupled limit",
    lcmt_dvrk_status.FLAG_SPEED_LIMIT: "speed limit",
    lcmt_dvrk_status.FLAG_IMPLAUSIBLE: "position not plausible",
}


def status_page(arm: Arm, observation: ArmObservation) -> Page:
    """Returns state and its reason, rates, weaker settings of the guard, and the joints beside their limits."""
    status = observation.last
    why, next_step = observation.explanation()
    is_fault = status.fault_code != lcmt_dvrk_status.FAULT_NONE
    level: Level = "bad" if is_fault else "warning" if next_step else "good"
    rate = observation.count / observation.seconds
    counts = f"{status.num_refused} refused, {status.num_ignored} ignored, {status.num_expired} expired"
    blocks: list[Block] = [
        Text(
            f"Statuses: {rate:.0f} per second, {observation.lost} lost. Commands since the start of the arm: "
            f"{status.num_accepted} accepted, {status.num_lost} lost, {counts}."
        )
    ]
    if status.weaker_settings:
        blocks.append(Text(f"Guard settings weaker than the defaults: {status.weaker_settings}."))
    rows = []
    shares = np.abs(status.effort_measured) / arm.effort_limits
    for j, name in enumerate(arm.joint_names):
        flags = [text for bit, text in _FLAGS.items() if status.joint_flags[j] & bit]
        limits = f"{arm.position_lower[j]:.3g} .. {arm.position_upper[j]:.3g}"
        measured = status.position[j], status.velocity[j], status.effort_measured[j]
        position, velocity, effort = (f"{round(x, 3) + 0.0:.3f}" for x in measured)  # no -0.000
        rows.append((name, position, limits, velocity, effort, f"{100 * shares[j]:.0f} %", ", ".join(flags)))
    header = ("", "position", "limits", "velocity", "effort", "share of limit", "")
    right = [False, True, True, True, True, True, False]
    blocks.append(Table(header, rows, "Joints [rad, N m; prismatic: m, N]", right=right))
    answer = f"{arm.name}: {describe_state(status.guard_state)}, {why}."
    return Page(f"State of {arm.name}", answer, [Section("Joints", blocks)], level, next_step)
