"""Measures the time from a measurement of a dVRK to the effort that answers it, through the bridge.

    python benchmarks/crtk_latency.py [--seconds 20] [--realtime]

This process plays the arm: it publishes `measured_js` at 1 kHz and receives `servo_jf`. The position and the effort of
the last joint contain the number of the measurement. These paths are measured in one run, one after the other:

    echo of cyclonedds   a process that answers each JointState message with another one; encoder of cyclonedds
    echo                 the same with the encoder of this package
    controller on LCM    without DDS: this process publishes the status, and the controller answers it over LCM
    bridge               `dvrk-drake bridge`, and the same controller
    polling bridge       the same with --poll

The table lists the round-trip times, the largest interval between two measurements, and the measurements without an
answer. The nominal interval is 1 ms. A much larger interval shows that the system suspended this process. The counters
of the guard are printed below: commands that LCM lost, and commands that the guard refused.

The benchmark requires a network namespace and multicast:

    unshare -n sh -c 'ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo;
                      exec python benchmarks/crtk_latency.py --realtime'

Without root, use `unshare -rn`. A root user made by `unshare -r` is not permitted to use real-time scheduling.
"""

import argparse
import multiprocessing
import os
import select
import sys
import tempfile
import time
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import lcm
import numpy as np
from cyclonedds.idl import IdlStruct
from effort_controller import LENIENT_DRIVER, effort_command
from ros_publisher import DOMAIN_FILE

from dvrk_drake import cli
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.processes.pace import Pace, make_realtime
from dvrk_drake.systems.lcm.messages import draw_id, handle_message
from dvrk_drake.systems.ros.domain import RosDomain
from dvrk_drake.systems.ros.messages import Empty, Header, JointState, OperatingState

ARM = load_arm("mtml")
N, NAMES = ARM.num_joints, list(ARM.joint_names)
#: Numbers of measurements from 0 to 999 are sent as multiples of this position [rad] and effort [N m].
UNIT, CYCLE = 1e-6, 1000
#: Time until the controller runs [s].
START = 3.0


def number(value: float) -> int:
    """Returns the number of a measurement that a position or an effort contains."""
    return round(value / UNIT)


def echo(namespace: str, realtime: bool, plain: bool) -> None:
    """Answers each measurement with an effort."""
    if realtime:
        make_realtime()
    if plain:
        JointState.serialize, JointState.deserialize = IdlStruct.serialize, classmethod(IdlStruct.deserialize.__func__)
    domain = RosDomain(0)
    measured = domain.subscribe(f"{namespace}/measured_js", JointState, depth=100)
    answer = domain.advertise(f"{namespace}/servo_jf", JointState)
    while True:
        domain.wait(1.0)
        for message, _ in measured.take():
            answer.publish(JointState(Header.now(), effort=[0.0] * (N - 1) + message.position[-1:]))


def controller(realtime: bool) -> None:
    """Answers each status with an effort over LCM."""
    if realtime:
        make_realtime()
    network, sender_id, sequence = lcm.LCM(), draw_id(), 0

    def answer(channel: str, data: bytes) -> None:
        nonlocal sequence
        sequence += 1
        status = lcmt_dvrk_status.decode(data)
        command = effort_command(status, [0.0] * (N - 1) + [status.position[-1]], sender_id, sequence)
        network.publish(command_channel(ARM), command.encode())

    network.subscribe(status_channel(ARM), answer)
    while True:
        network.handle()


def bridge(folder: str, realtime: bool, poll: bool) -> None:
    """Runs the bridge with a guard that tolerates an arm without efforts."""
    driver = Path(folder, "driver.yaml")
    driver.write_text(LENIENT_DRIVER)
    options = [option for option, used in (("--realtime", realtime), ("--poll", poll)) if used]
    cli.main(["bridge", "--arm", "mtml", "--driver", str(driver), *options])


