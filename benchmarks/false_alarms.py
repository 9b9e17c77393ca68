"""Half an hour of normal use on simulated arms with all effects of their files: the guard must not interfere.

    python benchmarks/false_alarms.py [--minutes 30] [--processes 2]

Each line is one use, and what the guard reported if it took over or found a fault. Collections run the Collector of
`dvrk-drake collect`; in teleoperation a hand moves an MTML that leads a PSM.
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

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import load_arm
from dvrk_drake.processes.collector import CollectionSettings, Collector
from dvrk_drake.recordings.pose_file import CollectionFile
from dvrk_drake.systems.teleoperation import Teleoperation

#: Use -> arm, control, speed [rad/s; a tenth in m/s], reach, whether a hand moves it, and weight in the whole time.
USES = {
    "hold, no commands": ("mtml", "hold", 0.5, 0.35, False, 1),
    "gravity compensation, hand at 0.5 rad/s": ("mtml", "gravity", 0.5, 0.35, True, 4),
    "gravity compensation, hand at 1.5 rad/s": ("mtml", "gravity", 1.5, 0.35, True, 3),
    "gravity compensation, hand into the walls": ("mtml", "gravity", 0.7, 1.05, True, 2),
    "damped, hand at 0.5 rad/s": ("mtml", "damped", 0.5, 0.35, True, 1),
    "PID and gravity, 0.5 rad/s": ("mtml", "effort", 0.5, 0.35, False, 2),
    "PID and gravity, 1.5 rad/s": ("mtml", "effort", 1.5, 0.5, False, 2),
    "positions, 1.5 rad/s": ("mtml", "position", 1.5, 0.5, False, 2),
    "collection, MTML": ("mtml", "collect", 0.0, 0.0, False, 4),
    "PSM, PID and gravity, 0.5 rad/s": ("psm", "effort", 0.5, 0.35, False, 2),
    "PSM, positions, 1.5 rad/s": ("psm", "position", 1.5, 0.5, False, 2),
    "collection, PSM": ("psm", "collect", 0.0, 0.0, False, 3),
    "teleoperation, hand at 0.3 rad/s": ("mtml", "teleoperation", 0.3, 0.2, True, 4),
}

#: Part of the effort limits that poses of a collection may need. At some, a wrist pitch needs more than its limit.
STRENGTH = 0.7


def interference(guard):
    """Returns the reason of a fault or a watchdog hold, or ""."""
    return guard.fault_text or guard.hold_reason


def run(use, seconds):
    """Simulates one use; returns the simulated time [s] and what went wrong, or ""."""
    name, kind, speed, reach, hand, _ = USES[use]
    arm = load_arm(name)
    if kind == "collect":
        return collect(arm, seconds)
    path = wave(arm, seconds + 1.0, speed, reach=reach) if reach else None
    if kind == "teleoperation":
        return teleoperate(path, seconds)
    simulated = FaultyArm(name, kind, path=path, hand=hand)
    return step(simulated, seconds)


def step(arm, seconds, also=lambda: "", until=lambda: False):
    """Steps an arm until the guard interferes or the time has passed."""
    acted = False
    while arm.ticks * PERIOD < seconds and not until():
        arm.step()
        acted |= arm.guard.state in (lcmt_dvrk_status.STATE_EFFORT, lcmt_dvrk_status.STATE_POSITION)
        if problem := interference(arm.guard) or also():
            return arm.ticks * PERIOD, problem
    idle = arm.controller is not None and not acted
    return arm.ticks * PERIOD, "no command acted" if idle else ""


def collect(arm, seconds):
    """A collection of random poses, those that the motors can hold."""
    simulated = FaultyArm(arm.name.lower(), "effort")
    poses = arm.sample_poses(400, np.random.default_rng(1), margin=0.1)
    needed = np.abs(simulated.model.holding_torque(poses)) + arm.dry_friction()
    poses = poses[(needed < STRENGTH * arm.effort_limits).all(axis=1)]
    with tempfile.TemporaryDirectory() as folder:
        collector = Collector(
            poses,
            simulated.controller,
            CollectionFile(Path(folder) / "poses.csv", arm, True),
            CollectionSettings(),
        )
        simulated.on_status = collector.update
        result = step(simulated, seconds, also=lambda: str(collector.problem or ""), until=lambda: collector.finished)
        collector.close()
    print(f"{arm.name}: {np.count_nonzero(collector.done)} poses measured", flush=True)
    return result


def teleoperate(path, seconds):
    """An MTML in a hand leads a PSM by position commands."""
    master, follower = FaultyArm("mtml", "gravity", path=path, hand=True), FaultyArm("psm", "position")
    law = Teleoperation(master.arm, follower.arm)
    context = law.CreateDefaultContext()
    desired = np.concatenate([follower.start, np.zeros(follower.arm.num_joints)])
    follower.desired = lambda time: desired

    def also():
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
        wanted = law.GetOutputPort("desired_state").Eval(context)
        if now > 2.0 and np.all(np.isfinite(wanted)):
            desired = wanted.copy()
        follower.step()
        return interference(follower.guard)

    return step(master, seconds, also)


def task(arguments):
    """Runs one use in a process of its own."""
    use, seconds = arguments
    start = time.monotonic()
    simulated, problem = run(use, seconds)
    print(
        f"{use:44} {simulated:7.1f} s in {time.monotonic() - start:6.1f} s  {problem or 'no interference'}", flush=True
    )
    return simulated, problem


def main():
    """Prints a line for each use, and the sum."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--uses", nargs="+", default=list(USES))
    arguments = parser.parse_args()
    weight = sum(USES[use][-1] for use in arguments.uses)
    tasks = [(use, 60.0 * arguments.minutes * USES[use][-1] / weight) for use in arguments.uses]
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        results = pool.map(task, tasks, chunksize=1)
    alarms = sum(bool(problem) for _, problem in results)
    minutes = sum(seconds for seconds, _ in results) / 60
    print(f"{minutes:.1f} simulated minutes, {alarms} uses in which the guard interfered")
    return int(alarms > 0)


if __name__ == "__main__":
    sys.exit(main())
