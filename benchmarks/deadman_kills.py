"""Measures the time from a signal to a controller or a bridge until the dVRK console holds its arm.

    python benchmarks/deadman_kills.py [--kills 20] [--realtime] [--jaw-seconds 60]

The script starts the dVRK's own controller in kinematic simulation (tests/support/dvrk_console.py), `dvrk-drake bridge`
and a controller that commands efforts of zero. After efforts have acted for 0.3 s to 0.6 s, it sends SIGKILL to the
controller, to the bridge or to both. It also stops the bridge with SIGSTOP. Then it restarts what has ended.

The measurement starts just before the call that sends the signal. It ends twice:

- at the time of publication of the message that holds the arm: `hold` of the deadman, or `servo_jp` of the guard
- when the console has written its change to position control; the script reads this file every millisecond

With --jaw-seconds, the script then counts the changes between joint space and Cartesian space of a PSM. Meanwhile, the
bridge sends efforts of the arm and of the jaw.

A busy computer may suspend a process for so long that the arm is held before the signal. The script repeats such an
attempt and counts it in the column "held before the signal". The console has no dynamics: efforts move nothing. Nothing
was measured on a real arm.

The benchmark requires a network namespace and multicast:

    unshare -n sh -c 'ip link set lo up; ip link set lo multicast on; ip route add 239.255.0.0/16 dev lo;
                      exec python benchmarks/deadman_kills.py --realtime'

Without root, use `unshare -rn`. A root user made by `unshare -r` is not permitted to use real-time scheduling.
"""

import argparse
import contextlib
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import effort_controller
from dvrk_console import Console, start_console
from ros_bridge import CommandMonitor
from ros_publisher import DOMAIN_FILE

from dvrk_drake import cli
from dvrk_drake.processes.pace import make_realtime

#: Name of each condition, processes that get the signal, and the signal.
CONDITIONS = {
    "SIGKILL to the controller": (("controller",), signal.SIGKILL),
    "SIGKILL to the bridge": (("bridge",), signal.SIGKILL),
    "SIGKILL to both": (("bridge", "controller"), signal.SIGKILL),
    "SIGSTOP to the bridge": (("bridge",), signal.SIGSTOP),
}
#: Minimum and maximum time for which efforts act before the signal [s].
ACTING = (0.3, 0.6)
#: Time after the signal in which the arm must remain in position control [s].
AFTER = 0.5
#: Longest wait for a change of the control mode [s].
LONGEST = 60.0
#: Amplitude of the effort of the jaw [N m]. Commands start only with an effort near the measured one, which is 0.
JAW = 0.02
#: Configuration of the bridge: default times, but the console measures no effort although gravity acts on the model.
DRIVER = "guard: {resume_automatically: true, plausibility: {start_gravity: 2.0}}\n"
EFFORT, POSITION = "JOINT_SPACE/EFFORT_MODE", "JOINT_SPACE/POSITION_MODE"


def run_bridge(arm: str, folder: str, realtime: bool) -> None:
    """Runs `dvrk-drake bridge`; its output is appended to a file."""
    driver = Path(folder, "lenient.yaml")
    driver.write_text(DRIVER)
    with open(Path(folder, "bridge.txt"), "a") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    options = ["--realtime"] if realtime else []
    sys.exit(cli.main(["bridge", "--arm", arm, "--driver", str(driver), *options]))


def run_controller(arm: str, jaw: float) -> None:
    """Runs a controller that commands efforts of zero, and optionally a moving effort of the last joint."""
    effort_controller.main([arm, "--jaw", str(jaw)])


