# /// script
# requires-python = ">=3.11"
# dependencies = ["dvrk_drake"]
# ///
"""Runs a Diagram on an arm over LCM, and ends as soon as the guard of the arm does not apply its efforts any more.

dvrk-drake sim-arm --arm mtml --realtime        # another terminal. For a real arm: dvrk-drake bridge --arm mtml
python 09_hardware_station.py [SECONDS]

Read docs/safety.md before you run this script on a real arm. No real arm has been controlled with this software yet.
"""

import sys

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, EventStatus

import dvrk_drake as dvrk

PORTS = ("in_control", "guard_state", "fault_code")  # outputs of the station with the state of the guard

seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
arm = dvrk.load_arm("mtml")
model = dvrk.IdentifiedModel.from_arm(arm)  # for a real arm: dvrk.IdentifiedModel.load("model.yaml")
builder = DiagramBuilder()
station = dvrk.HardwareArmStation(arm)
dvrk.add_closed_loop(builder, station, dvrk.GravityPidController(model, mode="damped"))
diagram = builder.Build()
simulator = Simulator(diagram)


class Monitor:
    """Ends the simulation when the efforts of the Diagram have acted, and do not act any more."""

    acted = False

    def __call__(self, root_context):
        """Returns whether the simulation ends."""
        context = station.GetMyContextFromRoot(root_context)
        value = {name: station.GetOutputPort(f"mtml.{name}").Eval(context)[0] for name in PORTS}
        if self.acted and value["in_control"] != 1:
            message = f"the guard took over: state {value['guard_state']:.0f}, fault {value['fault_code']:.0f}"
            return EventStatus.ReachedTermination(diagram, message)
        self.acted = self.acted or value["in_control"] == 1
        return EventStatus.DidNothing()


monitor = Monitor()
simulator.set_monitor(monitor)
simulator.set_target_realtime_rate(1.0)
status = simulator.AdvanceTo(seconds)
print(status.FormatMessage())
print("the efforts of this Diagram acted" if monitor.acted else "no arm answered, or its guard refused the efforts")
