# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Simulates teleoperation with force feedback: a hand moves a master arm, and a PSM follows and touches an object."""

import sys

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

import dvrk_drake as dvrk

meshcat = dvrk.start_meshcat(camera=[1.7, 0.45, 0.5], target=[0, -0.12, 0.08])
meshcat.SetTransform("mtml", RigidTransform([0, 0.45, 0.05]))  # positions of the bases [m]
meshcat.SetTransform("psm", RigidTransform([0, -0.22, 0]))
psm, q_psm = dvrk.load_arm("psm"), [0, 0, 0.13, 0, 0, 0, 0.5]
surface = dvrk.Contact(psm).point(q_psm) - [0, 0, 0.01]  # 10 mm below the tip
arms = dvrk.TeleoperatedArms(
    dvrk.load_arm("mtml"),
    psm,
    scale=1 / 3,
    meshcat=meshcat,
    force_model="exact",  # or a model from identify, for an arm with effects
    wall=dvrk.Wall(psm, surface, normal=[0, 0, 1], stiffness=500.0),
)
simulator = Simulator(arms)
context = simulator.get_mutable_context()
arms.SetPositions(context, [0, 0.25, -0.1, 0, 1.2, 0, 0], q_psm)
X_MG0, X_FT0 = arms.CalcX_MG(context), arms.CalcX_FT(context)

arms.GetInputPort("engaged").FixValue(context, [1.0])
arms.GetInputPort("X_MG_desired").FixValue(context, AbstractValue.Make(X_MG0))
simulator.AdvanceTo(0.1)
for t in np.arange(0.1, 3.0, 0.01):  # the hand moves down by 6 cm
    target = RigidTransform([0, 0, -0.06 * min(1, (t - 0.1) / 2)]) @ X_MG0
    arms.GetInputPort("X_MG_desired").FixValue(context, AbstractValue.Make(target))
    simulator.AdvanceTo(t)

print("hand moved      [mm]", np.round(1e3 * (target.translation() - X_MG0.translation()), 2))
print("handle moved    [mm]", np.round(1e3 * (arms.CalcX_MG(context).translation() - X_MG0.translation()), 2))
print("tip moved       [mm]", np.round(1e3 * (arms.CalcX_FT(context).translation() - X_FT0.translation()), 2))
print("estimated force [N] ", np.round(arms.GetOutputPort("force").Eval(context), 2))
if sys.stdin.isatty():  # the page exists only while this script runs
    input(f"{meshcat.web_url()} shows both arms. Press Enter to end. ")
