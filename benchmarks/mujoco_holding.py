"""Measures whether MuJoCo holds poses of an exported URDF with the holding torques of the model.

    python benchmarks/mujoco_holding.py [--poses 20]     (requires: pip install mujoco)

Each arm starts at rest at random poses and is simulated for 1 s with constant torques. MuJoCo converts mimic joints to
equality constraints, which are soft by default. Two settings of these constraints are compared, without friction and
with the dry friction of the arm's files. The last column is the largest difference between MuJoCo's gravity torque and
the holding torque of the model, at the independent joints.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

import dvrk_drake as dvrk

#: Settings of equality constraints: time constant and damping ratio, impedance.
STIFF = [0.002, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=20, help="number of poses; default: %(default)s")
    options = parser.parse_args()
    print("arm   constraints  friction  moved in 1 s [rad]  [m]       gravity [N m; N]")
    for name in ("mtml", "psm"):
        arm = dvrk.load_arm(name)
        model = dvrk.IdentifiedModel.from_arm(arm)
        q = arm.sample_poses(options.poses, np.random.default_rng(3), margin=0.1)
        tau = model.holding_torque(q)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{name}.urdf"
            dvrk.export_model(model, path, meshes="obj")
            plant = mujoco.MjModel.from_xml_path(str(path))
        plant.opt.gravity, plant.opt.timestep = arm.gravity, 1e-3
        joints = [plant.joint(joint).id for joint in arm.tree_joint_names]
        places, dofs = plant.jnt_qposadr[joints], plant.jnt_dofadr[joints]
        own = [arm.tree_joint_names.index(joint) for joint in arm.joint_names]
        for is_stiff in (False, True):
            if is_stiff:
                plant.eq_solref[:], plant.eq_solimp[:] = STIFF
            for share in (0.0, 1.0):
                plant.dof_frictionloss[dofs[own]] = share * arm.dry_friction()
                moved, difference = np.zeros(arm.num_joints), 0.0
                for pose, torque in zip(q, tau, strict=True):
                    data = mujoco.MjData(plant)
                    data.qpos[places] = arm.linkage.position(pose)
                    data.qfrc_applied[dofs[own]] = torque
                    mujoco.mj_forward(plant, data)
                    gravity = arm.linkage.pull_back_effort(data.qfrc_bias[dofs])
                    difference = max(difference, float(np.abs(gravity - torque).max()))
                    mujoco.mj_step(plant, data, 1000)
                    moved = np.maximum(moved, np.abs(data.qpos[places[own]] - pose))
                largest = [f"{np.max(moved[kind], initial=0.0):.1e}" for kind in (~arm.prismatic, arm.prismatic)]
                what = f"{'stiff' if is_stiff else 'default':11}  {'yes' if share else 'no':8}"
                print(f"{arm.name}  {what}  {largest[0]:18}  {largest[1]:8}  {difference:.0e}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
