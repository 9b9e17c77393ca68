"""Link to a dVRK arm on ROS 2 through a bridge in this process."""

from __future__ import annotations

import atexit
import logging
import select
from collections.abc import Callable

from dvrk_drake.errors import StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_force
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.driver import CrtkDriver
from dvrk_drake.systems.lcm.arm_link import MessageLink
from dvrk_drake.systems.ros.crtk_bridge import CrtkBridge, connect_bridge
from dvrk_drake.systems.ros.open_domain import domain_number

#: Longest wait for a message between two updates of the bridge [s].
_POLL = 0.002

#: Bridges of this process, each with the number of its ROS domain.
_BRIDGES: list[tuple[int, CrtkBridge]] = []


@atexit.register
def _close_bridges() -> None:
    for _, bridge in _BRIDGES:
        bridge.close()


def _close_earlier(arm: Arm, driver: CrtkDriver) -> None:
    """Ends the bridge of an earlier link to the same arm, which may still exist, e.g. in a notebook."""
    number = domain_number(driver.domain)
    wanted = f"/{driver.namespace.strip('/')}".removesuffix("/measured_js")
    for entry in list(_BRIDGES):
        client = entry[1].client
        if entry[0] == number and client.arm.name == arm.name and wanted in ("/", client.namespace):
            _BRIDGES.remove(entry)
            entry[1].close()
            client.domain.close()


class CrtkArmLink(MessageLink):
    """Link to an arm on ROS 2. It runs a `CrtkBridge`, whose guard checks the commands, each time it is polled.

    If the link is not polled for 50 ms while efforts or positions act, the deadman process publishes `hold`.

    A later link to the same arm in this process ends the bridge of this link.
    """

    def __init__(
        self,
        arm: Arm,
        driver: CrtkDriver,
        *,
        report: Callable[[str], None] | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Connects to an arm.

        Args:
            arm: Arm on ROS 2.
            driver: Configuration of the driver.
            report: Function that is called with one line for each change of the guard's state. None: the lines are
                logged as warnings.
            stopped: Function that returns whether to end the connection, e.g. after Ctrl-C.

        Raises:
            DvrkDrakeError: The arm is not found, its topics do not fit, or another process could move it.
        """
        super().__init__(arm)
        _close_earlier(arm, driver)
        self._bridge: CrtkBridge = connect_bridge(
            arm,
            driver,
            self._receive,
            topic=driver.namespace or None,
            domain=driver.domain,
            report=report or logging.getLogger(__name__).warning,
            stopped=stopped,
        )
        self.where = f"{self._bridge.client.namespace}/measured_js"
        _BRIDGES.append((domain_number(driver.domain), self._bridge))

    def send_force(self, force: lcmt_dvrk_force) -> None:
        """Publishes an estimated external force on topics of this package, see `CrtkBridge.send_force`."""
        self._bridge.send_force(force)

    def close(self) -> None:
        """Commands the arm to hold its present pose, and ends the bridge and the deadman process."""
        if self._is_open():
            _BRIDGES[:] = [entry for entry in _BRIDGES if entry[1] is not self._bridge]
            self._bridge.close()
            self._bridge.client.domain.close()

    def _is_open(self) -> bool:
        return any(bridge is self._bridge for _, bridge in _BRIDGES)

    def _handle(self, seconds: float) -> bool:
        if not self._is_open():
            raise StationError(
                f"{self._bridge.client.namespace}: this station has ended, because a later station of this process "
                "connected to the arm. Use the later station"
            )
        if seconds > 0:
            select.select([self._bridge.fileno()], [], [], min(seconds, _POLL))
        self._bridge.update()
        # The bridge has handled all messages.
        return False

    def _publish(self, channel: str, data: bytes) -> None:
        self._bridge.put(data)
        self._bridge.update()
