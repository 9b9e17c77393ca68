"""Our compiled gravity regressor and torque beside Pinocchio's, same arm, same run.

Pinocchio's model is built from the Drake plant's own joints and masses; both must agree before anything is timed. Run:

    make benchmark        or        pip install '.[benchmark]' && python benchmarks/gravity_regressor.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import pinocchio
from pydrake.multibody.plant import MultibodyPlant
from timing import measured_times

from dvrk_drake.dynamics.gravity_regressor import derive_gravity
from dvrk_drake.dynamics.static_model import compile_static_model
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.plant import make_arm_plant


def build_pinocchio(arm: Arm, plant: MultibodyPlant) -> pinocchio.Model:
    """The serial chain of the independent joints; crank and coupler hang on the linkage, which it has not."""
    context = plant.CreateDefaultContext()
    model = pinocchio.Model()
    model.gravity.linear = arm.gravity
    parent, p_parent = 0, np.zeros(3)
    for name in arm.joint_names:
        joint = plant.GetJointByName(name)
        p = joint.frame_on_parent().CalcPoseInWorld(context).translation()
        axis = joint.revolute_axis()
        placement = pinocchio.SE3(np.eye(3), p - p_parent)
        index = model.addJoint(parent, pinocchio.JointModelRevoluteUnaligned(axis), placement, name)
        M = joint.child_body().default_spatial_inertia()
        I_Bo = M.CalcRotationalInertia().CopyToFullMatrix3()
        mass, com = M.get_mass(), M.get_com()
        I_Bcm = I_Bo - mass * (com @ com * np.eye(3) - np.outer(com, com))
        model.appendBodyToJoint(index, pinocchio.Inertia(mass, com, I_Bcm), pinocchio.SE3.Identity())
        parent, p_parent = index, p
    return model


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--poses", type=int, default=10_000)
    options = parser.parse_args()

    arm = load_arm("mtml")
    plant = make_arm_plant(arm)
    pin_model = build_pinocchio(arm, plant)
    pin_data = pin_model.createData()
    q = arm.sample_poses(options.poses, np.random.default_rng(0))
    zero = np.zeros(arm.num_joints)

    start = time.perf_counter()
    derive_gravity(arm)
    derivation = time.perf_counter() - start
    start = time.perf_counter()
    model = compile_static_model(arm)
    compilation = time.perf_counter() - start

    serial = derive_gravity(arm, serial=True)
    reference = np.array([pinocchio.computeGeneralizedGravity(pin_model, pin_data, pose) for pose in q[:200]])
    ours = model.torque(q[:200], serial.base_values)
    rotor = plant.GetBodyByName("motor_4_link").default_mass() * np.linalg.norm(arm.gravity)
    # Pinocchio's tree has no rotor of 1 g on the platform: that is all they may differ by.
    assert np.abs(ours - reference).max() < rotor * 0.7, np.abs(ours - reference).max()

    def pinocchio_regressors() -> None:
        for pose in q:
            pinocchio.computeJointTorqueRegressor(pin_model, pin_data, pose, zero, zero)

    calls = 20_000
    beta, out = model.gravity.base_values, np.empty(arm.num_joints)
    pose = q[0].copy()

    def single_ours() -> None:
        for _ in range(calls):
            model.torque_into(pose, beta, out)

    def single_pinocchio() -> None:
        for _ in range(calls):
            pinocchio.computeGeneralizedGravity(pin_model, pin_data, pose)

    model.regressor(q)
    batches = measured_times({"ours": lambda: model.regressor(q), "pinocchio": pinocchio_regressors}, 15)
    singles = measured_times({"ours": single_ours, "pinocchio": single_pinocchio}, 15)
    batch, single = ({k: float(np.median(v)) for k, v in times.items()} for times in (batches, singles))
    result = {
        "derivation_s": derivation,
        "compilation_s": compilation,
        "regressor_us_per_pose": {k: 1e6 * v / options.poses for k, v in batch.items()},
        "regressor_ratio": batch["ours"] / batch["pinocchio"],
        "gravity_us_per_call": {k: 1e6 * v / calls for k, v in single.items()},
        "gravity_ratio": single["ours"] / single["pinocchio"],
    }
    print(f"derivation {derivation:.2f} s, compilation {compilation:.2f} s (both once, not timed below)")
    print(f"{'':34}{'ours':>10}{'Pinocchio':>12}{'ratio':>8}")
    for label, key, unit in (
        (f"gravity regressor, {options.poses} poses", "regressor", "us_per_pose"),
        ("gravity torque, one call", "gravity", "us_per_call"),
    ):
        row = result[f"{key}_{unit}"]
        print(f"{label:<31} us{row['ours']:10.3f}{row['pinocchio']:12.3f}{result[f'{key}_ratio']:8.3f}")
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
