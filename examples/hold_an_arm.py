"""Hold a simulated master arm at a pose: gravity feedforward + PID, in Meshcat."""

import sys

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import load_arm
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.arm_view import framing, start_meshcat
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

arm = load_arm("mtml")
model = IdentifiedModel.from_arm(arm)  # or IdentifiedModel.load("model.yaml"), from dvrk-drake identify
builder = DiagramBuilder()
meshcat = start_meshcat(*framing(arm))
station = builder.AddSystem(ArmStation(arm, meshcat=meshcat))
controller = builder.AddSystem(GravityPidController(model))
builder.Connect(station.GetOutputPort("mtml.state_estimated"), controller.GetInputPort("state_estimated"))
builder.Connect(controller.GetOutputPort("effort"), station.GetInputPort("mtml.effort_commanded"))
simulator = Simulator(builder.Build())
context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
station.SetPositions(context, [0.2, 0.4, -0.25, 0.6, 0.9, 0.3, 0.5])  # held where it is put
simulator.AdvanceTo(2.0)
print("holds", np.round(station.GetPositions(context), 4))
if sys.stdin.isatty():  # the page ends with this script
    input(f"{meshcat.web_url()} shows the arm; press Enter to end ")
