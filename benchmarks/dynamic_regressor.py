"""Compares the computing time of our dynamic regressor with that of Pinocchio's computeJointTorqueRegressor.

    make benchmark        or        pip install '.[benchmark]' && python benchmarks/dynamic_regressor.py [--json FILE]

Pinocchio's model contains the linkage and the instrument as a tree. Before the timing, the script checks that both
libraries compute equal torques. For this check, it multiplies Pinocchio's torques by the linkage matrix. Pinocchio has
no batch function, so a Python loop calls it for each sample, and each sample overwrites the previous regressor. Our
function returns the regressors of all samples. Our function is timed with preallocated memory ("ours") and with new
memory in each call.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import pinocchio
from numpy.typing import NDArray
from pinocchio_arm import build_pinocchio, regressor_loop
from timing import measured_times, median_ratio, print_table, write_json

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant


def tree_motion(arm: Arm, model: pinocchio.Model, motion: list[NDArray]) -> tuple[list[NDArray], NDArray]:
    """Returns q, v, vd (m, t) and the linkage matrix G (t, n) in the order of Pinocchio's joints."""
    order = [arm.tree_joint_names.index(name) for name in model.names[1:]]
    q, v, vd = motion
    linkage = arm.linkage
    tree = [linkage.position(q), linkage.velocity(v), linkage.velocity(vd)]
    return [np.ascontiguousarray(x[:, order]) for x in tree], linkage.matrix[order]


def assert_same_torque(ours: DynamicRegressor, model: pinocchio.Model, motion: list[NDArray]) -> None:
    data = model.createData()
    tree, G = tree_motion(ours.arm, model, motion)
    reference = np.array([pinocchio.rnea(model, data, *sample) for sample in zip(*tree, strict=True)]) @ G
    without_rotors = ours.values.copy()
    without_rotors[10 * len(ours.links) :] = 0.0
    np.testing.assert_allclose(ours.torque(*motion, without_rotors), reference, rtol=0, atol=1e-10)


def benchmark(name: str, samples: int, repetitions: int) -> dict[str, float]:
    arm = load_arm(name)
    plant = make_arm_plant(arm)
    start = time.perf_counter()
    ours = DynamicRegressor(arm)
    generator = np.random.default_rng(0)
    q = arm.sample_poses(samples, generator)
    motion = [q, generator.normal(0, 1, q.shape), generator.normal(0, 5, q.shape)]
    ours.regressor(*(x[:1] for x in motion))
    result = {"first_call_s": time.perf_counter() - start}

    tree = build_pinocchio(arm, plant, arm.tree_joint_names)
    assert_same_torque(ours, tree, [x[:200] for x in motion])
    Y = np.empty((*q.shape, len(ours.names)))
    functions = {
        "ours": lambda: ours.regressor(*motion, out=Y),
        "ours, into new memory": lambda: ours.regressor(*motion),
        "Pinocchio, all links": regressor_loop(tree, tree_motion(arm, tree, motion)[0]),
    }
    driven = {plant.GetJointByName(joint).child_body().name() for joint in arm.joint_names}
    bases = {plant.GetJointByName(joint).parent_body().name() for joint in arm.joint_names}
    if bases <= driven | {"base_link"}:  # the independent joints are a serial chain, as in an MTM
        chain = build_pinocchio(arm, plant, arm.joint_names)
        functions["Pinocchio, chain without linkage"] = regressor_loop(chain, motion)
    times = measured_times(functions, repetitions)
    rows = {}
    for what, seconds in times.items():
        result[f"{what}_us"] = 1e6 * float(np.median(seconds)) / samples
        result[f"{what}_ratio"] = median_ratio(times, what, "Pinocchio, all links")
        rows[what] = (f"{result[f'{what}_us']:.3f}", f"{result[f'{what}_ratio']:.3f}")
    print_table(
        f"{arm.name}: CPU time of the dynamic regressor ({len(ours.links)} links, {len(ours.names)} columns, {samples} "
        f"samples); time of the first call {result['first_call_s']:.2f} s",
        ["us per sample", "ratio to Pinocchio, all links"],
        rows,
    )
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help="write the results to this file")
    parser.add_argument("--samples", type=int, default=6000, help="number of samples; default: %(default)s")
    parser.add_argument("--repetitions", type=int, default=15, help="number of repetitions; default: %(default)s")
    options = parser.parse_args()
    write_json(options.json, {name: benchmark(name, options.samples, options.repetitions) for name in ("mtml", "psm")})


if __name__ == "__main__":
    main()
