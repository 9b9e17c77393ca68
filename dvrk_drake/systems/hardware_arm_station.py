"""Station of one real arm over LCM with the ports of its simulation."""

from __future__ import annotations

from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Diagram, DiagramBuilder

from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_station import station_ports
from dvrk_drake.systems.lcm.arm_connection import connect_arm
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver


class HardwareArmStation(Diagram):
    """Real arm, connected over LCM, with those ports of `ArmStation` that a driver has.

    .. pydrake_system::

        name: HardwareArmStation
        input_ports:
        - mtml.effort_commanded (optional)
        output_ports:
        - mtml.position_measured
        - mtml.velocity_estimated
        - mtml.state_estimated
        - mtml.effort_measured

    `mtml` stands for the arm's lower-case name. Sizes and units are those of `ArmStation`. Measured values are those of
    the last DVRK_STATUS message, and NaN before the first one. Efforts are sent in DVRK_COMMAND messages every
    `driver.status_period` and on forced publishing. The arm's command guard checks them. Unconnected: the messages
    command HOLD.

    After the guard's watchdog took over, e.g. because this process was stopped for 50 ms, efforts act again only when
    an operator resumes: stop this process, inspect the arm, run `dvrk-drake run --reset`, stop it, start this again.
    """

    def __init__(self, arm: Arm, *, driver: DvrkDriver | None = None, lcm: DrakeLcmInterface | None = None) -> None:
        """Builds the station.

        Args:
            arm: Arm after which the ports and the channels are named.
            driver: Configuration of the driver; `DvrkDriver()` by default.
            lcm: LCM interface whose `HandleSubscriptions` the caller calls, for loops that are driven by messages. By
                default a new one at `driver.lcm_url`, which a Simulator of this station handles.

        Raises:
            KeyFileError: The driver's key cannot be used.
        """
        super().__init__()
        self._arm = arm
        builder = DiagramBuilder()
        receiver, sender = connect_arm(builder, arm, driver or DvrkDriver(), lcm)
        name = arm.name.lower()
        builder.ExportInput(sender.GetInputPort("effort"), f"{name}.effort_commanded")
        for port in station_ports(arm).outputs:
            builder.ExportOutput(receiver.GetOutputPort(port.removeprefix(f"{name}.")), port)
        builder.BuildInto(self)
        self.set_name(f"{name}_station")

    @property
    def arm(self) -> Arm:
        """Arm that defines the names and order of the ports."""
        return self._arm
