"""How soon the guard detects wrong sensor data, and what the arm does until then and afterwards.

    python benchmarks/sensor_faults.py [--arms mtml psm] [--uses effort position hold] [--processes 2]

Each fault of tests/support/faulty_arm.py begins on each joint of a simulated arm with all effects of its file, while
the joints move at up to 0.5 rad/s (50 mm/s) under effort or position commands, or stand.
"""

from __future__ import annotations

import multiprocessing
import sys
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from faulty_arm import FAULTS, PERIOD, FaultyArm

#: When the fault begins [s]: all joints move then.
BEGIN = 2.6


class Table:
    """Outcomes of all faults on all joints of one arm in one use."""

    def __init__(self, name, use, faults):
        self.arm = FaultyArm(name, use)
        self.title = f"{name}, {use}"
        self.tasks = [(fault, joint) for fault in faults for joint in range(self.arm.arm.num_joints)]
        while self.arm.ticks * PERIOD < BEGIN:
            self.arm.step()

    def outcome(self, task):
        """Outcome of one (fault, joint); for a process of its own, which is a copy of the arm that moves."""
        return self.arm.fail(*task, BEGIN)

    def print(self, outcomes):
        """Prints a line for each fault and joint, and the counts."""
        arm = self.arm.arm
        print(f"\n{self.title}. Movement in rad, of prismatic joints in dm; speed in rad/s, dm/s; effort / limit")
        columns = f"{'detected ms':>11} {'moved until':>11} {'after':>7} {'speed':>6} {'effort':>6}  guard"
        print(f"{'fault':18} {'joint':16} {columns}")
        far = 0
        for (fault, joint), o in zip(self.tasks, outcomes, strict=True):
            scale = 10.0 if arm.prismatic[joint] else 1.0
            far += scale * o.before > 0.05
            print(
                f"{fault:18} {arm.joint_names[joint]:16} {1e3 * o.detected:11.0f} {scale * o.before:11.3f} "
                f"{scale * o.after:7.3f} {o.speed:6.2f} {o.effort:6.2f}  {o.text}"
            )
        times = [1e3 * o.detected for o in outcomes if np.isfinite(o.detected)]
        print(
            f"{len(times)} of {len(self.tasks)} detected, after {np.median(times):.0f} ms (median); "
            f"{far} moved more than 0.05 before",
            flush=True,
        )


def main():
    """Prints the tables."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--arms", nargs="+", default=["mtml", "psm"])
    parser.add_argument("--uses", nargs="+", default=["effort", "position", "hold"])
    parser.add_argument("--faults", nargs="+", default=list(FAULTS))
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    for arm in arguments.arms:
        for use in arguments.uses:
            table = Table(arm, use, arguments.faults)
            TABLES.append(table)
            with multiprocessing.get_context("fork").Pool(arguments.processes, maxtasksperchild=1) as pool:
                table.print(pool.map(newest_outcome, table.tasks, chunksize=1))


#: The tables so far; a forked process takes the newest one.
TABLES = []


def newest_outcome(task):
    """Outcome of a task of the newest table."""
    return TABLES[-1].outcome(task)


if __name__ == "__main__":
    main()
