"""Simulated driver between the LCM messages and the motors of a simulated arm, with a command guard."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, DiscreteValues, LeafSystem, State
from pydrake.systems.lcm import LcmPublisherSystem, PySerializer

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import MessageKey, command_channel, status_channel
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.limits import is_finite
from dvrk_drake.systems.lcm.messages import CommandInbox, draw_id, fill_in_guard

#: Shortest time [s] in which an effort grows from zero to its limit, outside the state EFFORT. The gains of the
#: position controller are stable up to a delay of 8 ms, so the crossover frequency is below pi/2 / 8 ms = 196 rad/s. An
#: effort with this frequency and the amplitude of the limit changes by the limit within 5 ms. With a longer time, large
#: motions would be unstable.
_RISE_TIME = 0.004


class DvrkArmServer(LeafSystem):
    """Receives commands for one arm, checks them with a guard, and outputs efforts, targets and the status.

    Until a command acts, the arm holds the measured pose, as with Drake's command receivers. The arm also holds a pose
    during a watchdog hold and after a fault.

    .. pydrake_system::

        name: DvrkArmServer
        input_ports:
        - lcmt_dvrk_command (optional)
        - state_estimated
        - effort_measured
        - position_control_effort
        - gravity_effort (optional)
        output_ports:
        - desired_state
        - effort
        - lcmt_dvrk_status

    Ports, for n joints in the arm's order [rad, rad/s, N m; m, m/s, N on a prismatic joint]:

    - `lcmt_dvrk_command`: command, e.g. from an LcmSubscriberSystem. A repeated message is processed only once. Drake
      keeps only the newest message of a channel, without the encoded bytes that are needed to verify the authentication
      code. A process that moves an arm must therefore pass every message to `Receive` instead.
    - `state_estimated` (2n): measured q, then v. `effort_measured` (n): applied motor efforts.
    - `position_control_effort` (n): present effort of the position controller in the arm's driver.
    - `gravity_effort` (n): gravity compensation of the arm's driver. If connected, it is added to commanded efforts and
      subtracted from `effort_measured`.
    - `desired_state` (2n): target of the position controller. While efforts act, it is the measured pose with zero
      velocity.
    - `effort` (n): motor efforts to apply, inside the effort limits. In OFF, they are zero. In EFFORT, they are the
      output of the guard plus `gravity_effort`. In all other modes, they are `position_control_effort`. Where this
      effort is not finite, the gravity effort of the model is used instead. Outside the state EFFORT, an effort
      changes by at most its limit within 4 ms.
    - `lcmt_dvrk_status`: measurements and the state of the guard, for an LcmPublisherSystem. The sequence is the number
      of periods since time zero.

    The guard is an abstract state that is updated once per period. Drake updates abstract states before it
    steps a discrete plant at the same time. A command therefore acts in the next step of the plant.
    """

    def __init__(
        self,
        arm: Arm,
        guard: CommandGuard,
        *,
        start_utime: int = 0,
        period: float = 1e-3,
        key: MessageKey | None = None,
    ) -> None:
        """Creates the server of `arm` with its `guard`.

        Args:
            arm: Arm that defines the number of joints and their effort limits.
            guard: Guard in its initial state. Each context has its own copy of the guard.
            start_utime: Time of the arm's clock at time zero of the context [us]. It never jumps.
            period: Period in which the arm measures, updates its guard and sends its status [s].
            key: Key that must have signed the messages for `Receive`. None: authentication codes are not verified.
        """
        super().__init__()
        n = arm.num_joints
        self._allows_reset = False
        self._arm, self._start_utime, self._period = arm, start_utime, period
        self._command = self.DeclareAbstractInputPort("lcmt_dvrk_command", AbstractValue.Make(lcmt_dvrk_command()))
        self._state = self.DeclareVectorInputPort("state_estimated", 2 * n)
        self._effort = self.DeclareVectorInputPort("effort_measured", n)
        self._position_control = self.DeclareVectorInputPort("position_control_effort", n)
        self._gravity = self.DeclareVectorInputPort("gravity_effort", n)
        self._guard = self.DeclareAbstractState(AbstractValue.Make(guard))
        self._last_command_id = self.DeclareAbstractState(AbstractValue.Make((0, 0, 0)))
        # Effort of the previous step. Not finite before the first step, whose effort is not limited in rate.
        self._last_effort = self.DeclareDiscreteState(np.full(n, np.nan))
        own = {self.abstract_state_ticket(self._guard)}
        self.DeclareVectorOutputPort("desired_state", 2 * n, self._calc_desired_state, own)
        efforts = {self.input_port_ticket(port.get_index()) for port in (self._position_control, self._gravity)}
        last = self.discrete_state_ticket(self._last_effort)
        self._applied = self.DeclareVectorOutputPort("effort", n, self._calc_effort, own | efforts | {last})
        self.DeclareAbstractOutputPort(
            "lcmt_dvrk_status", lambda: AbstractValue.Make(lcmt_dvrk_status()), self._calc_status
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store_effort)
        self._inbox = CommandInbox(guard, key)

    def Receive(self, data: bytes) -> None:
        """Adds a received message to the inbox that the next update reads."""
        self._inbox.put(data)

    def AllowReset(self) -> None:
        """Allows the reset of a fault in the next update; see `CommandGuard.allow_reset`."""
        self._allows_reset = True

    def GetGuard(self, context: Context) -> CommandGuard:
        """Returns the guard of this context, read-only."""
        return context.get_abstract_state(int(self._guard)).get_value()

    def _update(self, context: Context, state: State) -> None:
        guard = state.get_mutable_abstract_state(int(self._guard)).get_mutable_value()
        utime = self._utime(context)
        if self._allows_reset:
            self._allows_reset = False
            guard.allow_reset()
        self._inbox.deliver(guard, utime)
        if self._command.HasValue(context):
            command = self._command.Eval(context)
            command_id = (command.sender_id, command.sequence, command.utime)
            if command_id != context.get_abstract_state(int(self._last_command_id)).get_value():
                state.get_mutable_abstract_state(int(self._last_command_id)).set_value(command_id)
                guard.receive(command, utime)
        q_v = self._state.Eval(context)
        effort = self._effort.Eval(context)
        if self._gravity.HasValue(context):
            effort = effort - self._gravity.Eval(context)
        guard.step(utime, utime, *np.split(q_v, 2), effort)

    def _store_effort(self, context: Context, values: DiscreteValues) -> None:
        # Drake calls this method after `_update`, and together with the step of a discrete plant that uses the effort.
        values.set_value(self._applied.Eval(context))

    def _calc_desired_state(self, context: Context, output: BasicVector) -> None:
        guarded = self.GetGuard(context).output
        output.SetFromVector(np.concatenate([guarded.position, guarded.velocity]))

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        guard = self.GetGuard(context)
        guarded = guard.output
        if guarded.control_mode == lcmt_dvrk_command.OFF:
            output.SetZero()
            return
        if guarded.control_mode == lcmt_dvrk_command.EFFORT:
            effort = guarded.effort + (self._gravity.Eval(context) if self._gravity.HasValue(context) else 0.0)
        else:
            effort = self._position_control.Eval(context)
            # The effort of the position controller is not finite while measurements are missing for a few periods.
            effort = np.where(np.isfinite(effort), effort, guard.gravity_effort)
        last = context.get_discrete_state(self._last_effort).value()
        # In EFFORT, the guard limits the rate, except that of the soft walls and of the speed limit.
        if guard.state != lcmt_dvrk_status.STATE_EFFORT and is_finite(last.tolist()):
            step = self._arm.effort_limits * self._period / _RISE_TIME
            effort = np.clip(effort, last - step, last + step)
        output.SetFromVector(np.clip(effort, -self._arm.effort_limits, self._arm.effort_limits))

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        status, arm = lcmt_dvrk_status(), self._arm
        status.utime, status.sequence = self._utime(context), round(context.get_time() / self._period)
        status.arm_name, status.num_joints = arm.name, arm.num_joints
        status.gravity_compensation = self._gravity.HasValue(context)
        status.position, status.velocity = (x.tolist() for x in np.split(self._state.Eval(context), 2))
        status.effort_measured = self._effort.Eval(context).tolist()
        status.effort_commanded = self._applied.Eval(context).tolist()
        fill_in_guard(status, self.GetGuard(context))
        output.set_value(status)

    def _utime(self, context: Context) -> int:
        """Returns the time of the arm's clock [us]."""
        return self._start_utime + round(1e6 * context.get_time())


