"""Process that connects a dVRK arm on ROS 2 to the LCM messages of this package, started by `dvrk-drake bridge`."""

from __future__ import annotations

import select
from collections.abc import Callable
from contextlib import closing
from typing import TYPE_CHECKING

import lcm
import numpy as np

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import command_channel, status_channel
from dvrk_drake.processes.deadman import DeadmanProcess
from dvrk_drake.processes.lcm_network import handle_message
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.crtk_client import CrtkClient
    from dvrk_drake.systems.ros.domain import RosDomain

#: Length of the queue of commands. Largest number of commands that are handled between two steps; it limits the delay
#: that a flood of messages can cause.
_QUEUE, _MESSAGES_PER_STEP = 200, 50
#: Longest wait for a message between two updates of the bridge [s].
_POLL = 0.002
#: Longest time until the arm has sent its state and a measurement [s].
_FIRST = 5.0


def run_bridge(
    arm: Arm,
    driver: DvrkDriver,
    url: str,
    *,
    topic: str | None,
    domain: int | None,
    stopped: Callable[[], bool],
    report: Callable[[str], None],
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Connects an arm until `stopped` returns true. The arm then holds its pose.

    Args:
        arm: Arm on ROS 2.
        driver: Configuration of the guard; `driver.status_period` is not used.
        url: URL of the LCM network.
        topic: Topic measured_js of the arm or its namespace; see `find_arm`.
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
        stopped: Function that returns whether to stop.
        report: Function that is called with one line for each change of the state.
        ready: Function that is called before the networks are opened, e.g. to request real-time scheduling. The threads
            of the networks and the deadman process inherit the scheduling.

    Raises:
        DvrkDrakeError: The arm is not found, its topics do not fit, or another process could move it.
    """
    _compile(arm, driver)
    ready()
    ros = open_ros_domain(domain)
    from dvrk_drake.systems.ros.crtk_bridge import CrtkBridge, refuse_other_publishers
    from dvrk_drake.systems.ros.crtk_client import CrtkClient, find_arm

    namespace = find_arm(ros, arm, topic)
    refuse_other_publishers(ros, arm, namespace)
    client = CrtkClient(ros, arm, namespace)
    _wait_for_arm(ros, client)
    with closing(DeadmanProcess(namespace, domain)) as deadman:
        report(f"deadman process {deadman.pid} publishes hold if this bridge is silent for 50 ms")
        network = lcm.LCM(url)
        channel, problem = status_channel(arm), ""

        def send_status(data: bytes) -> None:
            # Without statuses, no command arrives, and the guard holds the arm.
            nonlocal problem
            try:
                network.publish(channel, data)
                problem = ""
            except OSError as error:
                if not problem:
                    problem = f"LCM {url}: the status could not be sent: {error.strerror}"
                    report(problem)

        bridge = CrtkBridge(
            client,
            driver,
            send_status,
            report=report,
            blocked=deadman.problem,
        )
        network.subscribe(command_channel(arm), lambda channel, data: bridge.put(data)).set_queue_capacity(_QUEUE)
        try:
            while not stopped():
                select.select([ros.fileno(), network.fileno()], [], [], _POLL)
                ros.clear()
                for _ in range(_MESSAGES_PER_STEP):
                    if not handle_message(network, 0.0):
                        break
                bridge.update()
        finally:
            bridge.close()


def _compile(arm: Arm, driver: DvrkDriver) -> None:
    """Compiles the functions of the guard. During a compilation, no message can be received."""
    guard = CommandGuard(arm, 1, ControlModel(driver.load_model(arm) or IdentifiedModel.from_arm(arm)), driver.guard)
    zero = np.zeros(arm.num_joints)
    for utime in (1_000, 2_000, 3_000):
        guard.step(utime, utime, np.clip(zero, arm.position_lower, arm.position_upper), zero, zero)


def _wait_for_arm(ros: RosDomain, client: CrtkClient) -> None:
    """Waits for the operating state and the first measurement.

    Raises:
        ControllerError: A message did not arrive, the joints do not fit, or nobody receives the commands.
    """

    def is_complete() -> bool:
        client.receive()
        return bool(client.operating_state and client.measurement and not client.unheard_commands())

    if ros.wait_until(is_complete, _FIRST):
        if client.measurement is not None and client.measurement.stamp and client.measurement.problem:
            raise ControllerError(client.measurement.problem)
        return
    if client.measurement is None:
        raise ControllerError(f"no message on {client.namespace}/measured_js within {_FIRST:g} s")
    if client.operating_state is None:
        raise ControllerError(f"no message on {client.namespace}/operating_state within {_FIRST:g} s. Is it a dVRK?")
    raise ControllerError(f"no process subscribes to {', '.join(client.unheard_commands())}. Is it a dVRK?")
