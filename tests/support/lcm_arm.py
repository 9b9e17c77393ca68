"""Simulated arm with LCM in the process of the test, and controllers for the arm."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status as Status
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.lcm.sim_dvrk_driver import apply_driver_config

ARM = load_arm("mtml")
POSES = {"mtml": [0.1, 0.4, -0.25, 0.6, 0.9, 0.1, 0.5], "psm": [0.2, -0.3, 0.1, 0.5, 0.2, -0.3, 0.3]}
START = 10**15
#: Driver for tests of the operation after the start: the controller is observed for 50 ms instead of 250 ms.
SOON = DvrkDriver(guard=GuardSettings(start_time=0.05))


class SimulatedArm:
    """Simulated arm with LCM that stores its statuses."""

    def __init__(self, lcm, name="mtml", driver=None, modify_plant=None):
        self.arm = load_arm(name)
        builder = DiagramBuilder()
        self.station = builder.AddSystem(ArmStation(self.arm, modify_plant=modify_plant))
        self.driver = apply_driver_config(driver or DvrkDriver(), self.station, lcm, builder, start_utime=START)
        self.statuses = []
        lcm.Subscribe(f"DVRK_STATUS_{self.arm.name}", lambda data: self.statuses.append(Status.decode(data)))
        self.simulator = Simulator(builder.Build())
        self.context = self.station.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        self.station.SetPositions(self.context, POSES[name])
        self.simulator.Initialize()
        self.tick = 0

    def step(self):
        self.tick += 1
        self.simulator.AdvanceTo(1e-3 * self.tick)

    @property
    def guard(self):
        return self.driver.GetGuard(self.driver.GetMyContextFromRoot(self.simulator.get_context()))

    def drift(self):
        return np.abs(self.station.GetPositions(self.context) - POSES[self.arm.name.lower()]).max()


class Controller:
    """Controller that regulates the first received pose through the hardware station."""

    def __init__(self, lcm, name="mtml", driver=None):
        arm = load_arm(name)
        builder = DiagramBuilder()
        station = builder.AddSystem(HardwareArmStation(arm, driver=driver, lcm=lcm))
        controller = builder.AddSystem(GravityPidController(IdentifiedModel.from_arm(arm), mode="gravity"))
        builder.Connect(station.GetOutputPort(f"{name}.state_estimated"), controller.GetInputPort("state_estimated"))
        builder.Connect(controller.GetOutputPort("effort"), station.GetInputPort(f"{name}.effort_commanded"))
        self.simulator = Simulator(builder.Build())
        self.simulator.Initialize()
        self.tick = 0

    def step(self):
        self.tick += 1
        self.simulator.AdvanceTo(1e-3 * self.tick)


def run(lcm, milliseconds, *processes):
    for _ in range(milliseconds):
        for process in processes:
            process.step()
            lcm.HandleSubscriptions(0)


def without_stops(plant):
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if joint.num_positions() == 1:
            joint.set_position_limits([-np.inf], [np.inf])


class CommandSender:
    """Hardware station that answers each status, with fixed inputs."""

    def __init__(self, lcm, arm=ARM, **inputs):
        self.station = HardwareArmStation(arm, lcm=lcm)
        self.simulator, self.ticks = Simulator(self.station), 0
        for name, value in inputs.items():
            self.fix(name, value)

    def fix(self, name, value):
        port = self.station.GetInputPort(f"{self.station.arm.name.lower()}.{name}")
        port.FixValue(self.simulator.get_mutable_context(), value)

    def value(self, name):
        """Returns the value of an output port."""
        port = self.station.GetOutputPort(f"{self.station.arm.name.lower()}.{name}")
        return port.Eval(self.simulator.get_context())

    def step(self):
        self.ticks += 1
        self.simulator.AdvanceTo(1e-3 * self.ticks)