class SimDvrkDriver(Diagram):
    """Simulation of an arm's driver: command guard, position controller and status.

    .. pydrake_system::

        name: SimDvrkDriver
        input_ports:
        - lcmt_dvrk_command (optional)
        - state_estimated
        - effort_measured
        output_ports:
        - effort_commanded
        - lcmt_dvrk_status

    The ports are described in DvrkArmServer. The position controller is a
    GravityPidController, which holds the arm while no command acts. The position controller of a real arm also has to
    overcome friction.
    """

    def __init__(
        self,
        arm: Arm,
        driver: DvrkDriver,
        *,
        model: IdentifiedModel | None = None,
        start_utime: int = 0,
        wall_clock: Callable[[], int] | None = None,
        key: MessageKey | None = None,
    ) -> None:
        """Creates the driver of `arm`.

        Args:
            arm: Simulated arm with its base orientation.
            driver: Configuration of the driver.
            model: Model for the gravity compensation of the position controller. None: the model of the arm's SDF is
                used. The guard checks measurements with `driver.model` if it is set, otherwise with this model.
            start_utime: Time of the arm's clock at time zero of the context [us].
            wall_clock: Function that returns the wall-clock time [us] for the guard. None: commands expire only by the
                time of the context.
            key: Key that must have signed the messages for `Receive`. None: authentication codes are not verified.

        Raises:
            ModelError: The driver's model cannot be read, or is not valid for this arm.
        """
        super().__init__()
        period = driver.status_period
        model = model or IdentifiedModel.from_arm(arm)
        guard_model = ControlModel(driver.load_model(arm) or model, with_gravity=not driver.gravity_compensation)
        guard = CommandGuard(arm, draw_id(), guard_model, driver.guard, driver.accepted_modes(), wall_clock)
        builder = DiagramBuilder()
        server = DvrkArmServer(arm, guard, start_utime=start_utime, period=period, key=key)
        self._server = builder.AddNamedSystem("server", server)
        controller = builder.AddNamedSystem("position_controller", GravityPidController(model, period=period))
        builder.Connect(server.GetOutputPort("desired_state"), controller.GetInputPort("desired_state"))
        builder.Connect(controller.GetOutputPort("effort"), server.GetInputPort("position_control_effort"))
        if driver.gravity_compensation:
            builder.Connect(controller.GetOutputPort("gravity_effort"), server.GetInputPort("gravity_effort"))
        for name in ("lcmt_dvrk_command", "state_estimated", "effort_measured"):
            builder.ExportInput(server.GetInputPort(name), name)
        state = server.GetInputPort("state_estimated")
        builder.ConnectToSame(state, controller.GetInputPort("state_estimated"))
        builder.ExportOutput(server.GetOutputPort("effort"), "effort_commanded")
        builder.ExportOutput(server.GetOutputPort("lcmt_dvrk_status"), "lcmt_dvrk_status")
        builder.BuildInto(self)
        self.set_name(f"{arm.name.lower()}_driver")

    def Receive(self, data: bytes) -> None:
        """Adds a message of the command channel to the inbox that the next update reads."""
        self._server.Receive(data)

    def AllowReset(self) -> None:
        """Allows the reset of a fault in the next update; see `CommandGuard.allow_reset`."""
        self._server.AllowReset()

    def GetGuard(self, context: Context) -> CommandGuard:
        """Returns the guard in this driver's context, read-only."""
        return self._server.GetGuard(self.GetSubsystemContext(self._server, context))


