"""Drake system that runs the bridge to a dVRK arm inside a Diagram."""

from __future__ import annotations

import atexit
import logging

from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.lcm import LcmInterfaceSystem

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.systems.ros.crtk_bridge import CrtkBridge, compile_guard, connect_bridge
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver

#: Period in which the system receives measurements and publishes commands [s].
_PERIOD = 1e-3


class CrtkBridgeSystem(LeafSystem):
    """Runs a `CrtkBridge` every millisecond. It has no ports, because it uses LCM messages in memory.

    The Simulator must run in real time (`set_target_realtime_rate(1.0)`). If it stops, the arm holds its pose after 50
    ms, because the deadman process publishes `hold`. Changes of the guard's state are logged as warnings.
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
        compile_guard(arm, guard_driver)
        self._bridge: CrtkBridge = connect_bridge(
            arm,
            guard_driver,
            lambda data: lcm.Publish(status_channel(arm), data),
            topic=driver.namespace or None,
            domain=driver.domain,
            report=logging.getLogger(__name__).warning,
        )
        atexit.register(self._bridge.close)
        lcm.Subscribe(command_channel(arm), self._bridge.put)
        self.DeclarePeriodicPublishEvent(_PERIOD, 0.0, self._update)

    def _update(self, context: Context) -> None:
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
