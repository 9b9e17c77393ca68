"""Station of one real arm over LCM or ROS 2, with the same ports as the simulated station."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.driver import CrtkDriver, DvrkDriver
from dvrk_drake.systems.lcm.arm_link import ArmLink, DrakeLcmArmLink, LcmArmLink
from dvrk_drake.systems.lcm.messages import draw_id, make_command
from dvrk_drake.systems.ros.open_domain import require_cyclonedds

#: Measured values: name of the port, and fields of the status in their order.
_MEASURED = {
    "position_measured": ("position",),
    "velocity_estimated": ("velocity",),
    "state_estimated": ("position", "velocity"),
    "effort_measured": ("effort_measured",),
}
_MODES = (lcmt_dvrk_command.OFF, lcmt_dvrk_command.HOLD, lcmt_dvrk_command.POSITION, lcmt_dvrk_command.EFFORT)
#: Mode that acts on the arm in each state of the guard in which the arm does not only hold its pose.
_ACTING = {
    lcmt_dvrk_status.STATE_OFF: lcmt_dvrk_command.OFF,
    lcmt_dvrk_status.STATE_POSITION: lcmt_dvrk_command.POSITION,
    lcmt_dvrk_status.STATE_EFFORT: lcmt_dvrk_command.EFFORT,
}


class HardwareArmStation(LeafSystem):
    """Real arm, connected over LCM or directly over ROS 2. It has those ports of `ArmStation` that exist on hardware.

    .. pydrake_system::

        name: HardwareArmStation
        input_ports:
        - mtml.effort_commanded (optional)
        - mtml.state_desired (optional)
        - mtml.control_mode (optional)
        - mtml.reset_fault (optional)
        output_ports:
        - mtml.position_measured
        - mtml.velocity_estimated
        - mtml.state_estimated
        - mtml.effort_measured
        - mtml.guard_state
        - mtml.fault_code
        - mtml.acting_mode
        - mtml.in_control
        - mtml.measurement_age
        - mtml.sequence_gaps

    `mtml` stands for the arm's lower-case name. Sizes and units of the measured values and of `effort_commanded` are
    those of `ArmStation`. All other ports have one number, except `state_desired`::

                            +--------------------+
        effort_commanded -->|                    |--> position_measured, velocity_estimated,
        state_desired ----->|                    |    state_estimated, effort_measured
        control_mode ------>| HardwareArmStation |--> guard_state, fault_code, acting_mode, in_control
        reset_fault ------->|                    |--> measurement_age, sequence_gaps
                            +--------------------+
                    commands v                  ^ statuses
                            [  guard and driver  ]  another process (LCM), or this process (ROS 2)

    - `state_desired` (2n): commanded q, then v.
    - `control_mode`: lcmt_dvrk_command.HOLD, POSITION, EFFORT or OFF. OFF switches the motor power off and HOLD
      switches it on, if the guard accepts it. Other values mean HOLD. Unconnected: EFFORT if `effort_commanded` is
      connected, otherwise POSITION if `state_desired` is connected, otherwise HOLD.
    - `reset_fault`: a value other than 0 commands HOLD and requests the reset of a fault, or the resume after a
      watchdog hold. The guard requires a change from 0 to another value.
    - `guard_state`, `fault_code`: lcmt_dvrk_status.STATE_* and FAULT_*.
    - `acting_mode`: lcmt_dvrk_command mode that acts on the arm. In STARTING and FAULT, it is HOLD.
    - `in_control`: 1 if commands of this station act, 0 if not.
    - `measurement_age`: time since the arrival of the last measurement [s]. A repeated measurement does not count.
    - `sequence_gaps`: number of statuses that were sent but not received.

    All outputs are NaN before the first status, because zero would be a valid pose. Each status is answered with one
    command. Without finite commanded values, the command is HOLD. It also ends the control of another process. The
    guard of the arm checks the commands.

    **Time.** Every `driver.status_period`, the station reads the newest status, then sends a command. The time of the
    command is that of the computer, so the guard also detects a suspended process. A loop that is driven by messages
    waits for a status (`ArmLink.next_status`), then advances the Simulator by one period; see `ArmController`.

    If the watchdog of the guard holds the arm, e.g. because this process stopped for 50 ms, an operator must resume:
    inspect the arm, then change `reset_fault` to 1, or stop this process and run `dvrk-drake control --reset`.

    Attributes:
        link: Link to the arm.

    Example:
        >>> import dvrk_drake as dvrk
        >>> driver = dvrk.DvrkDriver(lcm_url="memq://")  # messages within this process; default: LCM's network
        >>> station = dvrk.HardwareArmStation(dvrk.load_arm("mtml"), driver=driver)
        >>> station.GetOutputPort("mtml.state_estimated").size()
        14
    """

    def __init__(
        self,
        arm: Arm,
        *,
        driver: DvrkDriver | CrtkDriver | None = None,
        lcm: DrakeLcmInterface | None = None,
        link: ArmLink | None = None,
    ) -> None:
        """Builds the station.

        Args:
            arm: Arm that defines the names of ports and channels.
            driver: Configuration of the driver: `DvrkDriver` for LCM, `CrtkDriver` for ROS 2. None: `DvrkDriver()`.
            lcm: LCM interface whose `HandleSubscriptions` the caller calls. None: the station opens `driver.lcm_url`.
                Not allowed with a `CrtkDriver`.
            link: Link to the arm. None: the station creates the link that `driver` and `lcm` define.

        Raises:
            ArmError: The arm has locked joints.
            KeyFileError: The driver's key cannot be used.
            StationError: `lcm` is given together with a `CrtkDriver`.
            DvrkDrakeError: With a `CrtkDriver`: the arm is not found, or another process could move it.
        """
        super().__init__()
        arm.refuse_locked_joints("a station")
        self.arm, self.sender_id = arm, draw_id()
        self.link = link or _open_link(arm, driver, lcm)
        self.set_name(f"{arm.name.lower()}_station")
        n, name = arm.num_joints, arm.name.lower()
        inputs = {"effort_commanded": n, "state_desired": 2 * n, "control_mode": 1, "reset_fault": 1}
        for port, size in inputs.items():
            self.DeclareVectorInputPort(f"{name}.{port}", size)
        # The last status is not part of the context, because Drake copies abstract states at each update. The state
        # has its number, on which the outputs depend, and the time of arrival of its measurement.
        self._status: lcmt_dvrk_status | None = None
        self._is_answered = True
        state = {self.discrete_state_ticket(self.DeclareDiscreteState(2))}
        for port, fields in _MEASURED.items():
            self.DeclareVectorOutputPort(f"{name}.{port}", n * len(fields), self._measured(fields), state)
        numbers: dict[str, Callable[[lcmt_dvrk_status], float]] = {
            "guard_state": lambda status: status.guard_state,
            "fault_code": lambda status: status.fault_code,
            "acting_mode": lambda status: _ACTING.get(status.guard_state, lcmt_dvrk_command.HOLD),
            "in_control": self._controls,
            "sequence_gaps": lambda status: self.link.lost,
        }
        for port, number in numbers.items():
            self.DeclareVectorOutputPort(f"{name}.{port}", 1, self._number(number), state)
        self.DeclareVectorOutputPort(f"{name}.measurement_age", 1, self._calc_age, {*state, self.time_ticket()})
        period = (driver if isinstance(driver, DvrkDriver) else DvrkDriver()).status_period
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._receive)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._send)
        self.DeclareForcedPublishEvent(self._send)

    def _receive(self, context: Context, state: State) -> None:
        status, before = self.link.poll(), self._status
        if status is None:
            return
        received = state.get_mutable_discrete_state().get_mutable_value(0)
        received[0] += 1
        if before is None or before.utime != status.utime:
            received[1] = context.get_time()
        self._status, self._is_answered = status, False

    def _send(self, context: Context) -> None:
        # The guard refuses a second command for the same status.
        if self._status is None or self._is_answered:
            return
        self._is_answered = True
        effort, desired, wanted, reset = (self._input(context, port) for port in range(4))
        if wanted is not None:
            mode = int(wanted[0]) if wanted[0] in _MODES else lcmt_dvrk_command.HOLD
        elif effort is not None:
            mode = lcmt_dvrk_command.EFFORT
        else:
            mode = lcmt_dvrk_command.HOLD if desired is None else lcmt_dvrk_command.POSITION
        utime, resets = self.link.utime(context.get_time()), reset is not None and bool(reset[0])
        command = make_command(self._status, self.sender_id, utime, mode, effort, desired, reset_fault=resets)
        self.link.send(command)

    def _input(self, context: Context, port: int) -> NDArray[np.float64] | None:
        value = self.EvalVectorInput(context, port)
        return None if value is None else value.get_value()

    def _controls(self, status: lcmt_dvrk_status) -> float:
        is_commanded = status.guard_state in (lcmt_dvrk_status.STATE_POSITION, lcmt_dvrk_status.STATE_EFFORT)
        return float(is_commanded and status.command_sender_id == self.sender_id)

    def _measured(self, fields: tuple[str, ...]) -> Callable[[Context, BasicVector], None]:
        nothing: NDArray[np.float64] = np.full(self.arm.num_joints * len(fields), np.nan)

        def calc(context: Context, output: BasicVector) -> None:
            status = self._status
            if status is None:
                output.SetFromVector(nothing)
            else:
                output.SetFromVector([number for name in fields for number in getattr(status, name)])

        return calc

    def _number(self, number: Callable[[lcmt_dvrk_status], float]) -> Callable[[Context, BasicVector], None]:
        def calc(context: Context, output: BasicVector) -> None:
            output.SetAtIndex(0, np.nan if self._status is None else number(self._status))

        return calc

    def _calc_age(self, context: Context, output: BasicVector) -> None:
        arrival = context.get_discrete_state_vector()[1]
        output.SetAtIndex(0, np.nan if self._status is None else context.get_time() - arrival)


def _open_link(arm: Arm, driver: DvrkDriver | CrtkDriver | None, lcm: DrakeLcmInterface | None) -> ArmLink:
    """Returns the link that a driver and an LCM interface define; see `HardwareArmStation`."""
    if isinstance(driver, CrtkDriver):
        if lcm is not None:
            raise StationError("lcm cannot be used with a driver over ROS 2, whose messages stay in memory")
        require_cyclonedds()
        from dvrk_drake.systems.ros.crtk_link import CrtkArmLink

        return CrtkArmLink(arm, driver)
    driver = driver or DvrkDriver()
    key = driver.load_key()
    return LcmArmLink(arm, driver.lcm_url, key=key) if lcm is None else DrakeLcmArmLink(arm, lcm, key=key)