class Arm:
    """Arm at rest on ROS 2, which measures the time until its measurements are answered."""

    def __init__(self, domain: RosDomain, namespace: str) -> None:
        self._domain = domain
        self._measured = domain.advertise(f"{namespace}/measured_js", JointState)
        state = domain.advertise(f"{namespace}/operating_state", OperatingState, latched=True)
        state.publish(OperatingState(Header.now(), "ENABLED", True, False))
        self._gravity = domain.advertise(f"{namespace}/gravity_compensation/setpoint_js", JointState)
        self._effort = domain.subscribe(f"{namespace}/servo_jf", JointState, depth=100)
        self._others = [
            domain.subscribe(f"{namespace}/{name}", kind) for name, kind in (("servo_jp", JointState), ("hold", Empty))
        ]
        self._keep = state
        self.sent: list[float] = []
        self.answered: dict[int, float] = {}

    def run(self, seconds: float, needs_answer: bool) -> None:
        """Publishes measurements at 1 kHz. The time counts from the first answer if `needs_answer`."""
        end = time.monotonic() + seconds

        def listen(duration: float) -> None:
            until = time.monotonic() + duration
            while (left := until - time.monotonic()) > 0:
                self._domain.wait(left)
                self._receive()

        pace = Pace(1e-3, sleep=listen)
        while time.monotonic() < end:
            pace.wait()
            k = len(self.sent)
            position = [0.0] * (N - 1) + [UNIT * (k % CYCLE)]
            self.sent.append(time.monotonic())
            self._measured.publish(JointState(Header.now(), NAMES, position, [0.0] * N, [0.0] * N))
            if k % 100 == 0:
                self._gravity.publish(JointState(Header.now(), NAMES, [], [], [0.0] * N))
                for subscription in self._others:
                    subscription.take()
            if needs_answer and not self.answered:
                end = time.monotonic() + seconds

    def _receive(self) -> None:
        now, last = time.monotonic(), len(self.sent) - 1
        for message, _ in self._effort.take():
            # An answer is at most a few hundred periods old.
            k = last - (last - number(message.effort[-1])) % CYCLE
            if k >= 0:
                self.answered.setdefault(k, now)

    def num_lost(self) -> int:
        """Returns the number of efforts that DDS has lost."""
        return self._effort.num_lost

    def trips(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns times of sending and round-trip times [s] from the first to the last answer, NaN for no answer."""
        # During the first second, the bridge starts commands.
        numbers = range(min(self.answered) + 1000, max(self.answered) + 1)
        sent = np.array([self.sent[k] for k in numbers])
        return sent, np.array([self.answered.get(k, np.nan) for k in numbers]) - sent


def start(*mains: tuple[Any, ...]) -> list[BaseProcess]:
    """Starts one process for each (function, *arguments)."""
    context = multiprocessing.get_context("spawn")
    processes: list[BaseProcess] = [context.Process(target=main, args=arguments) for main, *arguments in mains]
    for process in processes:
        process.start()
    return processes


def end(processes: list[BaseProcess]) -> None:
    """Ends processes. A bridge first holds the arm and ends its deadman process."""
    for process in processes:
        process.terminate()
        process.join()


def guard_counters() -> str:
    """Returns the numbers of commands in the last status of the bridge."""
    network, found = lcm.LCM(), []
    network.subscribe(status_channel(ARM), lambda channel, data: found.append(lcmt_dvrk_status.decode(data)))
    while not found and select.select([network.fileno()], [], [], 5.0)[0]:
        network.handle()
    return ", ".join(f"{getattr(found[-1], f'num_{name}')} {name}" for name in ("accepted", "lost", "refused"))


def measure(name: str, seconds: float, realtime: bool, folder: str) -> tuple[np.ndarray, np.ndarray]:
    """Measures one path over DDS. Returns times of sending and round-trip times [s]."""
    is_bridge = name.endswith("bridge")
    domain, namespace = RosDomain(0), "/MTML" if is_bridge else f"/ECHO_{name[-3:].strip().upper()}"
    arm = Arm(domain, namespace)
    if is_bridge:
        processes = start((bridge, folder, realtime, name != "bridge"), (controller, realtime))
    else:
        processes = start((echo, namespace, realtime, name != "echo"))
    try:
        arm.run(seconds, needs_answer=True)
        if is_bridge:
            lost = f"lost on DDS: {arm.num_lost()} efforts; guard: {guard_counters()} commands"
            print(lost, file=sys.stderr, flush=True)
    finally:
        end(processes)
    return arm.trips()


def measure_lcm(seconds: float, realtime: bool) -> tuple[np.ndarray, np.ndarray]:
    """Measures the path to the controller over LCM. Returns times of sending and round-trip times [s], NaN if lost."""
    network, trips = lcm.LCM(), []
    network.subscribe(command_channel(ARM), lambda channel, data: trips.append(lcmt_dvrk_command.decode(data).utime))
    status = lcmt_dvrk_status()
    status.arm_name, status.num_joints = ARM.name, N
    for name in ("position", "velocity", "effort_measured", "position_commanded", "effort_commanded", "joint_flags"):
        setattr(status, name, [0] * N)
    processes = start((controller, realtime))
    pace, end_time = Pace(1e-3), time.monotonic() + START + seconds
    sent: list[float] = []
    times: list[float] = []
    try:
        while time.monotonic() < end_time:
            pace.wait()
            count, begin = len(trips), time.monotonic()
            network.publish(status_channel(ARM), status.encode())
            handle_message(network, 5e-3)
            sent.append(begin)
            times.append(time.monotonic() - begin if len(trips) > count else np.nan)
    finally:
        end(processes)
    first = int(np.flatnonzero(np.isfinite(times))[0]) + 1000
    return np.array(sent[first:]), np.array(times[first:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--realtime", action="store_true")
    options = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", DOMAIN_FILE)
    if options.realtime:
        for warning in make_realtime():
            print(warning, file=sys.stderr)
    scheduling = "real-time" if options.realtime else "normal"
    columns = ("p50 [ms]", "p99 [ms]", "p99.9 [ms]", "max [ms]", "largest interval between measurements [ms]")
    print(f"| {scheduling} scheduling | {' | '.join(columns)} | without answer | p50 / echo |")
    print("|---|---|---|---|---|---|---|---|")
    p50 = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("echo of cyclonedds", "echo", "controller on LCM", "bridge", "polling bridge"):
            if name == "controller on LCM":
                sent, trips = measure_lcm(options.seconds, options.realtime)
            else:
                sent, trips = measure(name, options.seconds, options.realtime, folder)
            valid = 1e3 * trips[np.isfinite(trips)]
            quantiles = np.quantile(valid, [0.5, 0.99, 0.999, 1.0])
            p50[name] = quantiles[0]
            numbers = " | ".join(f"{x:.2f}" for x in (*quantiles, 1e3 * np.diff(sent).max()))
            lost = f"{len(trips) - len(valid)} of {len(trips)}"
            print(f"| {name} | {numbers} | {lost} | {quantiles[0] / p50['echo of cyclonedds']:.2f} |", flush=True)


if __name__ == "__main__":
    main()
