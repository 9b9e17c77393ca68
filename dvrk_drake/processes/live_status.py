"""How answering an arm goes: what `dvrk-drake run` and `collect` show while they do."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.lcm_messages import describe_refusal, describe_state


@dataclass(frozen=True)
class LiveStatus:
    """How it goes, in words.

    Attributes:
        state: the guard's.
        pace: rate, round trip and losses.
        problem: whether commands were refused or expired since the last one, and why; or "".
    """

    state: str
    pace: str
    problem: str

    def __str__(self) -> str:
        return "; ".join(filter(None, [self.state, self.pace, self.problem]))


class LiveStatusMaker:
    """Counts what was answered between two reports."""

    def __init__(self, sender_id: int, first: lcmt_dvrk_status) -> None:
        """Of a sender; counts begin at the arm's `first` status. A new one when the arm was restarted."""
        self._sender_id, self._before, self._told_at = sender_id, first, 0.0
        self._answered = 0
        self._trips: deque[float] = deque(maxlen=1000)

    def answer(self, status: lcmt_dvrk_status, time: float) -> None:
        """Counts an answer to `status` at `time` [s] of the sender's clock."""
        self._answered += 1
        if status.command_sender_id == self._sender_id:
            self._trips.append(time - 1e-6 * status.command_utime)

    def make(self, status: lcmt_dvrk_status, time: float, lost: int) -> LiveStatus:
        """How it went since the last one; `lost` statuses never came."""
        rate = self._answered / (time - self._told_at)
        trip = f"round trip {1e3 * float(np.median(self._trips)):.2f} ms" if self._trips else "no command accepted yet"
        problem = []
        if status.num_refused > self._before.num_refused:
            problem.append(f"refused: {describe_refusal(status.refusal_code)}")
        if status.num_expired > self._before.num_expired:
            problem.append("no command for so long that the arm took over")
        self._before, self._told_at, self._answered = status, time, 0
        pace = f"{rate:.0f} Hz, {trip}, {lost} statuses lost"
        return LiveStatus(describe_state(status.guard_state), pace, ", ".join(problem))


def takeover_reason(status: lcmt_dvrk_status, num_expired: int) -> str:
    """Why an arm obeys no longer, if `num_expired` commands had expired while it did."""
    if status.num_expired > num_expired:
        return "commands came too late for it (use --realtime)"
    if status.refusal_code != lcmt_dvrk_status.REFUSAL_NONE:
        return f"its last refusal is {describe_refusal(status.refusal_code)}"
    return f"its state is {describe_state(status.guard_state)}"
