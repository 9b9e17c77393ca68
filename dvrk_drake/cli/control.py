"""Commands for a connected arm: keygen, control, status and stop."""

from __future__ import annotations

import sys
from contextlib import closing, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from dvrk_drake.cli.app import HARDWARE, ConnectedArm, ControlledArm, PublishForce, app
from dvrk_drake.cli.support import (
    interrupt_ends_process,
    print_line,
    print_next_step,
    print_warning,
    print_written,
    request_realtime,
    show_page,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from dvrk_drake.models.arm_schema import Gains
    from dvrk_drake.processes.arm_session import Dialog
    from dvrk_drake.processes.connection import ArmConnection
    from dvrk_drake.systems.friction_compensator import FrictionCompensator
    from dvrk_drake.systems.gravity_pid_controller import Mode


@app.command(group=HARDWARE)
def keygen(*, output: Annotated[str, Parameter(metavar="FILE")]) -> None:
    """Create a key to sign LCM messages.

    Args:
        output: New key file. Only the owner of the file can read it.
    """
    from dvrk_drake.models.lcm_messages import create_key_file

    create_key_file(output)
    print_written(
        output,
        "copy the file to the other computer, e.g. with scp -p, and give it with --key to the arm and the controller",
    )


@app.command(group=HARDWARE)
def control(
    *,
    controlled: ControlledArm,
    mode: Literal["gravity", "damped", "guide", "hold"] = "gravity",
    gains: Annotated[str | None, Parameter(metavar="GAINS.yaml")] = None,
    friction_ratio: Annotated[float, Parameter(metavar="R")] = 0.0,
    hysteresis_ratio: Annotated[float, Parameter(metavar="R")] = 0.0,
    friction_model: Annotated[str | None, Parameter(metavar="MODEL.yaml")] = None,
    publish_force: PublishForce = False,
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
    from dvrk_drake.dynamics.friction_compensation import is_cross_validated
    from dvrk_drake.processes.arm_session import Dialog
    from dvrk_drake.processes.live_status import LiveLine, LiveStatus

    controlled.check(lcm={"reset": controlled.reset})
    with interrupt_ends_process():
        compensator = _friction_compensator(controlled, mode, friction_ratio, hysteresis_ratio, friction_model)
        checked_gains = None if gains is None else _gains(gains, mode, controlled.arm)
        connection = connect_arm(controlled, Dialog(report=print_line), publish_force=publish_force)
    if mode == "guide" and not is_cross_validated(connection.model):
        print_warning(
            "the error of the model is unknown, because it was not identified from a recording; virtual friction holds "
            "the arm only up to the dry friction of the arm file"
        )
    name = connection.arm.name
    line, printed = LiveLine(sys.stderr), [("", "")]

    def show(status: LiveStatus) -> None:
        if (current := (status.state, status.problem)) == printed[0]:
            line.show(lambda: str(status))
            return
        printed[0] = current
        line.clear()
        print(status, flush=True)

    try:
        with interrupt_ends_process():
            connection.run(mode, gains=checked_gains, friction=compensator, report=show)
    finally:
        line.clear()
    print_line(f"control ended; {name} holds its pose")


@app.command(group=HARDWARE)
def status(*, connected: ConnectedArm, watch: bool = False) -> None:
    """Print the state of an arm, its reason, and what to do next.

    The topics of a dVRK on ROS 2 do not state what a guard counts, e.g. refused commands.

    Args:
        watch: Repeat until Ctrl-C.
    """
    from dvrk_drake.processes.arm_session import Dialog
    from dvrk_drake.reports.arm_status import status_page
    from dvrk_drake.reports.terminal import make_console

    connected.check()
    connection, console = connected.connect(Dialog(report=print_line)), make_console()
    with suppress(KeyboardInterrupt), closing(connection.watch()) as observations:
        for observation in observations:
            if watch:
                console.clear()
            show_page(status_page(connection.arm, observation))
            if not watch:
                return
            print_next_step()


@app.command(group=HARDWARE)
def stop(*, connected: ConnectedArm, power_off: bool = False) -> None:
    """Stop an arm.

    LCM: the guard obeys every sender with the key, also while a controller acts, and holds the arm until an operator
    resumes. ROS 2: the arm receives hold. A program that continues to publish commands moves it again; a bridge does
    not. This command does not replace the emergency stop button.

    Args:
        power_off: Also switch the motor power off. An arm without brakes falls.
    """
    from dvrk_drake.processes.arm_session import Dialog

    connected.check()
    connection = connected.connect(Dialog(report=print_line))
    print_line(f"{connection.arm.name} is stopped: {connection.hold(power_off=power_off)}")


def _gains(path: str, mode: Mode, arm: str) -> Gains:
    """Loads the file given with --gains.

    Raises:
        ControllerError: The mode uses no gains, or the gains are not valid for the arm.
    """
    from dvrk_drake.errors import ControllerError
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.models.arm_schema import load_gains

    if mode == "gravity":
        raise ControllerError("--gains requires --mode damped, guide or hold; mode gravity does not use gains")
    gains = load_gains(path)
    if fault := load_arm(arm).gains_fault(gains):
        raise ControllerError(f"{path}: {fault}")
    return gains


def _friction_compensator(
    controlled: ControlledArm, mode: Mode, ratio: float, hysteresis_ratio: float, friction_model: str | None
) -> FrictionCompensator | None:
    """Returns the compensator for --friction-ratio and --hysteresis-ratio, and warns if it reduces a friction ratio.

    Returns None if both ratios are 0.

    Raises:
        ControllerError: A ratio is out of range, the mode is not gravity or guide, or no suitable model is given.
        ModelError: The model contains no friction or belongs to another arm.
    """
    if ratio == hysteresis_ratio == 0:
        return None
    from dvrk_drake.dynamics.friction_compensation import Friction, holding_error
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.errors import ControllerError
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.systems.friction_compensator import FrictionCompensator

    if mode not in ("gravity", "guide"):
        raise ControllerError(
            f"--friction-ratio and --hysteresis-ratio require --mode gravity or guide; mode {mode} does not compensate "
            "friction"
        )
    if controlled.model is None:
        raise ControllerError(
            "--friction-ratio and --hysteresis-ratio require --model; with compensated friction, an inaccurate "
            "gravity model makes the arm creep"
        )
    arm = load_arm(controlled.arm)
    model = IdentifiedModel.load(controlled.model, arm)
    error = holding_error(model) if ratio else None
    friction = Friction.of_model(IdentifiedModel.load(friction_model or controlled.model, arm))
    compensator = FrictionCompensator(
        friction,
        ratio=ratio,
        hysteresis_ratio=hysteresis_ratio,
        holding_error=error,
    )
    elements = zip(friction.effects, compensator.ratios, friction.springs_back, strict=True)
    ratios = {e.coordinate: r for e, r, springs_back in elements if not springs_back}
    if reduced := ", ".join(f"{name} {r:.2f}" for name, r in ratios.items() if r < 0.99 * ratio):
        print_warning(
            "the friction ratio is reduced, because friction must resist the error of the gravity model. Ratios: "
            f"{reduced}"
        )
    return compensator


def connect_arm(controlled: ControlledArm, dialog: Dialog, **settings: Any) -> ArmConnection:
    """Returns the connection to the arm that the options of a command define. See `dvrk_drake.connect` for `settings`.

    Use the connection within `interrupt_ends_process`. Ctrl-C then ends the process at once, until this process
    commands the arm. From then on, `dialog.stopped` returns true after Ctrl-C.
    """
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.connection import model_warning
    from dvrk_drake.processes.pace import settle_memory
    from dvrk_drake.processes.simulated_arm import stop_on_signals

    handlers: list[Callable[[], bool]] = []

    def ready() -> None:
        handlers.append(stop_on_signals())
        settle_memory()
        request_realtime(controlled.realtime)

    model = None
    if controlled.model is not None:
        model = IdentifiedModel.load(controlled.model, load_arm(controlled.arm))
        if warning := model_warning(controlled.model, model):
            print_warning(warning)
    dialog = replace(dialog, stopped=lambda: any(handler() for handler in handlers))
    return controlled.connect(dialog, model=model, reset=controlled.reset, ready=ready, **settings)
