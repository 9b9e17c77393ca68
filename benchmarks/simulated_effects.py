"""Time of a simulated step with each effect, as a ratio to the arm without effects.

    python benchmarks/simulated_effects.py [--arm NAME] [--closure mimic|ball] [--repetitions N] [--json FILE]

All rows simulate the same ArmStation at 1 kHz under GravityPidController ("hold"), which follows one slow cubic in all
joints, so that friction slips and sticks. Rows: the ideal arm, the machinery of effects without any, each part alone,
all that the arm's file states, and these with cables that stretch. No file states any of those, so here each actuator
that can have one has one that gives STRETCH under the motor's largest effort. Repetitions are interleaved, so that a
busy machine slows all rows alike; times are CPU time of this process, the least over the repetitions. `real time` is
simulated time over CPU time.

A third of a step is memory allocation in Drake. A faster allocator is selected by LD_PRELOAD or GLIBC_TUNABLES, see
docs/simulated_effects.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import os

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from timing import measured_times, print_table, write_json

from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.effects_schema import EFFECT_NAMES, ArmEffects, Cable
from dvrk_drake.models.loop_closure import Closure
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

SECONDS = 0.5
#: Of a cable under the motor's largest effort [rad], and its damping over its stiffness [s].
STRETCH, RELAXATION = 5e-3, 1e-3


def with_cables(arm: Arm) -> ArmEffects:
    """The arm's effects, and a cable that stretches at each actuator that turns one joint alone."""
    cables = {}
    for i, name in enumerate(arm.joint_names):
        if not arm.prismatic[i] and np.array_equal(joint_row(arm, f"actuator.{name}"), np.eye(arm.num_joints)[i]):
            stiffness = arm.effects.saturation[name] / STRETCH
            cables[name] = Cable(stiffness, RELAXATION * stiffness)
    return dataclasses.replace(arm.effects, stretch=cables)


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
    parser.add_argument("--arm", default="mtml")
    parser.add_argument("--closure", default="mimic", choices=["mimic", "ball"])
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--json", default="")
    args = parser.parse_args()
    arm = load_arm(args.arm)
    effects, stretching = arm.effects, with_cables(arm)
    cables = f"{len(stretching.stretch)} cables stretch"
    rows: dict[str, ArmEffects | None] = {
        "ideal": None,
        "none": ArmEffects(),
        **{name: effects.only([name]) for name in EFFECT_NAMES if getattr(effects, name)},
        cables: stretching.only(["stretch"]),
        "all": effects,
        f"all, {cables}": stretching,
    }
    ready: dict[str, Simulator] = {}
    times = measured_times(
        {row: lambda row=row: ready[row].AdvanceTo(0.1 + SECONDS) for row in rows},
        args.repetitions,
        prepare=lambda row: ready.update({row: start(arm, rows[row], args.closure)}),
    )
    best = {row: float(np.min(seconds)) for row, seconds in times.items()}
    allocator = os.environ.get("LD_PRELOAD") or os.environ.get("GLIBC_TUNABLES") or "the system's"
    print_table(
        f"{arm.name}, {args.closure}; allocator: {allocator}",
        ["us per step", "to ideal", "real time"],
        {
            row: (f"{1e3 * seconds / SECONDS:.1f}", f"{seconds / best['ideal']:.2f}", f"{SECONDS / seconds:.1f} x")
            for row, seconds in best.items()
        },
    )
    write_json(args.json, {row: seconds / SECONDS for row, seconds in best.items()})


if __name__ == "__main__":
    main()
