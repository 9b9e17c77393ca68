"""Commands for a connected arm: keygen, control, status and stop."""

from __future__ import annotations

import sys
from contextlib import closing, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support

if TYPE_CHECKING:
    from collections.abc import Callable


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
    from dvrk_drake.processes.live_status import LiveLine, LiveStatus

    controlled.check(lcm={"reset": controlled.reset})
    line, printed = LiveLine(sys.stderr), [("", "")]

    def show(status: LiveStatus) -> None:
        # Over ROS 2, the guard in this process reports the changes of its state.
        if (current := ("" if controlled.is_ros else status.state, status.problem)) == printed[0]:
            line.show(lambda: str(status))
            return
        printed[0] = current
        line.clear()
        print(status, flush=True)

    try:
        with support.interrupt_ends_process():
            connection = connect_arm(controlled, dvrk.Dialog(report=support.print_line), publish_force=publish_force)
            connection.run(
                mode,
                gains=gains,
                friction_ratio=friction_ratio,
                hysteresis_ratio=hysteresis_ratio,
                friction_model=friction_model,
                report=show,
            )
    finally:
        line.clear()
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

    LCM: the guard obeys every sender with the key, also while a controller acts, and holds the arm until an operator
    resumes. ROS 2: the arm receives hold. A program that continues to publish commands moves it again; a bridge does
    not. This command does not replace the emergency stop button.

    Args:
        power_off: Also switch the motor power off. An arm without brakes falls.
    """

    connected.check()
    connection = connected.connect(dvrk.Dialog(report=support.print_line))
    support.print_line(f"{connection.arm.name} is stopped: {connection.hold(power_off=power_off)}")


def connect_arm(controlled: options.ControlledArm, dialog: dvrk.Dialog, **settings: Any) -> dvrk.ArmConnection:
    """Returns the connection to the arm that the options of a command define. See `dvrk_drake.connect` for `settings`.

    Use the connection within `interrupt_ends_process`. Ctrl-C then ends the process at once, until this process
    commands the arm. From then on, `dialog.stopped` returns true after Ctrl-C.
    """
    from dvrk_drake.processes.pace import settle_memory
    from dvrk_drake.processes.simulated_arm import stop_on_signals

    handlers: list[Callable[[], bool]] = []

    def ready() -> None:
        handlers.append(stop_on_signals())
        settle_memory()
        support.request_realtime(controlled.realtime)

    dialog = replace(dialog, stopped=lambda: any(handler() for handler in handlers))
    return controlled.connect(dialog, model=controlled.model, reset=controlled.reset, ready=ready, **settings)
