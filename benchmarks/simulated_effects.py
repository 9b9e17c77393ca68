"""Measures the computing time of a simulation step with each effect of a real arm.

    python benchmarks/simulated_effects.py [--arm NAME] [--closure mimic|ball] [--repetitions N] [--json FILE]

All rows simulate the same ArmStation at 1 kHz. A GravityPidController in mode "hold" moves all joints along a slow
cubic trajectory, so that friction sticks and slips. Rows:

    ideal               arm without effects
    none                arm with an empty set of effects, but with the system that computes effects
    friction, ...       one effect of the arm's file
    all                 all effects of the arm's file

The repetitions of the rows alternate, so that other processes slow all rows equally. Times are CPU times of this
process, minima over the repetitions. The real-time factor is simulated time divided by CPU time.

The result depends on the memory allocator. To select a faster allocator, see docs/simulated_effects.md.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from timing import measured_times, print_table, write_json

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import EFFECT_NAMES, ArmEffects
from dvrk_drake.models.plant import Closure
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

SECONDS = 0.5


def start(arm: Arm, effects: ArmEffects | None, closure: Closure) -> Simulator:
    low, high = arm.position_lower, arm.position_upper
    ends = np.array([0.55 * low + 0.45 * high, 0.45 * low + 0.55 * high]).T
    trajectory = PiecewisePolynomial.CubicHermite([0.0, 1.0 + SECONDS], ends, np.zeros_like(ends))
    station = ArmStation(arm, closure=closure, effects=effects)
    builder = DiagramBuilder()
    controller = GravityPidController(IdentifiedModel.from_arm(arm))
    add_closed_loop(builder, station, controller, TrajectorySource(trajectory, output_derivative_order=1))
    simulator = Simulator(builder.Build())
    station.SetPositions(station.GetMyMutableContextFromRoot(simulator.get_mutable_context()), ends[:, 0])
    simulator.Initialize()
    simulator.AdvanceTo(0.1)
    return simulator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="mtml", help="name of the arm; default: %(default)s")
    parser.add_argument(
        "--closure",
        default="mimic",
        choices=["mimic", "ball"],
        help="method for closing the loops of the linkage; default: %(default)s",
    )
    parser.add_argument("--repetitions", type=int, default=7, help="number of repetitions; default: %(default)s")
    parser.add_argument("--json", default="", help="write the results to this file")
    args = parser.parse_args()
    arm = load_arm(args.arm)
    effects = arm.effects
    rows: dict[str, ArmEffects | None] = {
        "ideal": None,
        "none": ArmEffects(),
        **{name: effects.only([name]) for name in EFFECT_NAMES if getattr(effects, name)},
        "all": effects,
    }
    ready: dict[str, Simulator] = {}
    times = measured_times(
        {row: lambda row=row: ready[row].AdvanceTo(0.1 + SECONDS) for row in rows},
        args.repetitions,
        prepare=lambda row: ready.update({row: start(arm, rows[row], args.closure)}),
    )
    best = {row: float(np.min(seconds)) for row, seconds in times.items()}
    allocator = os.environ.get("LD_PRELOAD") or os.environ.get("GLIBC_TUNABLES") or "of the system"
    print_table(
        f"{arm.name}, closure {args.closure}, allocator {allocator}: CPU time per step of 1 ms",
        ["time [us]", "ratio to ideal", "real-time factor"],
        {
            row: (f"{1e3 * seconds / SECONDS:.1f}", f"{seconds / best['ideal']:.2f}", f"{SECONDS / seconds:.1f}")
            for row, seconds in best.items()
        },
    )
    write_json(args.json, {row: seconds / SECONDS for row, seconds in best.items()})


if __name__ == "__main__":
    main()
