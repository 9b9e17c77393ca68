"""What each effect of a real arm costs: time of a simulated step, as a ratio to the arm without effects.

    python benchmarks/honest_arm.py [--arm NAME] [--closure mimic|ball] [--repetitions N] [--json FILE]

All rows simulate the same ArmStation at 1 kHz under GravityPidController ("hold"), which follows one slow cubic in all
joints, so that friction slips and sticks. Rows: the ideal arm, the machinery of effects without any, each part alone,
all of them. Repetitions are interleaved, so that a busy machine slows all rows alike; times are CPU time of this
process, the least over the repetitions. `real time` is simulated time over CPU time.

A third of a step is Drake's allocations. With GLIBC_TUNABLES=glibc.malloc.tcache_count=2000 in the environment glibc
answers them from its caches, and a step takes about a tenth less.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.effects_schema import EFFECT_NAMES
from dvrk_drake.models.plant import Closure
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

SECONDS = 0.5


def start(arm: Arm, parts: list[str] | None, closure: Closure) -> Simulator:
    low, high = arm.position_lower, arm.position_upper
    ends = np.array([0.55 * low + 0.45 * high, 0.45 * low + 0.55 * high]).T
    trajectory = PiecewisePolynomial.CubicHermite([0.0, 1.0 + SECONDS], ends, np.zeros_like(ends))
    effects = None if parts is None else arm.effects.only(parts)
    station = ArmStation(arm, closure=closure, effects=effects)
    builder = DiagramBuilder()
    controller = GravityPidController(IdentifiedModel.from_arm(arm))
    add_closed_loop(builder, station, controller, TrajectorySource(trajectory, output_derivative_order=1))
    simulator = Simulator(builder.Build())
    station.set_positions(station.GetMyMutableContextFromRoot(simulator.get_mutable_context()), ends[:, 0])
    simulator.Initialize()
    simulator.AdvanceTo(0.1)
    return simulator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="mtml")
    parser.add_argument("--closure", default="mimic", choices=["mimic", "ball"])
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--json", default="")
    args = parser.parse_args()
    arm = load_arm(args.arm)
    rows: dict[str, list[str] | None] = {
        "ideal": None,
        "none": [],
        **{name: [name] for name in EFFECT_NAMES if getattr(arm.effects, name)},
    }
    rows["all"] = ["all"]
    best = dict.fromkeys(rows, np.inf)
    for _ in range(args.repetitions):
        for row, parts in rows.items():
            simulator = start(arm, parts, args.closure)
            began = time.process_time()
            simulator.AdvanceTo(0.1 + SECONDS)
            best[row] = min(best[row], time.process_time() - began)
    print(f"{arm.name}, {args.closure}: {'effects':<12} us/step   ratio   real time")
    for row, seconds in best.items():
        print(f"{row:>24} {1e3 * seconds / SECONDS:10.1f} {seconds / best['ideal']:7.2f} {SECONDS / seconds:9.1f} x")
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump({row: seconds / SECONDS for row, seconds in best.items()}, file, indent=2)


if __name__ == "__main__":
    main()
