"""Simulated driver between the LCM messages and the motors of a simulated arm."""

from __future__ import annotations

from collections.abc import Callable

from pydrake.common.value import AbstractValue
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.lcm import LcmPublisherSystem, PySerializer

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import MessageKey, command_channel, status_channel
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.gravity_pid_controller import GravityPidController
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.lcm.dvrk_command import DvrkCommandReceiver, draw_id
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.lcm.dvrk_status import ArmClock, DvrkStatusSender


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

    The ports are described in DvrkCommandReceiver and DvrkStatusSender. The position controller is a
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
        clock = ArmClock(start_utime, driver.status_period)
        model = model or IdentifiedModel.from_arm(arm)
        guard_model = ControlModel(driver.load_model(arm) or model, with_gravity=not driver.gravity_compensation)
        guard = CommandGuard(arm, draw_id(), guard_model, driver.guard, driver.accepted_modes(), wall_clock)
        builder = DiagramBuilder()
        self._receiver = builder.AddNamedSystem("command_receiver", DvrkCommandReceiver(arm, guard, clock, key))
        position_controller = builder.AddNamedSystem(
            "position_controller", GravityPidController(model, period=clock.period)
        )
        status_sender = builder.AddNamedSystem(
            "status_sender",
            DvrkStatusSender(
                arm,
                guard,
                clock,
                gravity_compensation=driver.gravity_compensation,
            ),
        )
        receiver = self._receiver
        builder.Connect(receiver.GetOutputPort("desired_state"), position_controller.GetInputPort("desired_state"))
        builder.Connect(position_controller.GetOutputPort("effort"), receiver.GetInputPort("position_control_effort"))
        if driver.gravity_compensation:
            builder.Connect(
                position_controller.GetOutputPort("gravity_effort"), receiver.GetInputPort("gravity_effort")
            )
        builder.Connect(receiver.GetOutputPort("guard"), status_sender.GetInputPort("guard"))
        builder.Connect(receiver.GetOutputPort("effort"), status_sender.GetInputPort("effort_commanded"))
        for name, systems in {
            "lcmt_dvrk_command": (receiver,),
            "state_estimated": (receiver, position_controller, status_sender),
            "effort_measured": (receiver, status_sender),
        }.items():
            port = builder.ExportInput(systems[0].GetInputPort(name), name)
            for system in systems[1:]:
                builder.ConnectInput(port, system.GetInputPort(name))
        builder.ExportOutput(receiver.GetOutputPort("effort"), "effort_commanded")
        builder.ExportOutput(status_sender.GetOutputPort("lcmt_dvrk_status"), "lcmt_dvrk_status")
        builder.BuildInto(self)
        self.set_name(f"{arm.name.lower()}_driver")

    def Receive(self, data: bytes) -> None:
        """Adds a message of the command channel to the inbox that the next update reads."""
        self._receiver.Receive(data)

    def AllowReset(self) -> None:
        """Allows the reset of a fault in the next update; see `CommandGuard.allow_reset`."""
        self._receiver.AllowReset()

    def GetGuard(self, context: Context) -> CommandGuard:
        """Returns the guard in this driver's context, read-only."""
        return self._receiver.GetGuard(self.GetSubsystemContext(self._receiver, context))


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
