"""Compares the computing times of our gravity regressor and gravity torque with those of Pinocchio.

    make benchmark        or        pip install '.[benchmark]' && python benchmarks/gravity_regressor.py [--json FILE]

Pinocchio's model is the serial chain of the independent joints, without the linkage. Before the timing, the script
checks that both libraries compute equal torques for this chain.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import pinocchio
from pinocchio_arm import build_pinocchio, regressor_loop
from timing import measured_times, median_ratio, print_table, write_json

from dvrk_drake.dynamics.compiled import entry_point
from dvrk_drake.dynamics.holding_torque import holding_torque_into, static_model
from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import make_arm_plant

CALLS = 20_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help="write the results to this file")
    parser.add_argument("--poses", type=int, default=10_000, help="number of poses; default: %(default)s")
    parser.add_argument("--repetitions", type=int, default=15, help="number of repetitions; default: %(default)s")
    options = parser.parse_args()

    arm = load_arm("mtml")
    plant = make_arm_plant(arm)
    pin_model = build_pinocchio(arm, plant, arm.joint_names)
    pin_data = pin_model.createData()
    q = arm.sample_poses(options.poses, np.random.default_rng(0))
    zero = np.zeros_like(q)

    start = time.perf_counter()
    derive_gravity(arm)
    derivation = time.perf_counter() - start
    model = static_model(arm)
    is_serial = [parameter.label.isdigit() for parameter in model.gravity.standard_parameters]
    serial = model.gravity.base.combination @ np.where(is_serial, model.gravity.standard_values, 0.0)
    reference = np.array([pinocchio.computeGeneralizedGravity(pin_model, pin_data, pose) for pose in q[:200]])
    ours = model.torque(q[:200], serial)
    rotor = plant.GetBodyByName("motor_4_link").default_mass() * np.linalg.norm(arm.gravity)
    # Pinocchio's chain lacks the rotor on the platform. The torques may differ only by the torque of the rotor's
    # weight.
    assert np.abs(ours - reference).max() < rotor * 0.7, np.abs(ours - reference).max()

    arrays, out = model.with_parameters(model.gravity.base_values), np.empty(arm.num_joints)
    pose, holding_torque = q[0].copy(), entry_point(holding_torque_into)

    def single_ours() -> None:
        for _ in range(CALLS):
            holding_torque(pose, arrays, out)

    def single_pinocchio() -> None:
        for _ in range(CALLS):
            pinocchio.computeGeneralizedGravity(pin_model, pin_data, pose)

    cases = {
        f"regressor, {options.poses} poses": (
            {"ours": lambda: model.regressor(q), "Pinocchio": regressor_loop(pin_model, [q, zero, zero])},
            options.poses,
        ),
        "torque, one call": ({"ours": single_ours, "Pinocchio": single_pinocchio}, CALLS),
    }
    result, rows = {"derivation_s": derivation}, {}
    for case, (functions, count) in cases.items():
        times = measured_times(functions, options.repetitions)
        us, ratio = (
            {k: 1e6 * float(np.median(v)) / count for k, v in times.items()},
            median_ratio(times, "ours", "Pinocchio"),
        )
        result[case] = {**us, "ratio": ratio}
        rows[case] = (f"{us['ours']:.3f}", f"{us['Pinocchio']:.3f}", f"{ratio:.3f}")
    print_table(
        f"{arm.name}: CPU time per pose, without derivation ({derivation:.2f} s)",
        ["ours [us]", "Pinocchio [us]", "ratio ours / Pinocchio"],
        rows,
    )
    write_json(options.json, result)


if __name__ == "__main__":
    main()
