"""Measures the time until the guard detects a sensor fault, and the motion of the arm before and after the detection.

    python benchmarks/sensor_faults.py [--arms mtml psm] [--trials 300] [--uses effort position] [--processes 2]
    python benchmarks/sensor_faults.py --delays 0 10 20 30 [--arms mtml mtmr psm] [--uses effort position hold]

Each trial simulates one fault of tests/support/faulty_arm.py on one joint of an arm with all effects of its file.
Fault, joint, time of the fault, pose and motion are drawn at random. The maximum speed of the motion is 0.1 rad/s to
0.5 rad/s (10 mm/s to 50 mm/s), under effort or position commands, or zero in use "hold". Each motion has several
trials. The tables contain the median and the largest value of all trials of a row, and stderr one line per trial. The
columns are:

    found       number of trials in which the guard detected the fault within 3 s, and of all trials
    ms          time from the fault to its detection [ms]
    before      motion of the joint from the fault to its detection, or in 3 s without detection [rad, m]
    after       motion of the joint within 0.6 s after the detection [rad, m]
    speed       largest speed of any revolute joint, from 50 ms after the detection on [rad/s]
    prismatic   the same of any prismatic joint [m/s]

With --delays, position and velocity of one joint or of all joints are delayed by these times [ms], without a change of
their time stamps. A delayed control loop oscillates. The table states whether the guard reported a fault within 2 s,
the speed in 0.2 s before it, and the largest speed after it, in 3 s and in the last 0.5 s of them.
"""

from __future__ import annotations

import multiprocessing
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from faulty_arm import FAULTS, PERIOD, FaultyArm, wave

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm

#: First and last time of a fault [s], and the number of faults per motion.
BEGIN, END, PER_MOTION = 2.0, 4.5, 15
#: Time for which a trial is simulated after the detection [s].
AFTER = 0.6
#: Largest holding effort at the center of a motion, as a share of the effort limits.
HOLDING_SHARE = 0.6
#: Simulated times [s] of a delay: before the delay begins, until a fault, and after the fault.
DELAY_BEGIN, DELAY_PATIENCE, DELAY_AFTER = 0.3, 2.0, 3.0

#: States in which commands act.
ACTING = (lcmt_dvrk_status.STATE_POSITION, lcmt_dvrk_status.STATE_EFFORT)

FORK = multiprocessing.get_context("fork")


def random_motion(arm, generator):
    """Returns a random trajectory inside the limits of the arm."""
    model = IdentifiedModel.from_arm(arm, arm.effects.cables + arm.effects.springs)
    while True:
        center = arm.sample_poses(1, generator, margin=0.1)[0]
        seed, reach = int(generator.integers(2**31)), generator.uniform(0.05, 0.35)
        path = wave(arm, END + 4.0, generator.uniform(0.1, 0.5), seed, reach, center)
        poses = path.vector_values(np.linspace(0.0, END + 4.0, 100)).T
        share = np.abs(model.holding_torque(center[None])[0]) / arm.effort_limits
        if not any(map(arm.limit_violations, poses)) and share.max() < HOLDING_SHARE:
            return path


def in_fork(function: Callable[[], object]) -> object:
    """Returns the result of a function that runs in a forked process, so that it does not change this process."""
    receiver, sender = FORK.Pipe(duplex=False)
    process = FORK.Process(target=lambda: sender.send(function()))
    process.start()
    sender.close()  # if the process fails, recv raises EOFError
    result = receiver.recv()
    process.join()
    return result


def motion_trials(task) -> list[tuple[str, int, object]]:
    """Simulates one random motion; returns (fault, joint, Outcome) of each of its trials."""
    name, use, seed, faults = task
    generator, arm = np.random.default_rng(seed), load_arm(name)
    noise = int(generator.integers(2**31))
    simulated = FaultyArm(name, use, path=None if use == "hold" else random_motion(arm, generator), seed=noise)
    trials = []
    for begin in np.sort(generator.uniform(BEGIN, END, PER_MOTION)):
        while simulated.ticks * PERIOD < begin:
            simulated.step()
        if use != "hold" and simulated.guard.state not in ACTING:
            print(f"{name}, {use}, seed {seed}: no command acts: {simulated.guard.fault_text}", flush=True)
            break
        fault, joint = str(generator.choice(faults)), int(generator.integers(arm.num_joints))
        outcome = in_fork(lambda f=fault, j=joint: simulated.fail(f, j, simulated.ticks * PERIOD, AFTER))
        trials.append((fault, joint, outcome))
        print(
            f"{name}, {use}, seed {seed}, {begin:.3f} s, {fault}, joint {joint + 1}: {outcome}",
            file=sys.stderr,
            flush=True,
        )
    return trials


