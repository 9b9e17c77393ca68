"""Measures the computing time of message authentication per period.

    python benchmarks/message_key.py [--repetitions 20000]

The same work is timed without and with a key. Rows:

    arm         work of the arm: decode one command, pass it to the guard, encode one status
    controller  work of the controller: decode one status, encode one command
    foreign     rejection of one message by the arm. Without a key, the message belongs to another session. With a key,
                the message is signed with another key.

No messages are sent.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from timing import measured_times, median_ratio, print_table

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import MessageKey, StatusFilter
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.lcm.messages import CommandInbox, fill_in_guard

ARM = load_arm("mtml")
N = ARM.num_joints
KEY = MessageKey(bytes(range(32)))


class Arm:
    """Guard, inbox and status of an arm at rest."""

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
        """Returns the encoded message, signed if there is a key."""
        data: bytes = message.encode()
        return data if self.key is None else self.key.sign(data)

    def step(self) -> None:
        """Steps the guard and prepares the next command. This time is not in the table."""
        self.utime += 1000
        self.guard.step(self.utime, self.utime, self.q, self.zero, self.zero)
        self.command.utime = self.command.status_utime = self.utime
        self.command.sequence += 1
        self.data = self.signed(self.command)

    def period(self) -> None:
        """Receives a command and encodes a status."""
        self.inbox.put(self.data)
        self.inbox.deliver(self.guard, self.utime)
        self.status.utime, self.status.sequence = self.utime, self.status.sequence + 1
        fill_in_guard(self.status, self.guard)
        self.status_data = self.signed(self.status)


class Controller:
    """Controller that exchanges messages with an `Arm`."""

    def __init__(self, arm: Arm) -> None:
        self.arm, self.statuses, self.time = arm, StatusFilter(ARM.name, N, arm.key), 0.0

    def period(self) -> None:
        """Receives a status and encodes a command."""
        self.time += 1e-3
        self.statuses.accept(self.arm.status_data, self.time)
        self.arm.signed(self.arm.command)


def main() -> None:
    """Prints one row per kind of work."""
    parser = argparse.ArgumentParser(description="Measures the computing time of message authentication per period.")
    parser.add_argument("--repetitions", type=int, default=20_000, help="number of repetitions; default: %(default)s")
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
    count = options.repetitions + 1  # including the call that is not timed
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
    print_table("Computing time per period, median", ["no key [us]", "key [us]", "ratio key / no key"], rows)


if __name__ == "__main__":
    main()
