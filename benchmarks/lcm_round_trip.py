"""Measures the round-trip time of `dvrk-drake control` over LCM at 1 kHz, in comparison with a minimal Python echo.

    python benchmarks/lcm_round_trip.py [--seconds 60]

The process of the arm measures the time from sending a status to receiving the command that answers it. There are two
arms:

    standing    bridge that sends the messages of a driver at 1 kHz without physics, to time the controller
    simulated   arm of `dvrk-drake sim-arm`, which receives a command after it has computed its next state

The controllers are separate processes: `dvrk-drake control --mode hold`, and an echo, which only decodes a status and
encodes a command. Each controller is measured under three conditions: on an otherwise idle computer, with `dvrk-drake
view --live` and a client of its page, or with a busy process on every core. Each condition is measured without and with
real-time scheduling (`--realtime`). With real-time scheduling, arm and controller have one core each.

The column "no fresh command" is the number of periods in which no command for the last status arrived. The rows of the
echo show how often the computer itself causes such periods.

The benchmark requires a multicast route:

    unshare -rn sh -c 'ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo;
                       exec python benchmarks/lcm_round_trip.py'

As root, use `unshare -n`. A root user made by `unshare -r` is not permitted to use real-time scheduling.
"""

import argparse
import base64
import contextlib
import itertools
import multiprocessing
import os
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor

import lcm
import numpy as np

from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.processes.pace import Pace, make_realtime, settle_memory
from dvrk_drake.processes.simulated_arm import SimulatedArm, start_pose
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.lcm.messages import handle_message, listen, usable_lcm_url

ARM = load_arm("mtml")
ARMS = ("standing", "simulated")
SCHEDULINGS = {"normal": False, "real-time": True}
CONDITIONS = ("quiet", "Meshcat client", "cores busy")
RUN = ["-m", "dvrk_drake.cli", "control", "--arm", ARM.name.lower(), "--mode", "hold"]


class Times:
    """Times at which statuses were sent, and at which their first answers were received [s]."""

    def __init__(self) -> None:
        self.sent: list[float] = []
        self.answered: dict[int, float] = {}

    def start_trip(self) -> None:
        """Stores the current time. Call this before publishing, since publishing may let another process run first."""
        self.sent.append(time.monotonic())

    def store_answer(self, data: bytes, first: int) -> lcmt_dvrk_command:
        """Decodes a command; stores the time if it answers the last status. `first` is the first sequence number."""
        now, command = time.monotonic(), lcmt_dvrk_command.decode(data)
        if command.sequence == first + len(self.sent) - 1:
            self.answered.setdefault(len(self.sent) - 1, now)
        return command

    def trips(self, begin: int) -> np.ndarray:
        """Returns the round-trip times [s] from status number `begin` on, NaN for a status without an answer."""
        # The answer to the last status may not have arrived yet.
        return np.array([self.answered.get(k, np.nan) - sent for k, sent in enumerate(self.sent)][begin:-1])


