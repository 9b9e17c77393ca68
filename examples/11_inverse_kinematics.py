# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Computes all poses in which the tool of a PSM reaches points on a circle, and the efforts that hold them.

python 11_inverse_kinematics.py [INSTRUMENT]     e.g. PROGRASP_FORCEPS_420093; default: large needle driver
"""

import sys

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

import dvrk_drake as dvrk

arm = dvrk.load_arm("psm_si", sys.argv[1] if len(sys.argv) > 1 else "")
model = dvrk.IdentifiedModel.from_arm(arm)
down = RollPitchYaw(np.pi, 0.0, np.pi / 2)  # the fingers point along -z of the base
q = None
for angle in np.linspace(0.0, 2 * np.pi, 8, endpoint=False):
    point = [0.03 * np.cos(angle), 0.03 * np.sin(angle), -0.12]
    poses = dvrk.inverse_kinematics(arm, RigidTransform(down, point), rest=q)
    q = poses[0]  # the pose that is nearest to the previous one
    print(f"{len(poses)} poses, nearest {q.round(2)}, efforts {model.holding_torque(q[None])[0, :3].round(2)}")