class Bench:
    """Bridge, controller and monitor beside a console."""

    def __init__(self, console: Console, folder: str, arm: str, realtime: bool, jaw: float = 0.0) -> None:
        self._console, self._context = console, multiprocessing.get_context("forkserver")
        self._processes: dict[str, BaseProcess] = {}
        self._mains: dict[str, tuple[Any, ...]] = {
            "bridge": (run_bridge, arm, folder, realtime),
            "controller": (run_controller, arm, jaw),
        }
        self.monitor = CommandMonitor(console.domain, f"/{console.arm}", *(["jaw/servo_jf"] if jaw else []))

    def start(self) -> None:
        """Starts the bridge and the controller, if they do not run."""
        for name, (main, *arguments) in self._mains.items():
            if name not in self._processes or not self._processes[name].is_alive():
                self._processes[name] = self._context.Process(target=main, args=tuple(arguments), daemon=True)
                self._processes[name].start()

    def send(self, names: tuple[str, ...], number: int) -> None:
        """Sends a signal to processes."""
        for name in names:
            os.kill(self._processes[name].pid or 0, number)

    def wait_for_mode(self, mode: str, seconds: float) -> bool:
        """Waits until a mode is the last mode of the console. Returns whether it was reached within a time [s]."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self._console.modes()[-1:] == [mode]:
                return True
            time.sleep(1e-3)
        return False

    def end(self) -> None:
        """Ends both processes."""
        for process in self._processes.values():
            if process.is_alive():
                os.kill(process.pid or 0, signal.SIGCONT)
                process.kill()
            process.join()
        time.sleep(1.0)  # The console must still confirm `hold` of the deadman process.


@contextlib.contextmanager
def started(arm: str, console_arm: str, realtime: bool, jaw: float = 0.0) -> Iterator[tuple[Console, Bench]]:
    """Runs an enabled and homed console with a bridge and a controller until the block ends."""
    with (
        tempfile.TemporaryDirectory() as folder,
        start_console(console_arm, folder, motion=bool(jaw)) as console,
    ):
        console.enable_and_home()
        bench = Bench(console, folder, arm, realtime, jaw)
        try:
            bench.start()
            yield console, bench
        finally:
            bench.end()
            lines = Path(folder, "bridge.txt").read_text().splitlines()
            print(*lines[-6:], sep="\n", file=sys.stderr)


def measure(console: Console, bench: Bench, names: tuple[str, ...], number: int, kills: int) -> dict[str, list[float]]:
    """Returns times from a signal to the message and to the mode of the console [s], and counts of other events."""
    found: dict[str, list[float]] = {
        "message": [],
        "mode": [],
        "early": [],
        "remains in effort mode": [],
        "old effort": [],
    }
    while len(found["mode"]) < kills:
        bench.start()
        if not bench.wait_for_mode(EFFORT, LONGEST):
            raise SystemExit("The controller's efforts do not act. Stop other programs.")
        bench.monitor.forget()
        if bench.wait_for_mode(POSITION, random.uniform(*ACTING)):
            found["early"].append(1.0)
            continue
        start, start_monotonic = time.time_ns(), time.monotonic()
        bench.send(names, number)
        if not bench.wait_for_mode(POSITION, 10.0):
            raise SystemExit("The console did not hold the arm within 10 s.")
        mode_time = time.monotonic() - start_monotonic
        if not bench.monitor.acts_until(start):
            found["early"].append(1.0)
            bench.end()
            continue
        found["mode"].append(mode_time)
        held = ("servo_jp", "hold") if names == ("controller",) else ("hold",)
        published = bench.monitor.first(held, start)
        found["message"].append(float("nan") if published is None else 1e-9 * (published - start))
        if bench.wait_for_mode(EFFORT, AFTER):
            found["remains in effort mode"].append(1.0)
        if number == signal.SIGSTOP:
            num_modes = len(console.modes())
            bench.send(names, signal.SIGCONT)
            # Commands act again only after the start check, which takes 0.25 s.
            time.sleep(0.1)
            # A bridge that was stopped while it published an effort publishes this effort now, and then hold.
            if modes := console.modes()[num_modes:]:
                found["remains in effort mode" if modes[-1] == EFFORT else "old effort"].append(1.0)
            # The measurements that waited for the stopped bridge are too old, which is a fault.
            bench.end()
        print(f"{len(found['mode'])}: {1e3 * found['mode'][-1]:.1f} ms", file=sys.stderr, flush=True)
    return found


def count_flips(realtime: bool, seconds: float, jaw: float) -> str:
    """Returns a table row with the changes of the control space of a PSM and the numbers of commands."""
    with started("psm", "PSM1", realtime, jaw) as (console, bench):
        if not bench.wait_for_mode(EFFORT, LONGEST):
            raise SystemExit("The controller's efforts do not act. Stop other programs.")
        time.sleep(1.0)
        bench.monitor.forget()
        num_modes = len(console.modes())
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.5)
            bench.monitor.receive()
        modes = console.modes()[num_modes:]
        sent = [name for name, *_ in bench.monitor.receive()]
    cells = (sent.count("servo_jf"), sent.count("jaw/servo_jf"), len(modes), sum("CARTESIAN" in mode for mode in modes))
    return f"| {jaw:g} | {' | '.join(map(str, cells))} |"


def main() -> None:
    """Prints one row per condition."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=20, help="number of signals per condition; default: 20")
    parser.add_argument("--condition", choices=CONDITIONS, help="measure only this condition")
    parser.add_argument("--realtime", action="store_true", help="use real-time scheduling for all processes")
    parser.add_argument("--jaw-seconds", type=float, default=0.0, help="time with efforts of a jaw [s]; default: 0")
    options = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", DOMAIN_FILE)
    if options.realtime:
        # All processes that are started below inherit the scheduling.
        for warning in make_realtime():
            print(f"warning: {warning}", file=sys.stderr)
    scheduling = "real-time" if options.realtime else "normal"
    print(f"load average at the start: {os.getloadavg()[0]:.2f} on {os.cpu_count()} cores")
    if options.kills:
        title = f"MTML, {scheduling} scheduling, {options.kills} signals per row"
        print(f"{title}: time [ms] from a signal to the command and to position control")
        times = [f"{name}, {which}" for name in ("command", "position control") for which in ("p50", "max")]
        columns = ("scheduling, signal", *times, "held before the signal", "remained in effort control", "old effort")
        print(f"| {' | '.join(columns)} |")
        print("|---|---|---|---|---|---|---|---|")
        with started("mtml", "MTML", options.realtime) as (console, bench):
            for condition, (names, number) in CONDITIONS.items():
                if options.condition not in (None, condition):
                    continue
                found = measure(console, bench, names, number, options.kills)
                times = [
                    f"{1e3 * value:.1f}"
                    for values in (sorted(found["message"]), sorted(found["mode"]))
                    for value in (values[len(values) // 2], values[-1])
                ]
                counts = [len(found[key]) for key in ("early", "remains in effort mode", "old effort")]
                print(f"| {scheduling}, {condition} | {' | '.join([*times, *map(str, counts)])} |", flush=True)
    if options.jaw_seconds:
        print(f"\nPSM1, {scheduling} scheduling: changes of the control space in {options.jaw_seconds:g} s")
        print("| jaw effort [N m] | servo_jf | jaw/servo_jf | mode changes | to Cartesian space |")
        print("|---|---|---|---|---|")
        for jaw in (1e-9, JAW):
            print(count_flips(options.realtime, options.jaw_seconds, jaw), flush=True)


if __name__ == "__main__":
    main()