class _SigningSerializer(PySerializer):
    """Serializer that signs messages."""

    def __init__(self, message_type: type, key: MessageKey) -> None:
        super().__init__(message_type)
        self._key = key

    def Serialize(self, abstract_value: AbstractValue) -> bytes:
        return self._key.sign(super().Serialize(abstract_value))


def apply_driver_config(
    driver: DvrkDriver,
    station: ArmStation,
    lcm: DrakeLcmInterface,
    builder: DiagramBuilder,
    *,
    model: IdentifiedModel | None = None,
    start_utime: int = 0,
    subscribe: bool = True,
    wall_clock: Callable[[], int] | None = None,
) -> SimDvrkDriver:
    """Connects a simulated station to LCM, with commands on DVRK_COMMAND_<ARM> and statuses on DVRK_STATUS_<ARM>.

    Args:
        driver: Configuration of the driver. `driver.lcm_url` is not used. The driver's key verifies commands and signs
            statuses.
        station: Station in `builder` with an unconnected effort input.
        lcm: LCM interface whose `HandleSubscriptions` the caller calls, e.g. in a loop or by an LcmInterfaceSystem.
        builder: Builder of the Diagram.
        model: See SimDvrkDriver.
        start_utime: Time of the arm's clock at time zero of the context [us].
        subscribe: If true, commands are received from `lcm`. Over UDP, `lcm` keeps only the newest command between two
            calls of `HandleSubscriptions`. If false, the caller passes every message to `SimDvrkDriver.Receive`.
        wall_clock: Function that returns the wall-clock time [us] for the guard, for a simulation that is stepped by
            the wall clock. None: commands expire only by the time of the context.

    Returns:
        Added driver.

    Raises:
        KeyFileError: The driver's key cannot be used.
    """
    arm, name, key = station.arm, station.arm.name.lower(), driver.load_key()
    sim_driver = builder.AddSystem(
        SimDvrkDriver(arm, driver, model=model, start_utime=start_utime, wall_clock=wall_clock, key=key)
    )
    if subscribe:
        lcm.Subscribe(command_channel(arm), sim_driver.Receive)
    for port in ("state_estimated", "effort_measured"):
        builder.Connect(station.GetOutputPort(f"{name}.{port}"), sim_driver.GetInputPort(port))
    builder.Connect(sim_driver.GetOutputPort("effort_commanded"), station.GetInputPort(f"{name}.effort_commanded"))
    publisher = builder.AddNamedSystem(
        f"{name}_status_publisher",
        LcmPublisherSystem(
            status_channel(arm),
            PySerializer(lcmt_dvrk_status) if key is None else _SigningSerializer(lcmt_dvrk_status, key),
            lcm,
            publish_period=driver.status_period,
        ),
    )
    builder.Connect(sim_driver.GetOutputPort("lcmt_dvrk_status"), publisher.get_input_port())
    return sim_driver
