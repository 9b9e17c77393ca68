"""Round trip of `dvrk-drake run` over LCM at 1 kHz, status out to command back, beside a raw Python echo's.

    python benchmarks/lcm_round_trip.py [--seconds 60]

This process is the arm, the simulated one of `dvrk-drake arm`, and takes the time from when a status goes out to when
the command that answers it is heard. Its peers are processes of their own: `dvrk-drake run --mode hold`, and an echo
that decodes a status and encodes a command and does nothing else. Each is measured quiet, with a client of the arm's
Meshcat page, and with a busy process on every core; without and with real-time scheduling (`--realtime` of both verbs).

A tick without a fresh command is a status to which the arm had heard no answer when its next step began: it has a
period less its own step (0.3 ms on a quiet machine) for that, and nothing at all when it is late itself and catches up.
The echo's lines show how much of it is the arm and the machine.

It needs a multicast route:

    unshare -rn sh -c 'ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo;
                       exec python benchmarks/lcm_round_trip.py'

As root, `unshare -n`: the root of `unshare -r` has no right to real-time scheduling.
"""

import argparse
import base64
import contextlib
import os
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import lcm
import numpy as np
from pydrake.geometry import Meshcat

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.processes.lcm_network import open_lcm
from dvrk_drake.processes.pace import make_realtime, settle_memory
from dvrk_drake.processes.simulated_arm import SimulatedArm, start_pose
from dvrk_drake.systems.arm_view import start_meshcat
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver

ARM = load_arm("mtml")
CONDITIONS = ("quiet", "Meshcat client", "cores busy")
ENCODE = lcmt_dvrk_status.encode
RUN = ["-m", "dvrk_drake.cli", "run", "--arm", ARM.name.lower(), "--mode", "hold"]


class TimedArm(SimulatedArm):
    """The simulated arm, and when each status was out and the first command that answers it was heard [s]."""

    def __init__(self, meshcat: Meshcat | None) -> None:
        self.out: list[float] = []
        self.back: dict[int, float] = {}
        # A function, which a status binds; a bound method it would call without itself.
        lcmt_dvrk_status.encode = lambda status: self.encode(status)  # noqa: PLW0108
        super().__init__(ARM, DvrkDriver(), open_lcm(), start_pose(ARM), meshcat)

    def hear(self, channel: str, data: bytes) -> None:
        """As the arm does, noting when."""
        now = time.monotonic()
        super().hear(channel, data)
        sequence = lcmt_dvrk_command.decode(data).sequence
        if sequence == len(self.out) - 1:  # the last status; what answers an earlier one came too late
            self.back[sequence] = now

    def encode(self, status: lcmt_dvrk_status) -> bytes:
        """As every status, noting when: after publishing is too late, a woken peer may come first on this core."""
        self.out.append(time.monotonic())
        return ENCODE(status)

    def trips(self, begin: int) -> np.ndarray:
        """Round trips [s] of the statuses from `begin` on, NaN where no command was heard."""
        # The last one may still be on its way.
        return np.array([self.back.get(k, np.nan) - out for k, out in enumerate(self.out)][begin:-1])


def echo(realtime: bool) -> None:
    """The peer to compare with: decodes a status, encodes a HOLD command, nothing else."""
    if realtime:
        make_realtime()
    network = lcm.LCM()

    def answer(channel, data):
        status, command = lcmt_dvrk_status.decode(data), lcmt_dvrk_command()
        command.utime, command.sequence, command.sender_id = time.monotonic_ns() // 1000, status.sequence, 1
        command.status_utime, command.session_id = status.utime, status.session_id
        command.arm_name, command.num_joints = status.arm_name, status.num_joints
        command.control_mode = lcmt_dvrk_command.HOLD
        command.position, command.velocity, command.effort = status.position, status.velocity, status.effort_measured
        network.publish(f"DVRK_COMMAND_{ARM.name}", command.encode())

    network.subscribe(f"DVRK_STATUS_{ARM.name}", answer)
    while True:
        network.handle()


def watch(url: str) -> None:
    """A Meshcat client: a WebSocket that reads everything, as a browser does that has a GPU of its own to draw."""
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port)) as connection:
        key = base64.b64encode(secrets.token_bytes(16)).decode()
        connection.sendall(
            f"GET / HTTP/1.1\r\nHost: {address.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        while connection.recv(1 << 16):
            pass


@contextlib.contextmanager
def started(*arguments: str) -> Iterator[None]:
    """A Python process of these arguments that ends with the block."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def measure(peer: list[str], condition: str, seconds: float, realtime: bool) -> np.ndarray:
    """Round trips [s] of `peer` for so long, from 2 s after its commands act, NaN where none was heard in time."""
    meshcat = start_meshcat() if condition == "Meshcat client" else None
    arm = TimedArm(meshcat)
    settle_memory()
    load: list[list[str]] = []
    if condition == "cores busy":
        load = [["-c", "while True: pass"]] * (os.cpu_count() or 1)
    elif meshcat:
        load = [[__file__, "--watch", meshcat.ws_url()]]
    begins: list[int] = []

    def stopped() -> bool:
        acts = arm.guard.state == lcmt_dvrk_status.STATE_EFFORT or (peer != RUN and arm.back)
        if acts and not begins:
            begins.append(len(arm.out) + 2000)
        return bool(begins) and len(arm.out) > begins[0] + 1000 * seconds

    with contextlib.ExitStack() as stack:
        for arguments in [*load, [*peer, *(["--realtime"] if realtime else [])]]:
            stack.enter_context(started(*arguments))
        if realtime and (warning := make_realtime()):
            print(f"warning: {warning}")
        arm.run(stopped, lambda line: None)
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        if meshcat and meshcat.GetNumActiveConnections() != 1:
            raise SystemExit("the Meshcat client is not connected")
    return arm.trips(begins[0])


def report(name: str, trips: np.ndarray) -> float:
    """Prints the percentiles [us]; returns the median. A command that never came counts as one that came late."""
    p50, p99, p999 = 1e6 * np.percentile(np.nan_to_num(trips, nan=np.inf), [50, 99, 99.9], method="higher")
    missed = np.count_nonzero(np.isnan(trips))
    print(f"| {name:42} | {p50:6.0f} | {p99:6.0f} | {p999:6.0f} | {missed:4} of {len(trips)} |", end="", flush=True)
    return float(p50)


def main() -> None:
    """One table; the ratio is that of the medians."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0, help="for each line of the table")
    parser.add_argument("--condition", choices=CONDITIONS, help="only this one")
    parser.add_argument("--echo", action="store_true", help="be the echo")
    parser.add_argument("--realtime", action="store_true", help="of the echo")
    parser.add_argument("--watch", metavar="URL", help="be the Meshcat client")
    options = parser.parse_args()
    if options.watch:
        watch(options.watch)
    elif options.echo:
        echo(options.realtime)
    else:
        table(options.seconds, [options.condition] if options.condition else CONDITIONS)


def table(seconds: float, conditions: list[str]) -> None:
    """Measures and prints all lines."""
    print(f"load average at the start: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores")
    print(f"| {'round trip [us]':42} |    p50 |    p99 |  p99.9 | without a fresh command | ratio |")
    print("|---|---|---|---|---|---|")
    for condition in conditions:
        for realtime in (False, True):
            name = f"{condition}, real-time" if realtime else condition
            raw = report(f"echo, {name}", measure([__file__, "--echo"], condition, seconds, realtime))
            print("  1.00 |")
            ours = report(f"dvrk-drake run, {name}", measure(RUN, condition, seconds, realtime))
            print(f" {ours / raw:5.2f} |")


if __name__ == "__main__":
    main()
