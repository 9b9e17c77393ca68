"""Simulated driver between the CRTK topics of a dVRK and the motors of a simulated arm."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem, State

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.driver import CrtkDriver
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.ros.crtk_arm_state import ArmValues, CrtkArmState, CrtkCommand
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.crtk_arm_topics import CrtkArmTopics
    from dvrk_drake.systems.ros.domain import RosDomain

#: Period in which commands are processed and efforts change [s].
PERIOD = 1e-3


class CrtkArmServer(LeafSystem):
    """Processes the commands of a simulated dVRK arm and publishes its state.

    .. pydrake_system::

        name: CrtkArmServer
        input_ports:
        - state_estimated
        - effort_measured
        - position_control_effort
        - gravity_effort
        output_ports:
        - desired_state
        - effort

    Ports, for n joints in the arm's order [rad, rad/s, N m; m, m/s, N on a prismatic joint]:

    - `state_estimated` (2n): measured q, then v. `effort_measured` (n): applied motor efforts.
    - `position_control_effort` (n): effort of the position controller. `gravity_effort` (n): effort that compensates
      gravity.
    - `desired_state` (2n): set-point of the position controller, q, then v.
    - `effort` (n): motor efforts to apply, inside the effort limits.

    Commands are processed every millisecond. Messages are published at `rate`.
    """

    def __init__(
        self,
        arm: Arm,
        machine: CrtkArmState,
        rate: float,
        topics: CrtkArmTopics | None,
        report: Callable[[str], None],
    ) -> None:
        """Creates the server of `arm`.

        Args:
            arm: Simulated arm.
            machine: State machine in its initial state. Each context has its own copy of it.
            rate: Rate of the published measurements [Hz].
            topics: Topics. None: commands are received only by `Receive`, and nothing is published.
            report: Function that is called with a line on each change of state or mode and on refused commands.
        """
        super().__init__()
        n = arm.num_joints
        self._num_joints, self._topics, self._report = n, topics, report
        self._inbox: list[CrtkCommand] = []
        self._state = self.DeclareVectorInputPort("state_estimated", 2 * n)
        self._effort_measured = self.DeclareVectorInputPort("effort_measured", n)
        self._position_control = self.DeclareVectorInputPort("position_control_effort", n)
        self._gravity = self.DeclareVectorInputPort("gravity_effort", n)
        self._machine = self.DeclareAbstractState(AbstractValue.Make(machine))
        own = {self.abstract_state_ticket(self._machine)}
        self.DeclareVectorOutputPort("desired_state", 2 * n, self._calc_desired_state, own)
        efforts = {self.input_port_ticket(port.get_index()) for port in (self._position_control, self._gravity)}
        self._effort = self.DeclareVectorOutputPort("effort", n, self._calc_effort, own | efforts)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._update)
        if topics is not None:
            self.DeclarePeriodicPublishEvent(1.0 / rate, 0.0, self._publish)

    def Receive(self, command: CrtkCommand) -> None:
        """Adds a command to the inbox that the next update reads."""
        self._inbox.append(command)

    def GetMachine(self, context: Context) -> CrtkArmState:
        """Returns the state machine of this context, read-only."""
        machine: CrtkArmState = context.get_abstract_state(int(self._machine)).get_value()
        return machine

    def _update(self, context: Context, state: State) -> None:
        machine: CrtkArmState = state.get_mutable_abstract_state(int(self._machine)).get_mutable_value()
        commands, self._inbox = self._inbox, []
        if self._topics is not None:
            commands += self._topics.take()
        q, v = np.split(self._state.Eval(context), 2)
        machine.step(context.get_time(), q, v, commands)
        for line in machine.take_lines():
            self._report(line)
            if self._topics is not None:
                self._topics.publish_text(line)
        if self._topics is not None:
            self._topics.publish_state(machine)

    def _publish(self, context: Context) -> None:
        assert self._topics is not None
        machine = self.GetMachine(context)
        q, v = np.split(self._state.Eval(context), 2)
        setpoint_q, setpoint_v = np.split(machine.desired_state, 2)
        values = ArmValues(
            q,
            v,
            self._effort_measured.Eval(context),
            setpoint_q,
            setpoint_v,
            self._effort.Eval(context),
            machine.gravity_compensation * self._gravity.Eval(context),
        )
        self._topics.publish(values, is_valid=machine.is_biased)

    def _calc_desired_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.GetMachine(context).desired_state)

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        effort = self.GetMachine(context).motor_effort(
            self._position_control.Eval(context), self._gravity.Eval(context)
        )
        output.SetFromVector(effort)


class SimCrtkDriver(Diagram):
    """Simulation of a dVRK's controller of one arm: commands, position controller and published state.

    .. pydrake_system::

        name: SimCrtkDriver
        input_ports:
        - state_estimated
        - effort_measured
        output_ports:
        - effort_commanded

    The ports are described in CrtkArmServer. The position controller is a GravityPidController. As with a dVRK,
    commanded efforts act until another command arrives, and position limits apply only to positions.
    """

    def __init__(
        self,
        arm: Arm,
        driver: CrtkDriver,
        *,
        model: IdentifiedModel | None = None,
        domain: RosDomain | None = None,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Creates the driver of `arm`.

        Args:
            arm: Simulated arm with its base orientation.
            driver: Configuration of the driver. `driver.domain` is not used.
            model: Model for the gravity compensation and the position controller. None: `driver.model`, or else the
                model of the arm's SDF.
            domain: ROS domain of the topics. None: there are no topics, and commands are received only by `Receive`.
            report: Function that is called with a line on each change of state or mode and on refused commands.

        Raises:
            ModelError: The driver's model cannot be read, or is not valid for this arm.
        """
        super().__init__()
        model = model or driver.load_model(arm) or IdentifiedModel.from_arm(arm)
        tool = ArmFrame(arm)
        machine = CrtkArmState(arm, gravity_compensation=driver.gravity_compensation, inverse=tool.solve)
        topics = None
        if domain is not None:
            from dvrk_drake.systems.ros.crtk_arm_topics import CrtkArmTopics

            topics = CrtkArmTopics(arm, driver.arm_namespace(arm), domain, tool)
        builder = DiagramBuilder()
        self._server = builder.AddNamedSystem("server", CrtkArmServer(arm, machine, driver.rate, topics, report))
        controller = builder.AddNamedSystem("position_controller", GravityPidController(model, period=PERIOD))
        server = self._server
        builder.Connect(server.GetOutputPort("desired_state"), controller.GetInputPort("desired_state"))
        builder.Connect(controller.GetOutputPort("effort"), server.GetInputPort("position_control_effort"))
        builder.Connect(controller.GetOutputPort("gravity_effort"), server.GetInputPort("gravity_effort"))
        state = builder.ExportInput(server.GetInputPort("state_estimated"), "state_estimated")
        builder.ConnectInput(state, controller.GetInputPort("state_estimated"))
        builder.ExportInput(server.GetInputPort("effort_measured"), "effort_measured")
        builder.ExportOutput(server.GetOutputPort("effort"), "effort_commanded")
        builder.BuildInto(self)
        self.set_name(f"{arm.name.lower()}_driver")

    def Receive(self, command: CrtkCommand) -> None:
        """Adds a command to the inbox that the next update reads."""
        self._server.Receive(command)

    def GetMachine(self, context: Context) -> CrtkArmState:
        """Returns the state machine in this driver's context, read-only."""
        return self._server.GetMachine(self.GetSubsystemContext(self._server, context))


