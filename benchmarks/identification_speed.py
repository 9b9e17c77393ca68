"""Compares the times of `dvrk-drake identify` and `derive_gravity` with those of another checkout.

    python benchmarks/identification_speed.py --base CHECKOUT [--recordings FOLDER] [--repetitions N]

CHECKOUT is a folder with another version of dvrk_drake, e.g. made by `git worktree add ../before COMMIT`. FOLDER
contains the public recordings mtm_one.csv and psm_one.csv (docs/public_recordings.md). Without FOLDER, only
`derive_gravity` is measured. Each run is a separate process with one BLAS thread, and the checkouts alternate. Times
are medians. A ratio below 1 means that this checkout is faster.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

HERE = Path(__file__).resolve().parents[1]
RECORDINGS = {"mtm_one": "mtmr", "psm_one": "psm"}
ARMS = ("mtml", "psm")
#: Arguments of the command in this and in the other checkout. Edit the latter if the other checkout has other options.
IDENTIFY = ("identify", "{recording}", "--arm", "{arm}", "--coordinates", "actuator", "--output", "model.yaml")
IDENTIFY_BASE = IDENTIFY
#: Program that prints the formulas, and then the CPU time and the wall time of the derivation in the last line.
DERIVE = """
import sys, time
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import shared_plant
arm = load_arm(sys.argv[1])
shared_plant(arm)
start = time.process_time(), time.perf_counter()
gravity = derive_gravity(arm)
times = time.process_time() - start[0], time.perf_counter() - start[1]
print(gravity.base.names, gravity.regressor, gravity.potential, sep="\\n")
print(*times)
"""


class Run(NamedTuple):
    """CPU time and wall time [s] of a run, its output, and the errors of the written model."""

    cpu: float
    wall: float
    output: str
    errors: tuple[float, ...] = ()


def run(checkout: Path, arguments: Sequence[str]) -> Run:
    """Runs Python with the package of a checkout in an empty folder; exits with a message if the process fails."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        before, start = os.times(), time.perf_counter()
        process = subprocess.run(
            [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        wall, after = time.perf_counter() - start, os.times()
        if process.returncode:
            raise SystemExit(f"{checkout}: {' '.join(arguments[-8:])}: {process.stderr.strip()}")
        model = Path(folder) / "model.yaml"
        errors = _errors(yaml.safe_load(model.read_text())) if model.is_file() else ()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return Run(cpu, wall, process.stdout, errors)


def derive(checkout: Path, arm: str) -> Run:
    """Runs `derive_gravity` in a new process; the times exclude the imports."""
    *formulas, times = run(checkout, ["-c", DERIVE, arm]).output.splitlines()
    cpu, wall = map(float, times.split())
    return Run(cpu, wall, "\n".join(formulas))


def identify(checkout: Path, command: Sequence[str], recording: Path, arm: str) -> Run:
    """Runs the command `dvrk-drake identify`; the times include the start of the process."""
    arguments = [part.format(recording=recording, arm=arm) for part in command]
    return run(checkout, ["-m", "dvrk_drake.cli", *arguments])


def _errors(model: dict) -> tuple[float, ...]:
    """Returns two relative RMS errors of each actuator: of the fit, and cross-validated."""
    kinds = ("rms_fit", "rms_cross_validation")
    return tuple(a[kind] / a["rms_effort"] for a in model["dynamics"]["actuators"] for kind in kinds)


def show(what: str, runs: list[tuple[Run, Run]]) -> None:
    """Prints one row: times of the other checkout and of this one, ratios, and the difference between the results."""
    (cpu_other, wall_other), (cpu, wall) = (
        np.median([(pair[k].cpu, pair[k].wall) for pair in runs], axis=0) for k in range(2)
    )
    other, this = runs[0]
    if other.errors:
        difference = np.max(np.abs(np.subtract(other.errors, this.errors)))
        same = f"errors differ by at most {100 * difference:.1g} percentage points"
    else:
        same = "equal formulas" if other.output == this.output else "different formulas"
    print(
        f"{what:24} {cpu_other:7.2f} {cpu:7.2f} {cpu / cpu_other:6.2f}   "
        f"{wall_other:7.2f} {wall:7.2f} {wall / wall_other:6.2f}   {same}",
        flush=True,
    )


def main() -> None:
    """Prints one row per arm and recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", type=Path, required=True, help="folder of the other checkout")
    parser.add_argument("--recordings", type=Path, help="folder that contains mtm_one.csv and psm_one.csv")
    parser.add_argument("--repetitions", type=int, default=5, help="number of repetitions; default: %(default)s")
    options = parser.parse_args()
    base = options.base.resolve()
    columns = f"{'other':>7} {'this':>7} {'ratio':>6}"
    print(f"{'':24} {'CPU time [s]':^22}   {'wall time [s]':^22}")
    print(f"{'':24} {columns}   {columns}   results")
    for arm in ARMS:
        show(f"derive_gravity {arm}", [(derive(base, arm), derive(HERE, arm)) for _ in range(options.repetitions)])
    for name, arm in RECORDINGS.items() if options.recordings else ():
        recording = (options.recordings / f"{name}.csv").resolve()
        pairs = [
            (identify(base, IDENTIFY_BASE, recording, arm), identify(HERE, IDENTIFY, recording, arm))
            for _ in range(options.repetitions)
        ]
        show(f"identify {name}", pairs)


if __name__ == "__main__":
    main()
