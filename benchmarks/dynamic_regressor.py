"""Our dynamic regressor beside Pinocchio's computeJointTorqueRegressor, same arm, same links, same run.

Pinocchio's model has linkage and instrument as a tree; its torques must equal ours (projected through the linkage)
before anything is timed. It is called sample by sample in a Python loop, for it has no batch, and each sample
overwrites the last. Ours keeps the regressor of all samples. It is timed writing to the same memory each time, as
Pinocchio does ("ours"), and to new memory. Run:

    make benchmark        or        pip install '.[benchmark]' && python benchmarks/dynamic_regressor.py [--json FILE]
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
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.plant import make_arm_plant


def tree_motion(arm: Arm, model: pinocchio.Model, motion: list[NDArray]) -> tuple[list[NDArray], NDArray]:
    """q, v, vd (m, t) in the order of Pinocchio's joints, and G (t, n) in that order."""
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
    if bases <= driven | {"base_link"}:  # the independent joints are a chain, as on an MTM: fewer links, less to do
        chain = build_pinocchio(arm, plant, arm.joint_names)
        functions["Pinocchio, chain without linkage"] = regressor_loop(chain, motion)
    times = measured_times(functions, repetitions)
    rows = {}
    for what, seconds in times.items():
        result[f"{what}_us"] = 1e6 * float(np.median(seconds)) / samples
        result[f"{what}_ratio"] = median_ratio(times, what, "Pinocchio, all links")
        rows[what] = (f"{result[f'{what}_us']:.3f}", f"{result[f'{what}_ratio']:.3f}")
    print_table(
        f"{arm.name}: {len(ours.links)} links, {len(ours.names)} columns, {samples} samples; first call "
        f"{result['first_call_s']:.2f} s (compiled code is kept on disk)",
        ["us per sample", "to Pinocchio, all links"],
        rows,
    )
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--samples", type=int, default=6000)
    parser.add_argument("--repetitions", type=int, default=15)
    options = parser.parse_args()
    write_json(options.json, {name: benchmark(name, options.samples, options.repetitions) for name in ("mtml", "psm")})


if __name__ == "__main__":
    main()
