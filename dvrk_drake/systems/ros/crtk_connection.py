"""Drake system that runs the bridge to a dVRK arm inside a Diagram."""

from __future__ import annotations

import atexit
import logging

from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.lcm import LcmInterfaceSystem

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.systems.ros.crtk_bridge import CrtkBridge, connect_bridge
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
from dvrk_drake.systems.ros.open_domain import domain_number

#: Period in which the system receives measurements and publishes commands [s].
_PERIOD = 1e-3


#: Bridges of this process, each with the number of its ROS domain.
_BRIDGES: list[tuple[int, CrtkBridge]] = []


@atexit.register
def _close_bridges() -> None:
    for _, bridge in _BRIDGES:
        bridge.close()


def _close_earlier(arm: Arm, driver: CrtkDriver) -> None:
    """Ends the bridge of an earlier station to the same arm, whose Diagram may still exist, e.g. in a notebook."""
    number = domain_number(driver.domain)
    wanted = f"/{driver.namespace.strip('/')}".removesuffix("/measured_js")
    for entry in list(_BRIDGES):
        client = entry[1].client
        if entry[0] == number and client.arm.name == arm.name and wanted in ("/", client.namespace):
            _BRIDGES.remove(entry)
            entry[1].close()
            client.domain.close()


class CrtkBridgeSystem(LeafSystem):
    """Runs a `CrtkBridge` every millisecond. It has no ports, because it uses LCM messages in memory.

    The Simulator must run in real time (`set_target_realtime_rate(1.0)`). If it stops, the arm holds its pose after 50
    ms, because the deadman process publishes `hold`. Changes of the guard's state are logged as warnings.

    A later system for the same arm in this process ends the bridge of this system.
    """

    def __init__(self, arm: Arm, driver: CrtkDriver, lcm: DrakeLcm) -> None:
        """Connects to an arm.

        Args:
            arm: Arm on ROS 2.
            driver: Configuration of the driver.
            lcm: LCM interface in memory that receives the statuses and delivers the commands.

        Raises:
            DvrkDrakeError: The arm is not found, its topics do not fit, or another process could move it.
        """
        super().__init__()
        guard_driver = driver.guard_driver()
        _close_earlier(arm, driver)
        self._bridge: CrtkBridge = connect_bridge(
            arm,
            guard_driver,
            lambda data: lcm.Publish(status_channel(arm), data),
            topic=driver.namespace or None,
            domain=driver.domain,
            report=logging.getLogger(__name__).warning,
        )
        _BRIDGES.append((domain_number(driver.domain), self._bridge))
        lcm.Subscribe(command_channel(arm), self._bridge.put)
        self.DeclarePeriodicPublishEvent(_PERIOD, 0.0, self._update)

    def _update(self, context: Context) -> None:
        if all(bridge is not self._bridge for _, bridge in _BRIDGES):
            raise StationError(
                f"{self._bridge.client.namespace}: this station has ended, because a later station of this process "
                "connected to the arm. Use the later station"
            )
        self._bridge.update()


def add_crtk_bridge(builder: DiagramBuilder, arm: Arm, driver: CrtkDriver) -> DrakeLcmInterface:
    """Adds a `CrtkBridgeSystem` to a Diagram. Returns its LCM interface, for `connect_arm`.

    Args:
        builder: Builder of the Diagram.
        arm: Arm on ROS 2.
        driver: Configuration of the driver.

    Raises:
        DvrkDrakeError: See `CrtkBridgeSystem`.
    """
    memory = DrakeLcm("memq://")
    builder.AddNamedSystem("crtk_bridge", CrtkBridgeSystem(arm, driver, memory))
    return builder.AddNamedSystem("lcm", LcmInterfaceSystem(lcm=memory))
