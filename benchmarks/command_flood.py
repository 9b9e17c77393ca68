"""Measures the step rate of a simulated arm, and the effect of its controller, while its command channel is flooded.

    python benchmarks/command_flood.py [--seconds 5] [--kinds garbage,session,...] [--no-key]

`dvrk-drake sim-arm` runs at 1 kHz. A small controller sends an effort command for each status. A third process
publishes foreign messages on the command channel as fast as possible. The benchmark measures without and with this
flood, for each kind of message:

    garbage     300 random bytes
    session     a valid command of another session
    sender      a valid command of another sender
    copy        a valid command with the controller's sender id and a much higher sequence number

Columns of the table:

    flood       foreign messages per second
    rate        steps of the arm per second of wall-clock time
    ratio       rate divided by the rate without the flood
    acting      share of the statuses in which the controller's efforts act
    expired     number of expirations of the efforts; the guard resumes automatically in this benchmark
    accepted    accepted commands per second
    ignored     ignored and refused commands per second

The arm and the controller use real-time scheduling if the system permits it. The measuring and the flooding process do
not: on two cores, they would suspend each other.

The benchmark requires a multicast route:

    unshare -rn sh -c 'ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo;
                       exec python benchmarks/command_flood.py'

As root, use `unshare -n`. A root user made by `unshare -r` is not permitted to use real-time scheduling.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import lcm
import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import MessageKey, command_channel, create_key_file, status_channel
from dvrk_drake.processes.pace import make_realtime
from dvrk_drake.systems.lcm.messages import handle_message

ARM = load_arm("mtml")
KINDS = ("garbage", "session", "sender", "copy")
SENDER, OTHER = 5, 6


def answer_to(status: lcmt_dvrk_status, effort: list[float]) -> lcmt_dvrk_command:
    """Returns a valid command with `effort` (n,) [N m, N] for a received status."""
    command = lcmt_dvrk_command()
    command.utime, command.sequence, command.sender_id = time.monotonic_ns() // 1000, status.sequence, SENDER
    command.status_utime, command.session_id = status.utime, status.session_id
    command.arm_name, command.num_joints = status.arm_name, status.num_joints
    command.control_mode = lcmt_dvrk_command.EFFORT
    command.position, command.velocity, command.effort = [0.0] * status.num_joints, [0.0] * status.num_joints, effort
    return command


def control(file: Path | None) -> None:
    """Regulates the pose of the first received status until the process ends. Signs with the key in `file`, if any."""
    key = MessageKey.load(file) if file else None
    make_realtime()
    network, held = lcm.LCM(), []
    kp, kd = np.array(ARM.gains.kp), np.array(ARM.gains.kd)

    def answer(channel, data):
        status = lcmt_dvrk_status.decode(data)
        q, v = np.array(status.position), np.array(status.velocity)
        if not held:
            held.extend([q, np.array(status.effort_measured)])
        data = answer_to(status, (held[1] + kp * (held[0] - q) - kd * v).tolist()).encode()
        network.publish(command_channel(ARM), key.sign(data) if key else data)

    network.subscribe(status_channel(ARM), answer)
    while True:
        network.handle()


def flood(kind: str, data: bytes, count: multiprocessing.Value) -> None:
    """Publishes a message repeatedly as fast as possible until the process ends; writes the number to `count`."""
    network = lcm.LCM()
    status = lcmt_dvrk_status.decode(data)
    command = answer_to(status, [0.0] * status.num_joints)
    if kind == "session":
        command.session_id += 1
    elif kind == "sender":
        command.sender_id = OTHER
    elif kind == "copy":
        command.sequence = 2**62
    message = os.urandom(300) if kind == "garbage" else command.encode()
    channel = command_channel(ARM)
    while True:
        for _ in range(100):
            network.publish(channel, message)
        count.value += 100


class Observer:
    """Receives the statuses of the arm and stores their guard states."""

    def __init__(self) -> None:
        self.network, self.data = lcm.LCM(), lcmt_dvrk_status().encode()
        self.network.subscribe(status_channel(ARM), self.receive).set_queue_capacity(0)
        self.states: list[int] = []

    def receive(self, channel: str, data: bytes) -> None:
        """Stores a status."""
        self.data = data
        self.states.append(lcmt_dvrk_status.decode(data).guard_state)

    def listen(self, seconds: float) -> tuple[lcmt_dvrk_status, float]:
        """Receives statuses for `seconds`; returns the last status and the current time [s]."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            handle_message(self.network, left)
        return lcmt_dvrk_status.decode(self.data), time.monotonic()


