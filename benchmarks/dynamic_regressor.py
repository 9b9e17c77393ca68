"""Our dynamic regressor beside Pinocchio's computeJointTorqueRegressor, same arm, same links, same run.

Pinocchio's model is built from the Drake plant's own joints and inertias, linkage and instrument included, as a tree;
its torques must equal ours (projected through the linkage) before anything is timed. It is called sample by sample in a
Python loop, for it has no batch, and each sample overwrites the last; ours keeps the regressor of all samples, and is
timed writing to the same memory each time as Pinocchio does ("ours"), and to new memory. Run:

    make benchmark        or        pip install '.[benchmark]' && python benchmarks/dynamic_regressor.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from timing import measured_times

from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.plant import make_arm_plant

JOINT_MODELS = {
    "revolute": lambda joint: pinocchio.JointModelRevoluteUnaligned(joint.revolute_axis()),
    "prismatic": lambda joint: pinocchio.JointModelPrismaticUnaligned(joint.translation_axis()),
}


def build_pinocchio(arm: Arm, plant: MultibodyPlant, joint_names: list[str]) -> pinocchio.Model:
    """Pinocchio's model of the links that these joints move; each link's frame is its joint's, parallel to the base."""
    context = plant.CreateDefaultContext()
    model = pinocchio.Model()
    model.gravity.linear = arm.gravity
    joints = {name: plant.GetJointByName(name) for name in joint_names}
    index_of: dict[str, int] = {}
    while joints:
        for name, joint in list(joints.items()):
            parent = joint.parent_body().name()
            if any(parent == other.child_body().name() for other in joints.values()):
                continue
            p = joint.frame_on_parent().CalcPose(context, joint.parent_body().body_frame()).translation()
            model_of_joint = JOINT_MODELS[joint.type_name()](joint)
            index = model.addJoint(index_of.get(parent, 0), model_of_joint, pinocchio.SE3(np.eye(3), p), name)
            index_of[joint.child_body().name()] = index
            M = joint.child_body().default_spatial_inertia()
            I_BBcm = M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
            inertia = pinocchio.Inertia(M.get_mass(), M.get_com(), I_BBcm)
            model.appendBodyToJoint(index, inertia, pinocchio.SE3.Identity())
            del joints[name]
    return model


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


def pinocchio_loop(model: pinocchio.Model, motion: list[NDArray]) -> Callable[[], None]:
    data = model.createData()

    def run() -> None:
        for q, v, vd in zip(*motion, strict=True):
            pinocchio.computeJointTorqueRegressor(model, data, q, v, vd)

    return run


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

    tree = build_pinocchio(arm, plant, list(arm.tree_joint_names))
    assert_same_torque(ours, tree, [x[:200] for x in motion])
    Y = np.empty((*q.shape, len(ours.names)))
    functions = {
        "ours": lambda: ours.regressor(*motion, out=Y),
        "ours, into new memory": lambda: ours.regressor(*motion),
        "pinocchio, all links": pinocchio_loop(tree, tree_motion(arm, tree, motion)[0]),
    }
    driven = {plant.GetJointByName(joint).child_body().name() for joint in arm.joint_names}
    bases = {plant.GetJointByName(joint).parent_body().name() for joint in arm.joint_names}
    if bases <= driven | {"base_link"}:  # the independent joints are a chain, as on an MTM: fewer links, less to do
        chain = build_pinocchio(arm, plant, list(arm.joint_names))
        functions["pinocchio, chain without linkage"] = pinocchio_loop(chain, motion)
    times = measured_times(functions, repetitions)
    for what, seconds in times.items():
        result[f"{what}_us"] = 1e6 * float(np.median(seconds)) / samples
        result[f"{what}_ratio"] = float(np.median(times["ours"] / seconds))
    columns = len(ours.names)
    print(f"{arm.name}: {len(ours.links)} links, {columns} columns, {samples} samples; first call ", end="")
    print(f"{result['first_call_s']:.2f} s (compiled code is kept on disk)")
    for what in times:
        print(f"  {what:<34}{result[f'{what}_us']:8.3f} us a sample   ours / this {result[f'{what}_ratio']:6.3f}")
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--samples", type=int, default=6000)
    parser.add_argument("--repetitions", type=int, default=15)
    options = parser.parse_args()
    result = {name: benchmark(name, options.samples, options.repetitions) for name in ("mtml", "psm")}
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
