"""Station of one real arm over LCM or ROS 2, with the same ports as the simulated station."""

from __future__ import annotations

from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Diagram, DiagramBuilder

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_station import station_ports
from dvrk_drake.systems.lcm.arm_connection import connect_arm
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
from dvrk_drake.systems.ros.open_domain import require_cyclonedds


class HardwareArmStation(Diagram):
    """Real arm, connected over LCM or directly over ROS 2. It has those ports of `ArmStation` that exist on hardware.

    .. pydrake_system::

        name: HardwareArmStation
        input_ports:
        - mtml.effort_commanded (optional)
        output_ports:
        - mtml.position_measured
        - mtml.velocity_estimated
        - mtml.state_estimated
        - mtml.effort_measured

    `mtml` stands for the arm's lower-case name. Sizes and units are those of `ArmStation`.

    Measured values are those of the last DVRK_STATUS message, and NaN before the first message. Efforts are sent in
    DVRK_COMMAND messages every `driver.status_period` and on forced publishing. The command guard of the arm checks
    these messages. With a `CrtkDriver`, the guard and the bridge to ROS 2 are part of this station, and the messages
    stay in memory; see `CrtkBridgeSystem`. If the effort input is unconnected, the messages command HOLD.
    These messages also end the control of another process.

    If the watchdog of the guard holds the arm, e.g. because this process stopped for 50 ms, an operator must resume:

    1. Stop this process and inspect the arm.
    2. Run `dvrk-drake control --reset`, then stop it.
    3. Start this process again.
    """

    def __init__(
        self, arm: Arm, *, driver: DvrkDriver | CrtkDriver | None = None, lcm: DrakeLcmInterface | None = None
    ) -> None:
        """Builds the station.

        Args:
            arm: Arm that defines the names of ports and channels.
            driver: Configuration of the driver: `DvrkDriver` for LCM, `CrtkDriver` for ROS 2. None: `DvrkDriver()`.
            lcm: LCM interface whose `HandleSubscriptions` the caller calls, for loops that are driven by messages.
                None: the station creates an interface at `driver.lcm_url`, and the Simulator handles its messages.
                Not allowed with a `CrtkDriver`.

        Raises:
            KeyFileError: The driver's key cannot be used.
            StationError: `lcm` is given together with a `CrtkDriver`.
            DvrkDrakeError: With a `CrtkDriver`: the arm is not found, or another process could move it.
        """
        super().__init__()
        self._arm = arm
        builder = DiagramBuilder()
        if isinstance(driver, CrtkDriver):
            if lcm is not None:
                raise StationError("lcm cannot be used with a driver over ROS 2, whose messages stay in memory")
            require_cyclonedds()
            from dvrk_drake.systems.ros.crtk_connection import add_crtk_bridge

            lcm, driver = add_crtk_bridge(builder, arm, driver), driver.guard_driver()
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
