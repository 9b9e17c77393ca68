"""Measures the time from `kill -9` of a controller until the guard of the simulated arm holds the arm, over LCM.

    python benchmarks/kill_controller.py [--kills 10] [--realtime]

The script starts the arm of `dvrk-drake sim-arm` and `dvrk-drake control --mode hold` as separate processes. It kills
the controller after its efforts have acted for 0.3 s to 0.6 s. Then it starts a new controller with `control --reset`
for the next kill. The script measures on an otherwise idle computer, and with two busy processes.

The measurement starts just before the call that sends the signal. It ends at the clock time of the step in which the
guard changed to HOLD. All processes use the same monotonic clock. Therefore the result does not include delays of the
network or of a measuring process.

A busy computer may suspend the controller for longer than its command is valid. The watchdog then holds the arm before
the kill. The script counts such an attempt and repeats it.

The benchmark requires a multicast route:

    unshare -rn sh -c 'ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo;
                       exec python benchmarks/kill_controller.py'

As root, use `unshare -n`. A root user made by `unshare -r` is not permitted to use real-time scheduling.
"""

import argparse
import contextlib
import multiprocessing
import os
import queue
import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from typing import IO

from dvrk_drake import cli
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.lcm_messages import describe_state
from dvrk_drake.processes.arm_controller import ArmController
from dvrk_drake.processes.pace import make_realtime, settle_memory
from dvrk_drake.processes.simulated_arm import SimulatedArm, monotonic_utime, start_pose, stop_on_signals
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.lcm.messages import usable_lcm_url

CONDITIONS = {"alone": 0, "two busy processes": 2}
#: Minimum and maximum time for which efforts act before the kill [s].
ACTING = (0.3, 0.6)
#: Maximum number of watchdog holds before the kill.
MAX_EARLY_HOLDS = 50
EFFORT = describe_state(lcmt_dvrk_status.STATE_EFFORT)
HOLD = describe_state(lcmt_dvrk_status.STATE_HOLD)


class Arm:
    """Reader of the state changes that the process of an arm prints."""

    def __init__(self, stream: IO[str]) -> None:
        self._changes: queue.Queue[tuple[int, str]] = queue.Queue()
        threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def _read(self, stream: IO[str]) -> None:
        for line in stream:
            time_ns, _, state = line.strip().partition(" ")
            self._changes.put((int(time_ns), state))

    def until(self, state: str, seconds: float, process: BaseProcess | None = None) -> tuple[int, str] | None:
        """Waits for a state change.

        Returns:
            Time [ns] and text of the next state that starts with `state`, or None if there is none within `seconds` or
            until `process` ends.
        """
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and (process is None or process.is_alive()):
            with contextlib.suppress(queue.Empty):
                change = self._changes.get(timeout=min(left, 0.1))
                if change[1].startswith(state):
                    return change
        return None


def run_arm(name: str, realtime: bool) -> None:
    """Runs an arm like `dvrk-drake sim-arm`; prints state changes with the last clock reading of the guard [ns]."""
    arm = load_arm(name)
    read = [0]

    def clock() -> int:
        read[0] = monotonic_utime()
        return read[0]

    simulated = SimulatedArm(arm, DvrkDriver(lcm_url=usable_lcm_url()), start_pose(arm), clock)
    stopped = stop_on_signals()
    if realtime:
        for warning in make_realtime():
            print(f"warning: {warning}", file=sys.stderr)
    settle_memory()

    def print_change(line: str) -> None:
        print(1000 * read[0], line.partition(" s  ")[2], flush=True)

    simulated.run(stopped, print_change)


def run_controller(arguments: list[str]) -> None:
    """Runs `dvrk-drake` with these arguments and without output, in a forked process with a compiled controller."""
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    sys.exit(cli.main(arguments))


@contextlib.contextmanager
def started(*arguments: str, stdout: int = subprocess.DEVNULL) -> Iterator[subprocess.Popen]:
    """Runs Python with these arguments in a process that ends with the block."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=stdout, stderr=subprocess.DEVNULL, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def measure(name: str, kills: int, busy: int, realtime: bool) -> tuple[list[float], list[str], int]:
    """Returns the times from the kill to HOLD [s], the reasons of the guard, and the number of holds before a kill."""
    options = ["--realtime"] if realtime else []
    run = ["control", "--arm", name, "--mode", "hold", "--reset", *options]
    forkserver = multiprocessing.get_context("forkserver")
    times: list[float] = []
    reasons: list[str] = []
    early_holds = 0
    with contextlib.ExitStack() as stack:
        process = stack.enter_context(started(__file__, "--run-arm", "--arm", name, *options, stdout=subprocess.PIPE))
        arm = Arm(process.stdout)  # type: ignore[arg-type]
        for _ in range(busy):
            stack.enter_context(started("-c", "while True: pass"))
        while len(times) < kills:
            controller = forkserver.Process(target=run_controller, args=(run,), daemon=True)
            controller.start()
            acts = arm.until(EFFORT, 60.0, controller)
            if acts is None or arm.until(HOLD, random.uniform(*ACTING)):
                early_holds += 1
                print("The watchdog held the arm before the kill. Repeating.", file=sys.stderr, flush=True)
                controller.kill()
                controller.join()
                if process.poll() is not None or early_holds > MAX_EARLY_HOLDS:
                    raise SystemExit("The controller's efforts do not act for long enough. Stop other programs.")
                continue
            kill_time = time.monotonic_ns()
            controller.kill()
            held = arm.until(HOLD, 10.0)
            controller.join()
            if held is None:
                raise SystemExit("The arm did not hold within 10 s.")
            times.append(1e-9 * (held[0] - kill_time))
            reasons.append(held[1])
            print(f"kill {len(times)}: {1e3 * times[-1]:.1f} ms, {held[1]}", file=sys.stderr, flush=True)
    return times, reasons, early_holds


def main() -> None:
    """Prints one row per condition."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=10, help="number of kills per condition; default: 10")
    parser.add_argument("--arm", default="mtml", help="name of the arm; default: mtml")
    parser.add_argument("--condition", choices=CONDITIONS, help="measure only this condition")
    parser.add_argument("--realtime", action="store_true", help="use real-time scheduling for arm and controller")
    parser.add_argument("--run-arm", action="store_true", help="run the process of the arm; used internally")
    options = parser.parse_args()
    if options.run_arm:
        run_arm(options.arm, options.realtime)
        return
    print(f"load average at the start: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores")
    print(f"{options.arm}, {'real-time' if options.realtime else 'normal'} scheduling: time from kill -9 to HOLD [ms]")
    print(f"| {'condition':20} | kills | p50 | max | detected by the wall clock | held before the kill |")
    print("|---|---|---|---|---|---|")
    for condition, busy in CONDITIONS.items():
        if options.condition in (None, condition):
            times, reasons, early_holds = measure(options.arm, options.kills, busy, options.realtime)
            p50, by_wall = sorted(times)[len(times) // 2], sum("wall clock" in reason for reason in reasons)
            cells = (f"{condition:20}", len(times), f"{1e3 * p50:.1f}", f"{1e3 * max(times):.1f}", by_wall, early_holds)
            print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()
elif __name__ == "__mp_main__":
    # Compile the controller once, in the process from which the controllers are forked.
    ArmController(load_arm("mtml"), IdentifiedModel.from_arm(load_arm("mtml")), "hold", 1e-3)