def summary(arm, trials, displacements=True) -> str:
    """Returns the cells of a row: found, and the median and the largest value of each quantity."""
    found = [o for _, _, o in trials if np.isfinite(o.detected)]
    columns = [([1e3 * o.detected for o in found], "{:.0f}")]
    if displacements:
        columns += [([o.before for _, _, o in trials], "{:.3f}"), ([o.after for o in found], "{:.3f}")]
    for joints, form in ((~arm.prismatic, "{:.1f}"), (arm.prismatic, "{:.2f}")):
        columns.append(([np.max(o.speed[joints]) for o in found if joints.any()], form))
    cells = [f"{len(found)}/{len(trials)}"]
    for values, form in columns:
        cells += [form.format(x) for x in (np.median(values), max(values))] if values else ["-", "-"]
    return " | ".join(cells)


def print_tables(name, trials_by_use) -> None:
    """Prints one row per use and group of joints, one row per fault, and the slowest detections."""
    arm = load_arm(name)
    every = [trial for trials in trials_by_use.values() for trial in trials]
    speeds = "speed: median | max | prismatic: median | max |"
    moved = "before: median | max | after: median | max | "
    print(f"\n{name}: {len(every)} random trials\n\n| use, joints | found | ms: median | max | {moved}{speeds}")
    print("|" + 12 * "---|")
    # The first three joints carry the others. Displacements of revolute and prismatic joints have different units.
    groups = [
        [j for j in part if arm.prismatic[j] == kind]
        for part in (range(3), range(3, arm.num_joints))
        for kind in (0, 1)
    ]
    for use, trials in trials_by_use.items():
        for joints in filter(None, groups):
            label = ", ".join(str(j + 1) for j in joints)
            print(f"| {use}, {label} | {summary(arm, [t for t in trials if t[1] in joints])} |")
    print(f"\n| fault | found | ms: median | max | {speeds}\n|" + 8 * "---|")
    for fault in FAULTS:
        if rows := [t for t in every if t[0] == fault]:
            print(f"| {fault} | {summary(arm, rows, displacements=False)} |")
    print("\nslowest detections and undetected faults:")
    for fault, joint, o in sorted(every, key=lambda t: -t[2].detected)[:12]:
        print(f"{fault:18} {arm.joint_names[joint]:16} {1e3 * o.detected:6.0f} ms  before {o.before:.2f}  {o.text}")
    sys.stdout.flush()


def delay_trial(task) -> str:
    """Simulates one delay; returns the line of the table."""
    name, use, milliseconds, joint = task
    simulated = FaultyArm(name, use)
    arm = simulated.arm
    scale, speeds = arm.per_joint(1.0, 0.1), []

    def run(seconds, until_fault=False) -> Iterator[float]:
        end = simulated.ticks + round(seconds / PERIOD)
        while simulated.ticks < end:
            if until_fault and simulated.guard.state == lcmt_dvrk_status.STATE_FAULT:
                return
            simulated.step()
            yield float(np.max(np.abs(simulated.state()[1]) / scale))

    list(run(DELAY_BEGIN))
    simulated.sensors.delays[slice(None) if joint is None else joint] = milliseconds
    speeds = list(run(DELAY_PATIENCE, until_fault=True))
    fault, before = simulated.guard.fault_text or "no fault", max(speeds[-200:], default=0.0)
    after = list(run(DELAY_AFTER))
    where = "all joints" if joint is None else arm.joint_names[joint]
    speed = f"{before:.2f} | {max(after):.2f} | {max(after[-500:]):.3f}"
    return f"| {name} | {use} | {where} | {milliseconds} | {speed} | {fault} |"


def main() -> None:
    """Prints the tables."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--arms", nargs="+", default=["mtml", "psm"], help="names of the arms; default: %(default)s")
    parser.add_argument("--uses", nargs="+", default=["effort", "position"], help="uses to simulate")
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), help="sensor faults to simulate")
    parser.add_argument("--trials", type=int, default=300, help="number of trials per arm; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random sample; default: %(default)s")
    parser.add_argument("--delays", type=int, nargs="+", help="delays of positions and velocities [ms]")
    parser.add_argument("--all-joints", action="store_true", help="with --delays: delay only all joints together")
    parser.add_argument("--processes", type=int, default=2, help="number of parallel processes; default: %(default)s")
    options = parser.parse_args()
    if options.delays:
        print("Largest speed of any joint [rad/s, 0.1 m/s] before and after the fault, and 2.5 s after the fault\n")
        print("| arm | use | delayed | delay [ms] | before | after | 2.5 s after | fault |")
        print("|---|---|---|---|---|---|---|---|")
        for name in options.arms:
            joints = [None] if options.all_joints else [None, *range(load_arm(name).num_joints)]
            tasks = [(name, use, d, j) for use in options.uses for d in options.delays for j in joints]
            with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
                for line in pool.imap(delay_trial, tasks):
                    print(line, flush=True)
        return
    for name in options.arms:
        motions = -(-options.trials // (PER_MOTION * len(options.uses)))
        trials = {}
        for k, use in enumerate(options.uses):
            tasks = [(name, use, (options.seed, k, motion), options.faults) for motion in range(motions)]
            # A thread waits for each process. The processes of a Pool could not fork.
            with ThreadPoolExecutor(options.processes) as pool:
                results = pool.map(lambda task: in_fork(lambda: motion_trials(task)), tasks)
                trials[use] = [trial for result in results for trial in result]
        print_tables(name, trials)


if __name__ == "__main__":
    main()
