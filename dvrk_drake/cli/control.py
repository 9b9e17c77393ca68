"""Commands that run the driver of an arm (sim-arm, bridge, deadman) or control it (keygen, control, status, stop)."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from typing import Annotated, Any, Literal

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.errors import ControllerError


@options.app.command(group=options.HARDWARE)
def keygen(*, output: Annotated[str, Parameter(metavar="FILE")]) -> None:
    """Create a key to sign LCM messages.

    Args:
        output: New key file. Only the owner of the file can read it.
    """
    from dvrk_drake.models.lcm_messages import create_key_file

    create_key_file(output)
    support.print_written(
        output,
        "copy the file to the other computer, e.g. with scp -p, and give it with --key to the arm and the controller",
    )


@options.app.command(group=options.HARDWARE)
def control(
    *,
    controlled: options.ControlledArm,
    mode: Literal["gravity", "damped", "guide", "hold"] = "gravity",
    gains: Annotated[str | None, Parameter(metavar="GAINS.yaml")] = None,
    friction_ratio: Annotated[float, Parameter(metavar="R")] = 0.0,
    hysteresis_ratio: Annotated[float, Parameter(metavar="R")] = 0.0,
    friction_model: Annotated[str | None, Parameter(metavar="MODEL.yaml")] = None,
    publish_force: options.PublishForce = False,
) -> None:
    """Control an arm: compensate gravity, damp it, guide it or hold a pose.

    Args:
        mode: gravity: compensate gravity. damped: also damp the motion. guide: also keep the arm where a hand leaves
            it. hold: regulate the current pose.
        gains: Gains file written by simulate tune, for all modes except gravity. Default: the gains of the arm file.
        friction_ratio: Share of friction to compensate in the modes gravity and guide, 0 to 0.6. It is reduced if the
            arm could creep.
        hysteresis_ratio: Share of the wide hysteresis to compensate in the modes gravity and guide, 0 to 0.9.
        friction_model: Model with the friction parameters, identified from a motion. Default: the model of --model.
    """
    from dvrk_drake.processes.control import LiveStatus

    controlled.check(lcm={"reset": controlled.reset})
    printed = [("", "")]

    def show(status: LiveStatus) -> None:
        # Over ROS 2, the guard in this process reports the changes of its state.
        if (current := ("" if controlled.is_ros else status.state, status.problem)) == printed[0]:
            connection.dialog.show(lambda: str(status))
        else:
            printed[0] = current
            connection.dialog.report(str(status))

    with connect_arm(controlled, publish_force=publish_force) as connection:
        connection.run(
            mode,
            gains=gains,
            friction_ratio=friction_ratio,
            hysteresis_ratio=hysteresis_ratio,
            friction_model=friction_model,
            report=show,
        )
    support.print_line(f"control ended; {connection.arm.name} holds its pose")


@options.app.command(group=options.HARDWARE)
def status(*, connected: options.ConnectedArm, watch: bool = False) -> None:
    """Print the state of an arm, its reason, and what to do next.

    The topics of a dVRK on ROS 2 do not state what a guard counts, e.g. refused commands.

    Args:
        watch: Repeat until Ctrl-C.
    """
    from dvrk_drake.reports.arm_status import status_page
    from dvrk_drake.reports.terminal import make_console

    connected.check()
    connection, console = connected.connect(dvrk.Dialog(report=support.print_line)), make_console()
    with suppress(KeyboardInterrupt), closing(connection.watch()) as observations:
        for observation in observations:
            if watch:
                console.clear()
            support.show_page(status_page(connection.arm, observation))
            if not watch:
                return
            support.print_next_step()


@options.app.command(group=options.HARDWARE)
def stop(*, connected: options.ConnectedArm, power_off: bool = False) -> None:
    """Stop an arm.

    LCM: the guard obeys every sender with the key, also while a controller acts, and then holds the arm until an
    operator resumes. If no controller acts, the next one can start. ROS 2: the arm receives hold. A program that
    continues to publish commands moves it again; a bridge does not. This command does not replace the emergency stop
    button.

    Args:
        power_off: Also switch the motor power off. An arm without brakes falls.
    """

    connected.check()
    connection = connected.connect(dvrk.Dialog(report=support.print_line))
    support.print_line(f"{connection.arm.name} is stopped: {connection.hold(power_off=power_off)}")


@contextmanager
def connect_arm(
    controlled: options.ControlledArm, *, keys: bool = False, confirms: bool = False, **settings: Any
) -> Iterator[dvrk.ArmConnection]:
    """Context with the connection to the arm that the options of a command define, a dialog, and the status line.

    Ctrl-C ends the process at once, until this process commands the arm. From then on, `dialog.stopped` returns true
    after Ctrl-C.

    Args:
        controlled: Options of the command.
        keys: Whether the Enter key has an effect.
        confirms: Whether the operator must confirm the first motion, if there is a terminal.
        settings: See `dvrk_drake.connect`.
    """
    from dvrk_drake.processes.control import LiveLine
    from dvrk_drake.processes.pace import settle_memory
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey

    line, handlers = LiveLine(sys.stderr), list[Callable[[], bool]]()
    has_keys = keys and sys.stdin is not None and sys.stdin.isatty()
    enter = EnterKey(sys.stdin) if has_keys else None

    def stopped() -> bool:
        return any(handler() for handler in handlers)

    def ready() -> None:
        handlers.append(stop_on_signals())
        settle_memory()
        support.request_realtime(controlled.realtime)

    def confirm() -> None:
        if confirms and enter is not None:
            print("Clear the workspace of the arm. Enter starts the motion, Ctrl-C ends the command.", flush=True)
            while not stopped() and not enter():
                time.sleep(0.02)

    dialog = dvrk.Dialog(stopped=stopped, confirm=confirm, enter=enter, report=line.report, show=line.show)
    with support.interrupt_ends_process():
        try:
            yield controlled.connect(dialog, model=controlled.model, reset=controlled.reset, ready=ready, **settings)
        finally:
            line.clear()


@options.bridge.default
def bridge_arm(
    *,
    arm: options.Arm,
    instrument: options.Instrument = "",
    topic: options.RosTopic = None,
    domain: options.RosDomain = None,
    model: Annotated[
        options.Model | None,
        Parameter(help="Model with which the guard checks measurements. Default: the model of the SDF."),
    ] = None,
    driver: Annotated[str | None, Parameter(metavar="FILE.yaml")] = None,
    lcm_url: options.LcmUrl = "",
    key: options.Key = None,
    gravity: options.Gravity = None,
    realtime: options.Realtime = False,
    poll: Annotated[bool, Parameter(negative="")] = False,
    publish_force: options.PublishForce = False,
) -> None:
    """Connect a dVRK arm on ROS 2 to LCM, behind a command guard.

    Enable and home the arm at its console first. The bridge starts a deadman process, which holds the arm if the bridge
    is killed.

    Args:
        driver: Configuration file of the driver (docs/lcm.md). Default: the default configuration.
        poll: Poll for messages while a controller commands the arm. The delay decreases, but the bridge uses a
            processor core.
    """
    from dvrk_drake.processes.pace import settle_memory
    from dvrk_drake.processes.simulated_arm import run_bridge, stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.systems.ros.open_domain import domain_number

    def ready() -> None:
        settle_memory()
        support.request_realtime(realtime)

    domain_number(domain)  # rejects an invalid number before any other step
    with support.interrupt_ends_process():
        connected = support.mounted(dvrk.load_arm(arm, instrument), gravity)
        configuration = support.driver_configuration(driver, key, lcm_url)
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
        topic=topic,
        domain=domain,
        polls=poll,
        publish_force=publish_force,
        stopped=stopped,
        report=support.print_line,
        ready=ready,
        enter=EnterKey.of_terminal(),
    )
    if not is_confirmed:
        raise ControllerError("the bridge has ended, but the arm has not confirmed hold. The deadman process continues")
    print("bridge ended; the arm has confirmed hold", flush=True)


@options.bridge.command
def deadman(*, arm: options.Arm, topic: options.RosTopic = None, domain: options.RosDomain = None) -> None:
    """Hold a dVRK arm on ROS 2 when its commands stop for 50 ms.

    The bridge starts its own deadman process. Use this command for other programs that publish servo_jf or servo_jp, or
    on another computer.
    """
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.systems.ros.deadman import Deadman, request_priority
    from dvrk_drake.systems.ros.discovery import find_topic
    from dvrk_drake.systems.ros.open_domain import open_ros_domain

    priority = request_priority()  # the threads of DDS inherit it
    ros = open_ros_domain(domain)

    def report(line: str) -> None:
        with contextlib.suppress(OSError):
            print(line, flush=True)

    namespace = find_topic(ros, dvrk.load_arm(arm), topic, report=report).rpartition("/")[0]
    monitor = Deadman(ros, namespace, report)
    stopped = stop_on_signals()
    # A closed terminal must not end this process.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    print(f"deadman of {namespace}; Ctrl-C ends it; it has {priority}", flush=True)
    monitor.run(stopped)


@options.app.command(group=options.HARDWARE)
def sim_arm(
    *,
    connected: options.ConnectedArm,
    pose: Annotated[list[float] | None, Parameter(metavar="Q ..", consume_multiple=True)] = None,
    gravity: options.Gravity = None,
    effects: Annotated[list[str] | None, Parameter(metavar="NAME ..", consume_multiple=True)] = None,
    realtime: options.Realtime = False,
    driver: Annotated[str | None, Parameter(metavar="FILE.yaml")] = None,
    rate: Annotated[float | None, Parameter(metavar="HZ")] = None,
    model: options.Model | None = None,
    enabled: Annotated[bool, Parameter(show_default=False)] = False,
) -> None:
    """Simulate an arm with its driver, over LCM or ROS 2.

    On LCM, the driver has the command guard. On ROS 2, it has the topics of a dVRK.

    Args:
        pose: Initial joint positions [rad; m if prismatic]. Default: near zero, within the joint limits.
        effects: Simulated effects, e.g. friction, or all (docs/simulated_effects.md). Default: none.
        driver: LCM: configuration file of the driver (docs/lcm.md). Default: the default configuration.
        rate: ROS 2: rate of the measurements [Hz]. Default: 1000.
        model: ROS 2: model file for the gravity compensation. Default: the nominal model from the SDF.
        enabled: ROS 2: enable and home the arm at the start.
    """
    from dvrk_drake.processes.pace import settle_memory
    from dvrk_drake.processes.simulated_arm import SimulatedArm, SimulatedRosArm, start_pose, stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.systems.ros.open_domain import domain_number

    connected.check(lcm={"driver": driver}, ros={"rate": rate, "model": model, "enabled": enabled})
    arm = support.mounted(dvrk.load_arm(connected.arm), gravity)
    simulated_effects = None if effects is None else arm.effects.only(effects)
    start = start_pose(arm, pose, simulated_effects)
    simulated: SimulatedArm | SimulatedRosArm
    if connected.is_ros:
        domain_number(connected.domain)  # the driver has a different message, for its YAML file
        topics = dvrk.CrtkDriver(domain=connected.domain, namespace=connected.topic or "", model=model or "")
        topics.rate = topics.rate if rate is None else rate
        topics.check()
        support.request_realtime(realtime)  # the threads of DDS inherit it
    else:
        configuration = support.driver_configuration(driver, connected.key, connected.lcm_url)
    support.print_line(f"starting the simulated {arm.name}")
    with support.interrupt_ends_process():
        if connected.is_ros:
            simulated = SimulatedRosArm(arm, topics, start, simulated_effects, enabled=enabled)
        else:
            simulated = SimulatedArm(arm, configuration, start, effects=simulated_effects)
        stopped = stop_on_signals()
    settle_memory()
    if not connected.is_ros:
        support.request_realtime(realtime)
    support.print_line(f"simulated {arm.name} on {simulated.source}; press Ctrl-C to end")
    pace = simulated.run(stopped, support.print_line, EnterKey.of_terminal())
    support.print_line(f"ended; {pace.describe()}")
