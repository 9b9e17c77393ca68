"""Inbox of a guard: dropped bytes, behaviour in a flood, and authentication with a key."""

import numpy as np
import pytest
from guard_bench import LIMIT, SESSION, Bench

from dvrk_drake.lcmtypes import lcmt_dvrk_command as Command
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import MessageKey
from dvrk_drake.systems.lcm.messages import CommandInbox

KEY = MessageKey(bytes(range(32)))
#: Number of messages above the capacity of an inbox.
FLOOD = 100


class Networked(Bench):
    """Test bench whose commands pass through an inbox as bytes."""

    def __init__(self, key=None, **arguments):
        super().__init__(**arguments)
        self.key, self.sent = key, []
        self.inbox = CommandInbox(self.guard, key)

    def put(self, *messages):
        for data in messages:
            self.inbox.put(data)

    def good(self, **fields):
        data = self.command(**fields).encode()
        return data if self.key is None else self.key.sign(data)

    def round(self, before=(), after=()):
        """Runs one millisecond with a valid command between other messages."""
        self.sent.append(self.good())
        self.put(*before, self.sent[-1], *after)
        self.inbox.deliver(self.guard, self.utime)
        return self.tick()

    def acting(self):
        for _ in range(260):
            self.round()
        assert self.guard.state == Status.STATE_EFFORT
        return self


def stranger(bench, **fields):
    """Returns a command of another process. The sequence of the sender does not change."""
    command = bench.command(**{"effort": list(LIMIT), **fields})
    bench.sequence -= 1
    return command.encode()


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"arm_name": "MTMLX"}, Status.REFUSAL_WRONG_ARM),
        (dict.fromkeys(("position", "velocity", "effort"), [0.0] * 8) | {"num_joints": 8}, Status.REFUSAL_WRONG_SIZE),
        (b"garbage", Status.REFUSAL_UNREADABLE),
        (Status().encode(), Status.REFUSAL_UNREADABLE),
        (Command().encode(), Status.REFUSAL_WRONG_SESSION),
    ],
)
def test_foreign_messages_are_counted_by_reason(fields, code):
    bench = Networked().acting()
    data = fields if isinstance(fields, bytes) else stranger(bench, **fields)
    bench.round([data] * 3, [data] * 2)
    assert (bench.guard.counts.ignored, bench.guard.ignored_code) == (5, code)
    assert (bench.guard.counts.refused, bench.guard.state) == (0, Status.STATE_EFFORT)


@pytest.mark.parametrize("name", ["mtml", "mtmr", "psm"])
@pytest.mark.parametrize("key", [None, KEY])
def test_valid_commands_of_any_arm_are_delivered(name, key):
    bench = Networked(key, arm=load_arm(name)).acting()
    assert (bench.guard.counts.accepted, bench.guard.counts.ignored) == (260, 0)
    # An arm without a key accepts a signed command as well.
    bench.inbox = CommandInbox(bench.guard)
    bench.round()
    assert bench.guard.counts.accepted == 261


@pytest.mark.parametrize(
    "kind", ["garbage", "other session", "other senders", "signed with another key", "copies of the sender's own"]
)
@pytest.mark.parametrize("key", [None, KEY])
def test_flood_does_not_displace_sender_in_control(kind, key):
    bench = Networked(key).acting()
    for _ in range(200):
        flood = {
            "garbage": [bytes(300)] * FLOOD,
            "other session": [stranger(bench, session_id=5)] * FLOOD,
            "other senders": [stranger(bench, sender_id=1000 + k) for k in range(FLOOD)],
            "signed with another key": [MessageKey(bytes(32)).sign(stranger(bench, sender_id=9))] * FLOOD,
            "copies of the sender's own": bench.sent[-FLOOD:],
        }[kind]
        output = bench.round(flood, flood)
        assert output.control_mode == Command.EFFORT
    np.testing.assert_allclose(output.effort, 0.05 * LIMIT, atol=1e-12)
    assert bench.guard.counts.ignored + bench.guard.counts.refused == 200 * 2 * FLOOD
    assert bench.guard.counts.accepted == 460
    assert bench.guard.counts.refused == 0 or "copies" in kind


def test_flood_decodes_bounded_number():
    bench = Networked().acting()
    given = []
    receive = bench.guard.receive
    bench.guard.receive = lambda command, utime: (given.append(command), receive(command, utime))
    bench.round([stranger(bench, sender_id=6)] * FLOOD, [bench.sent[-1]] * FLOOD)
    assert len(given) == 32
    assert bench.guard.ignored_code == Status.REFUSAL_OTHER_SENDER
    assert bench.guard.counts.ignored + bench.guard.counts.refused == 2 * FLOOD