@contextlib.contextmanager
def running(target, *arguments) -> Iterator[multiprocessing.Process]:
    """Runs `target` in a process that ends with the block."""
    process = multiprocessing.Process(target=target, args=arguments, daemon=True)
    process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def measure(observer: Observer, seconds: float) -> dict[str, float]:
    """Returns the measured columns of the table, see the module."""
    observer.listen(0.5)
    observer.states.clear()
    before, begin = observer.listen(0.02)
    after, end = observer.listen(seconds)
    acting = np.mean(np.array(observer.states) == lcmt_dvrk_status.STATE_EFFORT)
    return {
        "rate": (after.sequence - before.sequence) / (end - begin),
        "acting": float(acting),
        "expired": after.num_expired - before.num_expired,
        "accepted": (after.num_accepted - before.num_accepted) / (end - begin),
        "ignored": (after.num_ignored + after.num_refused - before.num_ignored - before.num_refused) / (end - begin),
    }


def main() -> None:
    """Prints two rows per kind of flood: without and with the flood."""
    parser = argparse.ArgumentParser(
        description="Measures the rate of a simulated arm while its command channel is flooded."
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="duration of each measurement [s]; default: 5")
    parser.add_argument("--kinds", default=",".join(KINDS), help="kinds of flood, separated by commas; default: all")
    parser.add_argument("--no-key", action="store_true", help="do not authenticate messages")
    options = parser.parse_args()
    multiprocessing.set_start_method("spawn")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "a.key"
        create_key_file(file)
        key = [] if options.no_key else ["--key", file]
        driver = Path(folder) / "driver.yaml"
        driver.write_text("guard: {resume_automatically: true}\n")
        command = [
            sys.executable,
            "-m",
            "dvrk_drake.cli",
            "arm",
            "--arm",
            "mtml",
            "--realtime",
            "--driver",
            driver,
            *key,
        ]
        arm = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            run(None if options.no_key else file, options)
        finally:
            arm.kill()
            arm.wait()


def run(file: Path | None, options: argparse.Namespace) -> None:
    """Measures all kinds of flood and prints the table. `file` contains the key, or is None for no key."""
    observer = Observer()
    while not observer.listen(0.1)[0].session_id:
        pass
    names = ("flood [Hz]", "rate [Hz]", "ratio", "acting", "expired", "accepted [Hz]", "ignored [Hz]")
    print(f"{'kind':10}" + "".join(f"{name:>14}" for name in names))
    with running(control, file):
        deadline = time.monotonic() + 30
        while observer.listen(0.2)[0].guard_state != lcmt_dvrk_status.STATE_EFFORT and time.monotonic() < deadline:
            pass
        for kind in options.kinds.split(","):
            alone = measure(observer, options.seconds)
            count = multiprocessing.Value("q", 0)
            with running(flood, kind, observer.data, count):
                while not count.value:
                    time.sleep(0.05)
                first, begin = count.value, time.monotonic()
                flooded = measure(observer, options.seconds)
                rate = (count.value - first) / (time.monotonic() - begin)
            for name, hertz, row in (("-", 0.0, alone), (kind, rate, flooded)):
                print(
                    f"{name:10}{hertz:14.0f}{row['rate']:14.1f}{row['rate'] / alone['rate']:14.3f}{row['acting']:14.3f}"
                    f"{row['expired']:14.0f}{row['accepted']:14.0f}{row['ignored']:14.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
