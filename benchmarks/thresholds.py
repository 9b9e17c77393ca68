"""Prints what half and twice the value of a constant change, for the reasons beside the constants of `analysis`.

    python benchmarks/thresholds.py FOLDER check.motion_check.MIN_JITTER ... [--identify]

FOLDER contains the folders trajectories, psm_three_joints and mtm_static with the public recordings
(docs/public_recordings.md). A constant is named by its module in `dvrk_drake.analysis`. The output lists the findings
of `check` that appear and disappear. With `--identify`, it also contains the mean cross-validated errors of `mtm_one`
and `psm_one`. A constant that a module uses while it is imported cannot be varied.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import dvrk_drake as dvrk

LOCKED = {"roll": 0.0, "wrist_pitch": 0.0, "wrist_yaw": 0.0, "jaw": 0.0}
MOTIONS = {"mtm_one": "mtmr", "psm_one": "psm"}


def recordings(folder: Path) -> dict[str, tuple[dvrk.Recording, dvrk.Arm]]:
    """Returns the public recordings of dVRK arms, with their arms, by the names of their files."""
    mtmr, psm = dvrk.load_arm("mtmr"), dvrk.load_arm("psm")
    three = dvrk.lock_joints(psm, LOCKED)
    found = {}
    for path in sorted(folder.glob("trajectories/*.csv")):
        if path.stem.endswith("cable_test"):  # one joint only
            continue
        arm = psm if path.stem.startswith("psm") else mtmr
        found[path.stem] = dvrk.read_recording(path, arm, coordinates="actuator" if arm is mtmr else "wpi"), arm
    found |= {path.stem: (dvrk.read_recording(path, three), three) for path in folder.glob("psm_three_joints/*.csv")}
    return found | {
        path.stem: (dvrk.read_recording(path, mtmr), mtmr) for path in folder.glob("mtm_static/mtm*_20*.csv")
    }


def results(name: str, factor: float, folder: Path, identify: bool) -> tuple[set[str], dict[str, float]]:
    """Returns the findings, and the mean cross-validated errors [%], with a constant times a factor."""
    module, _, constant = f"dvrk_drake.analysis.{name}".rpartition(".")
    value = getattr(importlib.import_module(module), constant)
    # The modules that import the constant by its name have a copy.
    for other in [m for n, m in sys.modules.items() if n.startswith("dvrk_drake.")]:
        if getattr(other, constant, None) is value:
            setattr(other, constant, scaled(value, factor))
    read = recordings(folder)
    findings = {
        f"{file}: {finding.severity} {finding.kind}, {finding.where}"
        for file, (recording, arm) in read.items()
        for finding in dvrk.check(recording, arm).findings
    }
    errors = {}
    for file in MOTIONS if identify else ():
        actuators = dvrk.identify(*read[file]).model.dynamics.actuators
        errors[file] = 100 * float(np.mean([a.rms_cross_validation / a.rms_effort for a in actuators]))
    return findings, errors


def scaled(value: Any, factor: float) -> Any:
    """Returns a number, or a tuple of numbers, times a factor. Integers are rounded, and are at least 1."""
    if isinstance(value, tuple):
        return tuple(scaled(part, factor) for part in value)
    return max(1, round(factor * value)) if isinstance(value, int) else factor * value


def main() -> None:
    """Prints the changes, one line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    parser.add_argument("names", nargs="+", help="constants, e.g. check.motion_check.MIN_JITTER")
    parser.add_argument("--identify", action="store_true", help="also print the errors of two motions")
    options = parser.parse_args()
    for name in options.names:
        before, errors = _in_process(name, 1.0, options.folder, options.identify)
        for factor in (0.5, 2.0):
            after, new = _in_process(name, factor, options.folder, options.identify)
            print(
                f"{name} x {factor:g}: {len(before ^ after)} findings change"
                + "".join(
                    [f"\n  - {line}" for line in sorted(before - after)]
                    + [f"\n  + {line}" for line in sorted(after - before)]
                )
            )
            for file in new:
                print(f"  {file}: mean cross-validated error {errors[file]:.2f} -> {new[file]:.2f} %")


def _in_process(*arguments: Any) -> tuple[set[str], dict[str, float]]:
    """Returns `results`, computed in a process of its own, because caches may contain the value of a constant."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        return executor.submit(results, *arguments).result()


if __name__ == "__main__":
    main()
