"""Cost per period of authenticated messages, beside the same work without a key in the same run.

    python benchmarks/message_key.py [--repetitions 20000]

Rows, with the median time and the ratio to the row without a key:

    arm         the arm's side of a period: one command from its bytes into the guard, one status into bytes
    controller  the controller's side of a period: one status from its bytes, one command into bytes
    foreign     a message that the arm's inbox drops: of another session; with the key, signed with another one

Nothing is sent.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from timing import measured_times, median_ratio, print_table

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.lcm_messages import MessageKey, StatusFilter
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.command_inbox import CommandInbox
from dvrk_drake.systems.lcm.dvrk_status import fill_in_guard

ARM = load_arm("mtml")
N = ARM.num_joints
KEY = MessageKey(bytes(range(32)))


class Arm:
    """A guard with its inbox, and its status; the arm stands still."""

    def __init__(self, key: MessageKey | None) -> None:
        self.key, self.utime = key, 10**15
        self.guard = CommandGuard(ARM, 7, ControlModel(IdentifiedModel.from_arm(ARM)))
        self.inbox = CommandInbox(self.guard, key)
        self.q, self.zero = np.zeros(N), np.zeros(N)
        self.command, self.status = lcmt_dvrk_command(), lcmt_dvrk_status()
        self.command.sender_id, self.command.session_id, self.command.arm_name = 5, 7, ARM.name
        self.command.num_joints, self.command.control_mode = N, lcmt_dvrk_command.HOLD
        self.command.position = self.command.velocity = self.command.effort = [0.0] * N
        self.status.arm_name, self.status.num_joints = ARM.name, N
        self.status.position = self.status.velocity = [0.0] * N
        self.status.effort_measured = self.status.effort_commanded = [0.0] * N
        self.data = self.other = b""
        self.step()

    def signed(self, message: lcmt_dvrk_command | lcmt_dvrk_status) -> bytes:
        """The message as it goes over the wire."""
        data: bytes = message.encode()
        return data if self.key is None else self.key.sign(data)

    def step(self) -> None:
        """A step of the guard, and the next command; not in the table."""
        self.utime += 1000
        self.guard.step(self.utime, self.utime, self.q, self.zero, self.zero)
        self.command.utime = self.command.status_utime = self.utime
        self.command.sequence += 1
        self.data = self.signed(self.command)

    def period(self) -> None:
        """A command in, a status out."""
        self.inbox.put(self.data)
        self.inbox.deliver(self.guard, self.utime)
        self.status.utime, self.status.sequence = self.utime, self.status.sequence + 1
        fill_in_guard(self.status, self.guard)
        self.status_data = self.signed(self.status)


class Controller:
    """The other side of an `Arm`."""

    def __init__(self, arm: Arm) -> None:
        self.arm, self.statuses, self.time = arm, StatusFilter(ARM.name, N, arm.key), 0.0

    def period(self) -> None:
        """A status in, a command out."""
        self.time += 1e-3
        self.statuses.accept(self.arm.status_data, self.time)
        self.arm.signed(self.arm.command)


def main() -> None:
    """Prints a row for each kind of work."""
    parser = argparse.ArgumentParser(description="Cost per period of authenticated messages.")
    parser.add_argument("--repetitions", type=int, default=20_000)
    options = parser.parse_args()
    bare, keyed = Arm(None), Arm(KEY)
    bare_controller, keyed_controller = Controller(bare), Controller(keyed)
    foreign, spoofed = lcmt_dvrk_command.decode(bare.data), MessageKey(bytes(32)).sign(bare.data)
    foreign.session_id += 1
    foreign = foreign.encode()
    functions = {
        "next": bare.step,
        "next, key": keyed.step,
        "arm": bare.period,
        "arm, key": keyed.period,
        "controller": bare_controller.period,
        "controller, key": keyed_controller.period,
        "foreign": lambda: bare.inbox.put(foreign),
        "foreign, key": lambda: keyed.inbox.put(spoofed),
    }
    times = measured_times(functions, options.repetitions, clock=time.perf_counter)
    count = options.repetitions + 1  # with the one that does not count
    assert bare.guard.counts.refused == keyed.guard.counts.refused == 0
    assert bare.guard.counts.accepted == keyed.guard.counts.accepted == count
    assert bare_controller.statuses.last.sequence == keyed_controller.statuses.last.sequence == count
    rows = {
        name: [
            *(f"{1e6 * np.median(times[work]):.1f}" for work in (name, f"{name}, key")),
            f"{median_ratio(times, f'{name}, key', name):.2f}",
        ]
        for name in ("arm", "controller", "foreign")
    }
    print_table("Messages of one period", ["no key [us]", "key [us]", "ratio"], rows)


if __name__ == "__main__":
    main()
