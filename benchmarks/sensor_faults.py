"""Measures the time until the guard detects a sensor fault, and the motion of the arm before and after the detection.

    python benchmarks/sensor_faults.py [--arms mtml psm] [--uses effort position hold] [--processes 2]

Each fault of tests/support/faulty_arm.py is simulated for each joint of an arm with all effects of its file. The joints
move at up to 0.5 rad/s (50 mm/s) under effort or position commands, or are at rest. A moving arm has three trials per
fault, with different start times of the fault and two motions. The table contains the largest values over the trials.
Its columns are:

    found       trials in which the guard detected the fault, and all trials
    ms          largest time from the fault to its detection [ms]
    before      largest motion of the joint from the fault to its detection [rad, dm]
    after       largest motion of the joint after the detection [rad, dm]
    speed       largest speed of any joint, from 50 ms after the detection on [rad/s, dm/s]
    effort      largest effort of any joint after the detection, as a share of its limit
    guard       message of the guard
"""

from __future__ import annotations

import multiprocessing
import sys
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from faulty_arm import FAULTS, PERIOD, FaultyArm

from dvrk_drake.models.arm_files import load_arm

#: Start time of the fault [s], at which all joints move, and seed of the motion and the noise.
TRIALS = ((2.6, 0), (3.2, 1), (3.8, 0))


class Trial:
    """Simulated arm at the start of a fault."""

    def __init__(self, name, use, begin, seed):
        self.begin, self.arm = begin, FaultyArm(name, use, seed=seed)
        while self.arm.ticks * PERIOD < begin:
            self.arm.step()

    def outcome(self, task):
        """Returns the outcome of a task (fault, joint). Call this in a forked process, since it changes the arm."""
        return self.arm.fail(*task, self.begin)


def print_table(title, arm, tasks, trials):
    """Prints the largest values of each fault and joint, and a summary; trials[k][i] is the outcome of tasks[i]."""
    print(f"\n{title}: largest values of {len(trials)} trials. Motion before and after the detection [rad, dm], speed")
    print("[rad/s, dm/s] and effort as a share of the limit after the detection.")
    print(
        f"{'fault':18} {'joint':16} {'found':>5} {'ms':>5} {'before':>7} {'after':>6} {'speed':>6} {'effort':>6}  guard"
    )
    for (fault, joint), outcomes in zip(tasks, zip(*trials, strict=True), strict=True):
        scale = 10.0 if arm.prismatic[joint] else 1.0
        found = [o for o in outcomes if np.isfinite(o.detected)]
        worst = max(found, key=lambda o: o.detected, default=outcomes[0])
        milliseconds = f"{1e3 * worst.detected:.0f}" if found else "-"
        before, after = (scale * max(getattr(o, name) for o in outcomes) for name in ("before", "after"))
        speed, effort = (max(getattr(o, name) for o in outcomes) for name in ("speed", "effort"))
        print(
            f"{fault:18} {arm.joint_names[joint]:16} {len(found):3}/{len(outcomes)} {milliseconds:>5} {before:7.3f} "
            f"{after:6.2f} {speed:6.2f} {effort:6.2f}  {worst.text}"
        )
    flat = [(10.0 if arm.prismatic[joint] else 1.0, o) for t in trials for (_, joint), o in zip(tasks, t, strict=True)]
    found = [(scale, o) for scale, o in flat if np.isfinite(o.detected)]
    median = 1e3 * np.median([o.detected for _, o in found])
    print(
        f"{len(found)} of {len(flat)} faults detected, median time {median:.0f} ms. Of the detected faults, "
        f"{sum(scale * o.before <= 0.05 for scale, o in found)} had before <= 0.05, "
        f"{sum(o.speed <= 0.5 for _, o in found)} had speed <= 0.5, "
        f"and {sum(o.effort <= 0.4 for _, o in found)} had effort <= 0.4. Of the undetected faults, "
        f"{sum(scale * o.before > 0.05 for scale, o in flat if np.isinf(o.detected))} had before > 0.05.",
        flush=True,
    )


def main():
    """Prints one table per arm and use."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--arms", nargs="+", default=["mtml", "psm"], help="names of the arms; default: %(default)s")
    parser.add_argument("--uses", nargs="+", default=["effort", "position", "hold"], help="uses to simulate")
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), help="sensor faults to simulate")
    parser.add_argument("--processes", type=int, default=2, help="number of parallel processes; default: %(default)s")
    arguments = parser.parse_args()
    for name in arguments.arms:
        for use in arguments.uses:
            arm = load_arm(name)
            tasks = [(fault, joint) for fault in arguments.faults for joint in range(arm.num_joints)]
            outcomes = []
            for begin, seed in TRIALS[:1] if use == "hold" else TRIALS:
                TRIAL_HISTORY.append(Trial(name, use, begin, seed))
                with multiprocessing.get_context("fork").Pool(arguments.processes, maxtasksperchild=1) as pool:
                    outcomes.append(pool.map(last_outcome, tasks, chunksize=1))
            print_table(f"{name}, {use}", arm, tasks, outcomes)


#: Trials so far. A forked process uses the last one.
TRIAL_HISTORY = []


def last_outcome(task):
    """Returns the outcome of a task in the last trial."""
    return TRIAL_HISTORY[-1].outcome(task)


if __name__ == "__main__":
    main()
