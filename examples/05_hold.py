# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Regulates the pose of a simulated master arm with gravity feedforward and PID, and shows it in Meshcat."""

import sys

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import dvrk_drake as dvrk

arm = dvrk.load_arm("mtml")
model = dvrk.IdentifiedModel.from_arm(arm)  # or dvrk.IdentifiedModel.load("model.yaml"), from dvrk-drake identify
meshcat = dvrk.start_meshcat(arm)
builder = DiagramBuilder()
station = dvrk.ArmStation(arm, meshcat=meshcat)
dvrk.add_closed_loop(builder, station, dvrk.GravityPidController(model))
simulator = Simulator(builder.Build())
context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
station.SetPositions(context, [0.2, 0.4, -0.25, 0.6, 0.9, 0.3, 0.5])  # the controller regulates this pose
simulator.AdvanceTo(2.0)
print("final positions [rad]", np.round(station.GetPositions(context), 4))
if sys.stdin.isatty():  # the page exists only while this script runs
    input(f"{meshcat.web_url()} shows the arm. Press Enter to end. ")
