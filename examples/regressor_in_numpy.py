"""Computes the gravity regressor of a master arm at many poses and solves a least-squares problem with it."""

import numpy as np

import dvrk_drake as dvrk

arm = dvrk.load_arm("mtmr")
model = dvrk.IdentifiedModel.from_arm(arm).static_model
q = arm.sample_poses(200, np.random.default_rng(0), margin=0.05)

Y = model.regressor(q)  # (200, 7, 12), N m per kg m
tau = model.torque(q, model.gravity.base_values)  # (200, 7), gravity torque of the SDF's links, N m
beta = np.linalg.lstsq(Y.reshape(-1, Y.shape[2]), tau.ravel(), rcond=None)[0]
for name, value in zip(model.gravity.base.names, beta, strict=True):
    print(f"{value:+.5f} kg m  {name}")
