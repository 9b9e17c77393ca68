"""Page of the state of an arm, and of what its operator can do next."""

from __future__ import annotations

import numpy as np

from dvrk_drake.models.arm import Arm
from dvrk_drake.processes.arm_operator import ArmObservation
from dvrk_drake.reports.page import Block, Level, Page, Section, Table, Text


def status_page(arm: Arm, observation: ArmObservation) -> Page:
    """Returns state and its reason, the rates of the messages, and the joints beside their limits."""
    level: Level = "bad" if observation.is_fault else "warning" if observation.next_step else "good"
    shares = 100 * np.abs(observation.effort) / arm.effort_limits
    rows = []
    for j, name in enumerate(arm.joint_names):
        limits = f"{arm.position_lower[j]:.3g} .. {arm.position_upper[j]:.3g}"
        measured = observation.q[j], observation.v[j], observation.effort[j]
        position, velocity, effort = (f"{round(x, 3) + 0.0:.3f}" for x in measured)  # no -0.000
        rows.append((name, position, limits, velocity, effort, f"{shares[j]:.0f} %", observation.flags[j]))
    header = ("", "position", "limits", "velocity", "effort", "share of limit", "")
    blocks: list[Block] = [
        Text(" ".join(observation.notes)),
        Table(header, rows, "Joints [rad, N m; prismatic: m, N]"),
    ]
    answer = f"{arm.name}: {observation.state}, {observation.why}."
    return Page(f"State of {arm.name}", answer, [Section("Joints", blocks)], level, observation.next_step)