class StandingArm:
    """Bridge of an arm at rest, which exchanges the messages of a driver at 1 kHz without physics."""

    def __init__(self) -> None:
        self.times = Times()
        self.sender_id = 0
        q = start_pose(ARM).tolist()
        none = [0.0] * ARM.num_joints
        self.status = lcmt_dvrk_status()
        self.status.session_id, self.status.arm_name, self.status.num_joints = secrets.randbits(62), ARM.name, len(q)
        self.status.position, self.status.velocity, self.status.position_commanded = q, none, q
        self.status.effort_measured, self.status.effort_commanded = none, none
        self.status.joint_flags = [0] * len(q)
        self.status.guard_state = lcmt_dvrk_status.STATE_HOLD
        self.status.accepted_modes = 1 << lcmt_dvrk_command.EFFORT | 1 << lcmt_dvrk_command.HOLD

    @property
    def acts(self) -> bool:
        """Returns whether commands act."""
        return self.sender_id != 0

    def run(self, stopped: Callable[[], bool]) -> None:
        """Sends a status every millisecond of wall-clock time until `stopped`."""
        network = lcm.LCM()
        network.subscribe(command_channel(ARM), self.receive)
        pace = Pace(1e-3, sleep=lambda seconds: listen(network, seconds))
        begin = time.time_ns() // 1000
        while not stopped():
            pace.wait()
            while handle_message(network, 0.0):
                pass
            self.status.sequence = len(self.times.sent)
            self.status.utime = begin + 1000 * self.status.sequence
            self.times.start_trip()
            network.publish(status_channel(ARM), self.status.encode())

    def receive(self, channel: str, data: bytes) -> None:
        """Receives a command; the next statuses report it as the accepted command."""
        command = self.times.store_answer(data, first=0)
        self.sender_id = command.sender_id
        self.status.command_sender_id, self.status.command_sequence = command.sender_id, command.sequence
        self.status.command_utime, self.status.guard_state = command.utime, lcmt_dvrk_status.STATE_EFFORT


class TimedSimulatedArm(SimulatedArm):
    """Simulated arm of `dvrk-drake sim-arm` that stores the times of its messages."""

    def __init__(self) -> None:
        self.times, self.first = Times(), 0
        super().__init__(ARM, DvrkDriver(lcm_url=usable_lcm_url()), start_pose(ARM))

    @property
    def acts(self) -> bool:
        """Returns whether commands act. The echo sends no efforts, so for the echo any answer is enough."""
        return self.guard.state == lcmt_dvrk_status.STATE_EFFORT or bool(self.times.answered)

    def receive(self, channel: str, data: bytes) -> None:
        """Stores the time, then receives a command."""
        self.times.store_answer(data, self.first)
        super().receive(channel, data)

    def send(self, network: lcm.LCM) -> None:
        """Stores the time, then sends a status."""
        if not self.times.sent:
            # The first statuses of the arm are not published.
            self.first = lcmt_dvrk_status.decode(self._status).sequence
        self.times.start_trip()
        super().send(network)


def echo(realtime: bool) -> None:
    """Answers each status with a HOLD command, without any other computation."""
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


def watch(port: int) -> None:
    """Receives all data of a Meshcat server over a WebSocket, like a browser, but without drawing."""
    while True:
        with contextlib.suppress(ConnectionRefusedError), socket.create_connection(("localhost", port)) as connection:
            key = base64.b64encode(secrets.token_bytes(16)).decode()
            connection.sendall(
                f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
            )
            for received in itertools.count(1):
                for _ in range(10):
                    if not connection.recv(1 << 10, socket.MSG_WAITALL):
                        return
                print(10 * received, "KB", flush=True)
        time.sleep(0.1)


def free_port() -> int:
    """Returns a free TCP port."""
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        return listener.getsockname()[1]


@contextlib.contextmanager
def started(*arguments: str, stdout: int = subprocess.DEVNULL) -> Iterator[subprocess.Popen]:
    """Runs Python with these arguments in a process that ends with the block."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=stdout)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def measure(peer: list[str], simulated: bool, condition: str, seconds: float, realtime: bool) -> np.ndarray:
    """Calls `run_arm` in a separate process, since real-time scheduling cannot be disabled again."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        return process.submit(run_arm, peer, simulated, condition, seconds, realtime).result()


