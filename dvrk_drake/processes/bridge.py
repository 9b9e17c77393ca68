"""Process that connects a dVRK arm on ROS 2 to the LCM messages of this package, started by `dvrk-drake bridge`."""

from __future__ import annotations

import contextlib
import select
from collections.abc import Callable

import lcm

from dvrk_drake.errors import ModelError
from dvrk_drake.lcmtypes import lcmt_dvrk_force
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import command_channel, force_channel, status_channel
from dvrk_drake.processes.force_monitor import ForceMonitor
from dvrk_drake.systems.driver import DvrkDriver
from dvrk_drake.systems.lcm.lcm_network import handle_message
from dvrk_drake.systems.ros.open_domain import require_cyclonedds

#: Length of the queue of commands. Largest number of commands that are handled between two steps; it limits the delay
#: that a flood of messages can cause.
_QUEUE, _MESSAGES_PER_STEP = 200, 50
#: Longest wait for a message between two updates of the bridge [s].
_POLL = 0.002
#: Pause of a bridge that polls [s], after an answer and while no controller commands the arm. A thread with real-time
#: scheduling must pause, because Linux stops it for 50 ms per second otherwise (sched_rt_runtime_us).
_PAUSE = 0.0002


def run_bridge(
    arm: Arm,
    driver: DvrkDriver,
    *,
    topic: str | None,
    domain: int | None,
    polls: bool = False,
    publish_force: bool = False,
    stopped: Callable[[], bool],
    report: Callable[[str], None],
    ready: Callable[[], None] = lambda: None,
    enter: Callable[[], bool] = lambda: False,
) -> bool:
    """Connects an arm until `stopped` returns true. The arm then holds its pose.

    Args:
        arm: Arm on ROS 2.
        driver: Configuration of the guard and of the LCM network; `driver.status_period` is not used.
        topic: Topic measured_js of the arm or its namespace; see `find_topic`.
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
        polls: Whether to poll for messages while a controller commands the arm. The delay decreases, but the bridge
            uses a processor core.
        publish_force: Whether to publish the external force, estimated with the model of the driver, on both networks.
        stopped: Function that returns whether to stop.
        report: Function that is called with one line for each change of the state.
        ready: Function that is called before the networks are opened, e.g. to request real-time scheduling.
        enter: Function that returns whether a person pressed Enter since the last call; see
            `CommandGuard.allow_reset`.

    Returns:
        Whether the arm has confirmed the last command, `hold`.

    Raises:
        ModelError: The force cannot be estimated with the model of the driver.
        DvrkDrakeError: The arm is not found, its topics do not fit, or another process could move it.
    """
    require_cyclonedds()
    from dvrk_drake.systems.ros.crtk_bridge import connect_bridge

    ready()  # threads of LCM and DDS inherit the scheduling of this thread
    network, channel, problem = lcm.LCM(driver.lcm_url), status_channel(arm), ""

    def send_status(data: bytes) -> None:
        # Without statuses, no command arrives, and the guard holds the arm.
        nonlocal problem
        try:
            network.publish(channel, data)
            problem = ""
        except OSError as error:
            if not problem:
                problem = f"LCM {driver.lcm_url}: the status could not be sent: {error.strerror}"
                report(problem)

    def send_force(force: lcmt_dvrk_force) -> None:
        data = force.encode()
        with contextlib.suppress(OSError):  # reported for the status
            network.publish(force_channel(arm), data if key is None else key.sign(data))
        bridge.send_force(force)

    monitor, key = None, driver.load_key()
    if publish_force:
        if (model := driver.load_model(arm)) is None:
            raise ModelError("the estimated force requires a model of the arm that was identified from a motion")
        monitor = ForceMonitor(model, send=send_force)
    bridge = connect_bridge(
        arm, driver, send_status, topic=topic, domain=domain, report=report, stopped=stopped, polled=polls
    )
    timeout = _PAUSE if polls else _POLL
    try:
        network.subscribe(command_channel(arm), lambda channel, data: bridge.put(data)).set_queue_capacity(_QUEUE)
        while not stopped():
            readable, _, _ = select.select([bridge.fileno(), network.fileno()], [], [], timeout)
            if network.fileno() in readable:
                for _ in range(_MESSAGES_PER_STEP):
                    if not handle_message(network, 0.0):
                        break
            if enter():
                bridge.guard.allow_reset()
            is_answer = bridge.update()
            if monitor is not None:
                monitor.update(bridge.status)
            if polls:
                timeout = 0.0 if bridge.is_commanded and not is_answer else _PAUSE
    finally:
        is_confirmed = bridge.close()
    return is_confirmed
