# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Two master arms, a patient-side arm, a table and a ball in one plant, with one controller per arm, in Meshcat."""

import sys
from pathlib import Path

from pydrake.geometry import StartMeshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import dvrk_drake as dvrk

meshcat = StartMeshcat()
meshcat.SetCameraPose([1.3, 1.5, 1.2], [0.0, 0.1, 0.4])
config = dvrk.load_station_config(Path(__file__).with_name("arms_and_table.yaml"))
station = dvrk.Station(config, meshcat=meshcat)
builder = DiagramBuilder()
for name, arm in station.arms.items():
    controller = dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm))
    controller.set_name(f"{name}_controller")
    dvrk.add_closed_loop(builder, station, controller, name=name)

simulator = Simulator(builder.Build())
context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
poses = {name: 0.5 * (arm.position_lower + arm.position_upper) for name, arm in station.arms.items()}
for name, q in poses.items():
    station.SetPositions(context, name, q)  # the controllers regulate these poses
simulator.set_target_realtime_rate(1.0 if sys.stdin.isatty() else 0.0)
simulator.AdvanceTo(2.0)
for name, q in poses.items():
    state = station.GetOutputPort(f"{name}.state_true").Eval(context)
    print(f"{name} moved by at most {1e3 * abs(state[: len(q)] - q).max():.3f} mrad or mm")
ball = station.plant.GetBodyByName("ball")
X_WBall = station.plant.EvalBodyPoseInWorld(station.GetSubsystemContext(station.plant, context), ball)
print(f"height of the ball [m] {X_WBall.translation()[2]:.3f}")
if sys.stdin.isatty():  # the page exists only while this script runs
    input(f"{meshcat.web_url()} shows the arms. Press Enter to end. ")
