"""Counts false alarms of the guard during normal use of simulated arms with all effects of their files.

    python benchmarks/false_alarms.py [--minutes 30] [--processes 2]

A use is a combination of arm, control mode and motion. The output has one line per use. If the guard held the arm or
reported a fault, the line contains the reason. Collections use the Collector of `dvrk-drake collect`. In teleoperation
a simulated hand moves an MTML, and a PSM follows.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
import time
from argparse import ArgumentParser
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from faulty_arm import PERIOD, FaultyArm, wave

from dvrk_drake.analysis.excitation.pose_file import CollectionFile
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.processes.collector import CollectionSettings, Collector
from dvrk_drake.systems.teleoperation import Teleoperation

#: By use: arm, control, maximum speed [rad/s; 0.1 m/s], amplitude as a share of half of each range, whether a hand
#: moves the arm, and weight in the total time.
USES = {
    "hold, no commands": ("mtml", "hold", 0.5, 0.35, False, 1),
    "gravity compensation, hand at 0.5 rad/s": ("mtml", "gravity", 0.5, 0.35, True, 4),
    "gravity compensation, hand at 1.5 rad/s": ("mtml", "gravity", 1.5, 0.35, True, 3),
    "gravity compensation, hand into the walls": ("mtml", "gravity", 0.7, 1.05, True, 2),
    "damped, hand at 0.5 rad/s": ("mtml", "damped", 0.5, 0.35, True, 1),
    "guide, hand at 0.5 rad/s": ("mtml", "guide", 0.5, 0.35, True, 2),
    "guide, hand at 1.5 rad/s": ("mtml", "guide", 1.5, 0.35, True, 2),
    "PID and gravity, 0.5 rad/s": ("mtml", "effort", 0.5, 0.35, False, 2),
    "PID and gravity, 1.5 rad/s": ("mtml", "effort", 1.5, 0.5, False, 2),
    "positions, 1.5 rad/s": ("mtml", "position", 1.5, 0.5, False, 2),
    "collection, MTML": ("mtml", "collect", 0.0, 0.0, False, 4),
    "PSM, PID and gravity, 0.5 rad/s": ("psm", "effort", 0.5, 0.35, False, 2),
    "PSM, positions, 1.5 rad/s": ("psm", "position", 1.5, 0.5, False, 2),
    "collection, PSM": ("psm", "collect", 0.0, 0.0, False, 3),
    "teleoperation, hand at 0.3 rad/s": ("mtml", "teleoperation", 0.3, 0.2, True, 4),
}

#: Maximum holding effort in poses of a collection, as a share of the effort limit.
MAX_HOLDING_SHARE = 0.7


def alarm(guard):
    """Returns the reason of a fault or of a watchdog hold; "" for neither."""
    return guard.fault_text or guard.hold_reason


def run(use, seconds):
    """Simulates one use; returns the simulated time [s] and the reason of an alarm, "" for none."""
    name, kind, speed, reach, hand, _ = USES[use]
    arm = load_arm(name)
    if kind == "collect":
        return collect(arm, seconds)
    path = wave(arm, seconds + 1.0, speed, reach=reach) if reach else None
    if kind == "teleoperation":
        return teleoperate(path, seconds)
    simulated = FaultyArm(name, kind, path=path, hand=hand)
    return step(simulated, seconds)


def step(arm, seconds, check=lambda: "", until=lambda: False):
    """Simulates an arm for `seconds`, or until a guard alarm, a text from `check` or a true `until`; see `run`."""
    acted = False
    while arm.ticks * PERIOD < seconds and not until():
        arm.step()
        acted |= arm.guard.state in (lcmt_dvrk_status.STATE_EFFORT, lcmt_dvrk_status.STATE_POSITION)
        if problem := alarm(arm.guard) or check():
            return arm.ticks * PERIOD, problem
    idle = arm.controller is not None and not acted
    return arm.ticks * PERIOD, "no effort or position command was accepted" if idle else ""


def collect(arm, seconds):
    """Simulates a collection of random poses with low holding efforts; see `run`."""
    simulated = FaultyArm(arm.name.lower(), "effort")
    poses = arm.sample_poses(400, np.random.default_rng(1), margin=0.1)
    needed = np.abs(simulated.model.holding_torque(poses)) + arm.dry_friction()
    poses = poses[(needed < MAX_HOLDING_SHARE * arm.effort_limits).all(axis=1)]
    with tempfile.TemporaryDirectory() as folder:
        collector = Collector(
            poses,
            simulated.controller,
            CollectionFile(Path(folder) / "poses.csv", arm, True),
            CollectionSettings(),
        )
        simulated.on_status = collector.update
        result = step(simulated, seconds, check=lambda: str(collector.problem or ""), until=lambda: collector.finished)
        collector.close()
    print(f"{arm.name}: {np.count_nonzero(collector.done)} poses measured", flush=True)
    return result


def teleoperate(path, seconds):
    """Simulates teleoperation: a hand moves an MTML, and a PSM follows with position commands; see `run`."""
    master, follower = FaultyArm("mtml", "gravity", path=path, hand=True), FaultyArm("psm", "position")
    law = Teleoperation(master.arm, follower.arm)
    context = law.CreateDefaultContext()
    desired = np.concatenate([follower.start, np.zeros(follower.arm.num_joints)])
    follower.desired = lambda time: desired

    def step_follower():
        nonlocal desired
        now = master.ticks * PERIOD
        inputs = {
            "master_position": master.state()[0],
            "follower_position": follower.state()[0],
            "engaged": [float(now > 2.0)],
            "jaw_angle": [0.5],
        }
        for port, value in inputs.items():
            law.GetInputPort(port).FixValue(context, value)
        context.get_mutable_discrete_state().SetFrom(law.EvalUniquePeriodicDiscreteUpdate(context))
        follower_desired = law.GetOutputPort("desired_state").Eval(context)
        if now > 2.0 and np.all(np.isfinite(follower_desired)):
            desired = follower_desired.copy()
        follower.step()
        return alarm(follower.guard)

    return step(master, seconds, step_follower)


def task(arguments):
    """Simulates one use in a separate process and prints the line of this use."""
    use, seconds = arguments
    start = time.monotonic()
    simulated, problem = run(use, seconds)
    print(
        f"{use:44} {simulated:7.1f} s simulated in {time.monotonic() - start:6.1f} s: {problem or 'no alarm'}",
        flush=True,
    )
    return simulated, problem


def main():
    """Prints one line per use, and the number of alarms."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="total simulated time [min]; default: 30")
    parser.add_argument("--processes", type=int, default=2, help="number of parallel processes; default: %(default)s")
    parser.add_argument("--uses", nargs="+", default=list(USES), choices=USES, metavar="USE", help="uses; default: all")
    arguments = parser.parse_args()
    weight = sum(USES[use][-1] for use in arguments.uses)
    tasks = [(use, 60.0 * arguments.minutes * USES[use][-1] / weight) for use in arguments.uses]
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        results = pool.map(task, tasks, chunksize=1)
    alarms = sum(bool(problem) for _, problem in results)
    minutes = sum(seconds for seconds, _ in results) / 60
    print(f"{minutes:.1f} simulated minutes; uses with a false alarm: {alarms}")
    return int(alarms > 0)


if __name__ == "__main__":
    sys.exit(main())
