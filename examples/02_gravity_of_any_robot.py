# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Computes the gravity regressor and the base parameters of any robot, and checks them with Drake.

python 02_gravity_of_any_robot.py [ROBOT]        ROBOT is the path of a URDF, SDF or MJCF file, or mtml, mtmr, psm.
"""

import sys

import numpy as np

import dvrk_drake as dvrk

arm = dvrk.load_arm(sys.argv[1] if len(sys.argv) > 1 else "mtmr")
model = dvrk.IdentifiedModel.from_arm(arm)
gravity = model.static_model.gravity
q = arm.sample_poses(200, np.random.default_rng(0), margin=0.05)

Y = model.static_model.regressor(q)  # (200, n, p), linear in the base parameters
tau = model.holding_torque(q)  # (200, n)
beta, _, rank, _ = np.linalg.lstsq(Y.reshape(-1, Y.shape[2]), tau.ravel(), rcond=None)
print(f"{arm.name}: {rank} base parameters determine the gravity torques of {arm.num_joints} joints")
for name, value in zip(gravity.base.names, beta, strict=True):
    print(f"{value:+.5f}  {name}")
print(f"largest error of Y(q) beta: {np.abs(Y @ beta - tau).max():.1e} N m")
