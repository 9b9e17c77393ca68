"""Measures the time from the start of a process to the first step of a controlled arm.

    python benchmarks/first_tick.py [--repetitions N]

Each run is a new process that imports the package, builds an ArmStation with a GravityPidController, and simulates one
control period. The row "first process" has an empty cache of compiled functions, as after an installation. Times are
wall-clock times from the start of the process, medians over the repetitions.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time

from timing import print_table

#: Program of the measured process.
PROGRAM = """
import sys

import dvrk_drake as dvrk
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

arm = dvrk.load_arm(sys.argv[1])
builder = DiagramBuilder()
station = builder.AddSystem(dvrk.ArmStation(arm))
controller = builder.AddSystem(dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm)))
builder.Connect(station.GetOutputPort(f"{sys.argv[1]}.state_estimated"), controller.GetInputPort("state_estimated"))
builder.Connect(controller.GetOutputPort("effort"), station.GetInputPort(f"{sys.argv[1]}.effort_commanded"))
Simulator(builder.Build()).AdvanceTo(0.001)
"""


def seconds(arm: str, cache: str | None) -> float:
    """Returns the time of one process [s]. `cache` is the folder of compiled functions, or None for the usual one."""
    environment = {**os.environ, **({} if cache is None else {"NUMBA_CACHE_DIR": cache})}
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", PROGRAM, arm], env=environment, check=True, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=5, help="number of processes; default: %(default)s")
    repetitions = parser.parse_args().repetitions
    seconds("mtml", None)  # fills the cache
    rows = {}
    for arm in ("mtml", "psm"):
        later = statistics.median(seconds(arm, None) for _ in range(repetitions))
        with tempfile.TemporaryDirectory() as cache:
            rows[arm] = f"{seconds(arm, cache):.1f}", f"{later:.2f}"
    print_table("Time from the start of a process to the first step [s]", ["first process", "later processes"], rows)


if __name__ == "__main__":
    main()
