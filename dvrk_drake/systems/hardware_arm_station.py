"""One arm over LCM behind the ports of its simulation."""

from __future__ import annotations

from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Diagram, DiagramBuilder

from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_station import station_ports
from dvrk_drake.systems.lcm.arm_connection import connect_arm
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver


class HardwareArmStation(Diagram):
    """The arm itself, over LCM, with those ports of `ArmStation` that a driver has.

    .. pydrake_system::

        name: HardwareArmStation
        input_ports:
        - mtml.effort_commanded (optional)
        output_ports:
        - mtml.position_measured
        - mtml.velocity_estimated
        - mtml.state_estimated
        - mtml.effort_measured

    `mtml` stands for the arm's lower-case name; sizes and units are those of `ArmStation`. Measured values are those of
    the last DVRK_STATUS message, NaN before the first. Efforts go out in DVRK_COMMAND messages every
    `driver.status_period` and on forced publishing, and the arm's command guard decides what becomes of them;
    unconnected, the arm is told to hold.

    After the guard's watchdog took over, e.g. because this process was stopped for 50 ms, efforts act again only when
    an operator resumes: end this process, look at the arm, run `dvrk-drake run --reset`, end that, start this again.
    """

    def __init__(self, arm: Arm, *, driver: DvrkDriver | None = None, lcm: DrakeLcmInterface | None = None) -> None:
        """Builds the station.

        Args:
            arm: names the ports and the channels.
            driver: how the arm is driven; `DvrkDriver()` by default.
            lcm: whose `HandleSubscriptions` somebody else calls, for loops that are driven by messages; by default one
                at `driver.lcm_url` that a Simulator of this station handles.

        Raises:
            KeyFileError: the driver's key cannot be used.
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
        """The arm that the ports are named and ordered after."""
        return self._arm