@pytest.mark.parametrize("key", [None, KEY])
def test_spoofed_commands_may_continue_the_stream(key):
    """Only a key distinguishes spoofed commands. Without a key, they act inside the limits of the guard."""
    bench = Networked(key).acting()
    moved = []
    for k in range(200):
        # Sequence and times of the sender's last command, plus a small increment.
        spoofed = stranger(bench, sequence=bench.sequence + 1 + k, utime=bench.utime - 10**15 + 1 + k)
        output = bench.round([spoofed])
        moved.append(np.abs(output.effort - 0.05 * LIMIT).max())
    counts = bench.guard.counts
    if key is None:
        assert max(moved) > 0.1
        return
    assert max(moved) == 0.0
    assert (counts.accepted, counts.refused, counts.ignored) == (460, 0, 200)
    assert bench.guard.ignored_code == Status.REFUSAL_NOT_AUTHENTIC


def test_replayed_authentic_commands_do_not_act():
    """Replayed commands are out of order, or stale if the sender is silent."""
    bench = Networked(KEY).acting()
    for _ in range(100):
        assert bench.round(bench.sent[-8:]).control_mode == Command.EFFORT
    accepted, sent = bench.guard.counts.accepted, bench.sent[-16:]
    assert accepted == 360
    for _ in range(300):
        bench.put(*sent)
        bench.inbox.deliver(bench.guard, bench.utime)
        bench.tick()
    assert (bench.guard.state, bench.guard.counts.accepted) == (Status.STATE_HOLD, accepted)
    assert bench.guard.refusal_code == Status.REFUSAL_STALE
    # They do not act in another session of the arm either.
    other = Networked(KEY)
    other.guard.session_id = SESSION + 1
    other.inbox = CommandInbox(other.guard, KEY)
    other.put(*sent)
    other.inbox.deliver(other.guard, other.utime)
    assert other.guard.ignored_code == Status.REFUSAL_WRONG_SESSION


@pytest.mark.parametrize("key", [None, KEY])
def test_hold_of_another_sender_acts_in_a_flood(key):
    bench = Networked(key).acting()
    flood = [stranger(bench, sender_id=1000 + k) for k in range(FLOOD)]
    hold = stranger(bench, sender_id=6, control_mode=Command.HOLD)
    assert bench.round([*flood, hold, *flood]).control_mode == (Command.HOLD if key is None else Command.EFFORT)
    signed = bench.good(control_mode=Command.HOLD, sender_id=6)
    bench.sequence -= 1
    assert bench.round([*flood, signed, *flood]).control_mode == Command.HOLD


@pytest.mark.parametrize("mode", [Command.HOLD, Command.POSITION, Command.EFFORT, Command.OFF])
def test_key_rejects_unknown_sender(mode):
    bench = Networked(KEY, modes=(Command.POSITION, Command.EFFORT, Command.OFF))
    for _ in range(300):
        bench.put(bench.command(mode, sender=9).encode(), MessageKey(bytes(32)).sign(bench.command(mode).encode()))
        bench.inbox.deliver(bench.guard, bench.utime)
        bench.tick()
    assert bench.guard.state == Status.STATE_HOLD
    assert (bench.guard.counts.accepted, bench.guard.counts.ignored) == (0, 600)


def test_fuzzed_bytes_of_a_signed_command_never_act():
    generator = np.random.default_rng(3)
    bench = Networked(KEY).acting()
    for k in range(2000):
        data = bytearray(bench.good(effort=list(LIMIT)))
        for _ in range(generator.integers(1, 8)):
            data[generator.integers(len(data))] ^= 1 << generator.integers(8)
        output = bench.round([bytes(data[: generator.integers(len(data) + 1)] if k % 3 == 0 else data)])
        assert output.control_mode == Command.EFFORT
        np.testing.assert_allclose(output.effort, 0.05 * LIMIT, atol=1e-12)


def test_sender_in_control_has_separate_capacity():
    bench = Networked()
    bench.inbox = CommandInbox(bench.guard, capacity=3)
    bench.put(*[bench.good() for _ in range(5)])
    bench.inbox.deliver(bench.guard, bench.utime)
    counts = bench.guard.counts
    # Only one command of a sender is accepted at one time, because its clock must advance.
    assert (counts.accepted, counts.refused, counts.ignored) == (1, 2, 2)
    assert bench.guard.ignored_code == Status.REFUSAL_FLOOD
    bench.tick()
    bench.put(*[stranger(bench, sender_id=6)] * 5, *[bench.good() for _ in range(5)])
    bench.inbox.deliver(bench.guard, bench.utime)
    assert (counts.accepted, counts.refused, counts.ignored) == (2, 4, 2 + 2 + 5)
