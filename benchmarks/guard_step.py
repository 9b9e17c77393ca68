"""Measures the computing time of the command guard per period: one received command and one step in effort mode.

    python benchmarks/guard_step.py [--other CHECKOUT]

The reference is the time to encode and decode the command. With another checkout of this repository, e.g. of an older
commit, both versions are measured alternately. Times are CPU times. Each is the minimum over many batches, since other
processes can only increase the time.
"""

from __future__ import annotations

import os
import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path

from timing import print_table

ROOT = Path(__file__).resolve().parents[1]
#: Number of alternating measurements of both checkouts.
REPETITIONS = 5

WORKER = """
import sys, time
sys.path.insert(0, "tests/support")
from guard_bench import Bench, Command
from dvrk_drake.models.arm_files import load_arm

arm = load_arm(sys.argv[1])
try:
    from dvrk_drake.dynamics.identified_model import ControlModel
    from dvrk_drake.dynamics.identified_model import IdentifiedModel

    bench = Bench(arm, model=ControlModel(IdentifiedModel.from_arm(arm)), checks=True).at_rest()
except ImportError:
    bench = Bench(arm)
bench.started(Command.EFFORT)
times, messages = [], []
for _ in range(60):
    commands, start = [], bench.utime
    for k in range(100):
        command = bench.command(Command.EFFORT)
        command.utime, command.status_utime = command.utime + 1000 * k, start + 1000 * k
        commands.append(command)
    begin = time.process_time()
    for command in commands:
        bench.guard.receive(command, bench.utime)
        bench.utime += 1000
        bench.step()
    times.append((time.process_time() - begin) / len(commands))
    begin = time.process_time()
    for command in commands:
        Command.decode(command.encode())
    messages.append((time.process_time() - begin) / len(commands))
assert bench.guard.state == 4, bench.guard.fault_text
print(1e6 * min(times), 1e6 * min(messages))
"""


def cost(checkout: Path, arm: str) -> tuple[float, float]:
    """Returns the minimum time of a period, and the minimum time to encode and decode a command [us]."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    command = [sys.executable, "-c", WORKER, arm]
    output = subprocess.run(command, cwd=checkout, env=environment, check=True, capture_output=True).stdout
    guard, message = map(float, output.split())
    return guard, message


def main() -> None:
    """Prints one row per arm."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--other", type=Path, help="folder of the other checkout")
    other = parser.parse_args().other
    rows = {}
    for arm in ("mtml", "psm"):
        measurements = [(*cost(ROOT, arm), cost(other, arm)[0] if other else float("nan")) for _ in range(REPETITIONS)]
        guard, message, other_guard = (min(times[i] for times in measurements) for i in range(3))
        compared = [f"{other_guard:.1f}", f"{guard / other_guard:.2f}"] if other else []
        rows[arm] = [f"{guard:.1f}", f"{message:.1f}", f"{guard / message:.2f}", *compared]
    compared = ["guard of the other checkout [us]", "ratio this / other"] if other else []
    headings = ["guard [us]", "encode and decode [us]", "ratio", *compared]
    print_table("CPU time per command and step", headings, rows)


if __name__ == "__main__":
    main()
