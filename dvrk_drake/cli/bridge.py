"""Commands for a dVRK arm on ROS 2: bridge and deadman."""

from __future__ import annotations

import contextlib
import signal
from typing import Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import (
    Arm,
    Gravity,
    Instrument,
    Key,
    LcmUrl,
    Model,
    PublishForce,
    Realtime,
    RosDomain,
    RosTopic,
    bridge,
)
from dvrk_drake.cli.support import driver_configuration, interrupt_ends_process, mounted, print_line, request_realtime
from dvrk_drake.errors import ControllerError


@bridge.default
def bridge_arm(
    *,
    arm: Arm,
    instrument: Instrument = "",
    topic: RosTopic = None,
    domain: RosDomain = None,
    model: Annotated[
        Model | None, Parameter(help="Model with which the guard checks measurements. Default: the model of the SDF.")
    ] = None,
    driver: Annotated[str | None, Parameter(metavar="FILE.yaml")] = None,
    lcm_url: LcmUrl = "",
    key: Key = None,
    gravity: Gravity = None,
    realtime: Realtime = False,
    poll: Annotated[bool, Parameter(negative="")] = False,
    publish_force: PublishForce = False,
) -> None:
    """Connect a dVRK arm on ROS 2 to LCM, behind a command guard.

    Enable and home the arm at its console first. The bridge starts a deadman process, which holds the arm if the bridge
    is killed.

    Args:
        driver: Configuration file of the driver (docs/lcm.md). Default: the default configuration.
        poll: Poll for messages while a controller commands the arm. The delay decreases, but the bridge uses a
            processor core.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.bridge import run_bridge
    from dvrk_drake.processes.pace import settle_memory
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.systems.ros.open_domain import domain_number

    def ready() -> None:
        settle_memory()
        request_realtime(realtime)

    domain_number(domain)  # rejects an invalid number before any other step
    with interrupt_ends_process():
        connected = mounted(load_arm(arm, instrument), gravity)
        configuration = driver_configuration(driver, key, lcm_url)
        configuration.model = model or configuration.model
        stopped = stop_on_signals()
    print(
        f"connecting {connected.name} to LCM {configuration.lcm_url}; Ctrl-C ends the bridge, and the arm holds its "
        "pose",
        flush=True,
    )
    is_confirmed = run_bridge(
        connected,
        configuration,
        configuration.lcm_url,
        topic=topic,
        domain=domain,
        polls=poll,
        publish_force=publish_force,
        stopped=stopped,
        report=print_line,
        ready=ready,
        enter=EnterKey.of_terminal(),
    )
    if not is_confirmed:
        raise ControllerError("the bridge has ended, but the arm has not confirmed hold. The deadman process continues")
    print("bridge ended; the arm has confirmed hold", flush=True)


@bridge.command
def deadman(*, arm: Arm, topic: RosTopic = None, domain: RosDomain = None) -> None:
    """Hold a dVRK arm on ROS 2 when its commands stop for 50 ms.

    The bridge starts its own deadman process. Use this command for other programs that publish servo_jf or servo_jp, or
    on another computer.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.systems.ros.deadman import Deadman, request_priority
    from dvrk_drake.systems.ros.open_domain import open_ros_domain

    priority = request_priority()  # the threads of DDS inherit it
    ros = open_ros_domain(domain)
    from dvrk_drake.systems.ros.crtk_client import find_arm

    def report(line: str) -> None:
        with contextlib.suppress(OSError):
            print(line, flush=True)

    namespace = find_arm(ros, load_arm(arm), topic, report=report)
    monitor = Deadman(ros, namespace, report)
    stopped = stop_on_signals()
    # A closed terminal must not end this process.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    print(f"deadman of {namespace}; Ctrl-C ends it; it has {priority}", flush=True)
    monitor.run(stopped)