def run_arm(peer: list[str], simulated: bool, condition: str, seconds: float, realtime: bool) -> np.ndarray:
    """Runs an arm and a controller; returns the round-trip times [s], NaN for a status without an answer in time.

    Args:
        peer: Arguments of Python for the process of the controller.
        simulated: True for the simulated arm, False for the standing arm.
        condition: Additional load, one of `CONDITIONS`.
        seconds: Duration of the measurement [s], which starts 2 s after commands first act.
        realtime: True for real-time scheduling.
    """
    arm = TimedSimulatedArm() if simulated else StandingArm()
    settle_memory()
    load: list[list[str]] = []
    if condition == "cores busy":
        load = [["-c", "while True: pass"]] * (os.cpu_count() or 1)
    port = str(free_port())
    if condition == "Meshcat client":
        load = [["-m", "dvrk_drake.cli", "view", "--arm", ARM.name.lower(), "--live", "--port", port]]
    begins: list[int] = []
    times = arm.times

    def stopped() -> bool:
        if not begins and arm.acts:
            begins.append(len(times.sent) + 2000)
        return bool(begins) and len(times.sent) > begins[0] + 1000 * seconds

    cores = os.sched_getaffinity(0)
    with contextlib.ExitStack() as stack:
        for arguments in load:
            stack.enter_context(started(*arguments))
        client = None
        if condition == "Meshcat client":
            client = stack.enter_context(started(__file__, "--watch", port, stdout=subprocess.PIPE))
        if realtime:
            # The process of the controller inherits this core.
            os.sched_setaffinity(0, {max(cores)})
        stack.enter_context(started(*peer, *(["--realtime"] if realtime else [])))
        if realtime:
            os.sched_setaffinity(0, {min(cores)})
            for warning in make_realtime():
                print(f"warning: {warning}")
        arm.run(stopped)
        if client:
            client.kill()
            if not client.communicate()[0]:
                raise SystemExit("The Meshcat client received no data.")
    return times.trips(begins[0])


def report(name: str, trips: np.ndarray) -> float:
    """Prints the percentiles [us] and returns the median. A missing answer counts as an infinite time."""
    p50, p99, p999 = 1e6 * np.percentile(np.nan_to_num(trips, nan=np.inf), [50, 99, 99.9], method="higher")
    missed = np.count_nonzero(np.isnan(trips))
    print(f"| {name:58} | {p50:6.0f} | {p99:6.0f} | {p999:6.0f} | {missed:4} of {len(trips)} |", end="", flush=True)
    return float(p50)


def main() -> None:
    """Prints the table. The ratio in the table is the median divided by the median of the echo."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of each measurement [s]; default: 60")
    parser.add_argument("--arm", choices=ARMS, help="measure only this arm")
    parser.add_argument("--condition", choices=CONDITIONS, help="measure only this condition")
    parser.add_argument("--scheduling", choices=SCHEDULINGS, help="measure only this kind of scheduling")
    parser.add_argument("--echo", action="store_true", help="run the echo; used internally")
    parser.add_argument("--realtime", action="store_true", help="use real-time scheduling for the echo")
    parser.add_argument("--watch", type=int, metavar="PORT", help="run a client of Meshcat; used internally")
    options = parser.parse_args()
    if options.watch:
        watch(options.watch)
    elif options.echo:
        echo(options.realtime)
    else:
        table(options)


def table(options: argparse.Namespace) -> None:
    """Measures all selected conditions and prints one row for each controller."""
    print(f"load average at the start: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores")
    print(f"| {'round trip [us]':58} |    p50 |    p99 |  p99.9 | no fresh command | ratio to echo |")
    print("|---|---|---|---|---|---|")
    for arm in ARMS if options.arm is None else [options.arm]:
        for condition in CONDITIONS if options.condition is None else [options.condition]:
            for scheduling in SCHEDULINGS if options.scheduling is None else [options.scheduling]:
                name, realtime = f"{arm} arm, {condition}, {scheduling}", SCHEDULINGS[scheduling]
                simulated = arm == "simulated"
                reference = report(
                    f"{name}: echo", measure([__file__, "--echo"], simulated, condition, options.seconds, realtime)
                )
                print("  1.00 |")
                ours = report(
                    f"{name}: dvrk-drake control", measure(RUN, simulated, condition, options.seconds, realtime)
                )
                print(f" {ours / reference:5.2f} |")


if __name__ == "__main__":
    main()
