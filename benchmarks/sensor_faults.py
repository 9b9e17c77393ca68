"""How soon the guard detects wrong sensor data, and what the arm does until then and afterwards.

    python benchmarks/sensor_faults.py [--arms mtml psm] [--uses effort gravity position hold] [--processes 2]

Each fault of tests/support/faulty_arm.py begins on each joint of a simulated arm with all effects of its file, while the
joints move at up to 0.5 rad/s (50 mm/s) under effort or position commands, or stand. One line per fault and joint.
"""

from __future__ import annotations

import multiprocessing
import sys
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from faulty_arm import FAULTS, FaultyArm

#: When the fault begins [s]: all joints move then.
BEGIN = 2.6


def outcome(task):
    fault, joint = task
    return ARM.fail(fault, joint, BEGIN)


def table(name, use, processes, faults):
    """Prints the table of one arm in one use."""
    global ARM
    ARM = FaultyArm(name, use)
    while ARM.ticks * 1e-3 < BEGIN:
        ARM.step()
    tasks = [(fault, joint) for fault in faults for joint in range(ARM.arm.num_joints)]
    # A process of its own for each fault: it starts as a copy of the arm that moves.
    with multiprocessing.get_context("fork").Pool(processes, maxtasksperchild=1) as pool:
        outcomes = pool.map(outcome, tasks, chunksize=1)
    print(f"\n{name}, {use}. Movement in rad, of prismatic joints in dm; speed in rad/s or dm/s; effort / limit")
    print(
        f"{'fault':18} {'joint':16} {'detected ms':>11} {'moved until':>11} {'after':>7} {'speed':>6} {'effort':>6}  guard"
    )
    for (fault, joint), o in zip(tasks, outcomes, strict=True):
        scale = 10.0 if ARM.arm.prismatic[joint] else 1.0
        print(
            f"{fault:18} {ARM.arm.joint_names[joint]:16} {1e3 * o.detected:11.0f} {scale * o.before:11.3f} "
            f"{scale * o.after:7.3f} {o.speed:6.2f} {o.effort:6.2f}  {o.text}",
            flush=True,
        )
    late = [
        o for o, (_, j) in zip(outcomes, tasks, strict=True) if o.before * (10 if ARM.arm.prismatic[j] else 1) > 0.05
    ]
    found = [o.detected for o in outcomes if np.isfinite(o.detected)]
    print(
        f"{len(found)} of {len(tasks)} detected, median {1e3 * np.median(found):.0f} ms; {len(late)} moved more than 0.05"
    )


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--arms", nargs="+", default=["mtml", "psm"])
    parser.add_argument("--uses", nargs="+", default=["effort", "gravity", "position", "hold"])
    parser.add_argument("--faults", nargs="+", default=list(FAULTS))
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    for arm in arguments.arms:
        for use in arguments.uses:
            table(arm, use, arguments.processes, arguments.faults)