def apply_crtk_driver_config(
    driver: CrtkDriver,
    station: ArmStation,
    builder: DiagramBuilder,
    *,
    model: IdentifiedModel | None = None,
    domain: RosDomain | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> SimCrtkDriver:
    """Connects a simulated station to ROS 2, with the topics of a dVRK in `driver.arm_namespace`.

    Args:
        driver: Configuration of the driver.
        station: Station in `builder` with an unconnected effort input.
        builder: Builder of the Diagram.
        model: See SimCrtkDriver.
        domain: ROS domain. None: the domain `driver.domain` is joined.
        report: See SimCrtkDriver.

    Returns:
        Added driver.

    Raises:
        DvrkDrakeError: The package cyclonedds is missing, or the domain cannot be used.
        ModelError: The driver's model cannot be read, or is not valid for the arm.
    """
    name = station.arm.name.lower()
    joined = open_ros_domain(driver.domain) if domain is None else domain
    sim_driver = builder.AddSystem(SimCrtkDriver(station.arm, driver, model=model, domain=joined, report=report))
    for port in ("state_estimated", "effort_measured"):
        builder.Connect(station.GetOutputPort(f"{name}.{port}"), sim_driver.GetInputPort(port))
    builder.Connect(sim_driver.GetOutputPort("effort_commanded"), station.GetInputPort(f"{name}.effort_commanded"))
    return sim_driver
