"""Simulated arm with a controller."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController


class ControlledArm:
    """Station and controller, by default the gravity compensation of the exact model.

    Attributes:
        simulator: Simulator of the closed loop.
        context: Context of the station.
    """

    def __init__(self, arm, q, model=None, *, mode="gravity", gains=None, desired=None, **station):
        self.arm = arm
        self.station = ArmStation(arm, **station)
        self.controller = GravityPidController(model or IdentifiedModel.from_arm(arm), mode=mode, gains=gains)
        builder = DiagramBuilder()
        add_closed_loop(builder, self.station, self.controller, desired)
        self.simulator = Simulator(builder.Build())
        self.context = self.station.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        self.station.SetPositions(self.context, q)

    @property
    def q(self):
        return self.station.GetPositions(self.context)

    @property
    def plant_context(self):
        return self.station.GetSubsystemContext(self.station.plant, self.context)

    @property
    def controller_context(self):
        return self.controller.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def drift(self, seconds):
        """Returns the motion (n,) of the joints in this time."""
        start = self.q
        self.simulator.AdvanceTo(self.context.get_time() + seconds)
        return np.abs(self.q - start)
