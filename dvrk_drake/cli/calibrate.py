"""Command that calibrates a connected arm: a sequence of other commands, each with named files in one folder."""

from __future__ import annotations

import sys
import termios
from typing import Annotated

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli.app import (
    HARDWARE,
    ConnectedArm,
    EnvironmentFile,
    Gravity,
    Realtime,
    Seconds,
    Seed,
    Table,
    app,
    whole_number,
)
from dvrk_drake.cli.support import load_environment, load_key, print_line, print_warning, print_written, suggest
from dvrk_drake.errors import DvrkDrakeError


@app.command(group=HARDWARE)
def calibrate(
    *,
    connected: ConnectedArm,
    output: Annotated[str, Parameter(metavar="FOLDER")],
    poses: Annotated[int, Parameter(metavar="N", converter=whole_number)] = 40,
    duration: Seconds = 30.0,
    seed: Seed = 0,
    gravity: Gravity = None,
    table: Table = None,
    environment: EnvironmentFile = None,
    realtime: Realtime = False,
    reset: Annotated[bool, Parameter(show_default=False)] = False,
    yes: Annotated[bool, Parameter(show_default=False)] = False,
) -> None:
    """Calibrate a connected arm, from designed poses to a report.

    The steps are: design, collect, identify, validate and export. The command runs other commands of dvrk-drake and
    prints them. Ctrl-C ends the calibration, and the arm holds its pose. The same command continues the calibration.
    Enter pauses a motion.

    Args:
        output: Folder for all files. An existing calibration in this folder is continued.
        poses: Number of static poses, 8 to 300.
        duration: Duration of the motion, 15 to 3600 s.
        reset: Print and clear a fault of the arm before its first motion. If the watchdog of the guard holds the arm,
            resume control.
        yes: Move the arm without a question. Required if there is no terminal.
    """
    connected.check(lcm={"reset": reset})
    load_key(connected.key)  # rejects an invalid file before the first step
    around = load_environment(table, environment)
    if not yes and (sys.stdin is None or not sys.stdin.isatty()):
        raise DvrkDrakeError(f"{connected.arm} would move without a question, because there is no terminal; add --yes")
    result = dvrk.calibrate(
        connected.arm,
        output,
        poses=poses,
        duration=duration,
        seed=seed,
        gravity=gravity,
        environment=around,
        transport=connected.transport,
        lcm_url=connected.lcm_url,
        key=connected.key,
        topic=connected.topic,
        domain=connected.domain,
        realtime=realtime,
        reset=reset,
        confirm=(lambda name: None) if yes else _confirm,
        report=print_line,
    )
    print(*result.summary(), sep="\n", flush=True)
    print_line(
        f"{result.duration / 60:.1f} min in total, of which the arm was controlled for {result.moving / 60:.1f} min"
    )
    for file, what in (
        ("report.html", "errors and verdict of the full dynamics"),
        ("holding_report.html", "errors and verdict of its holding torques at other poses"),
        ("static_report.html", "errors and verdict of the static model"),
        ("model_report.html", "parameters of the full dynamics"),
        ("model.sdf", "full dynamics for Drake"),
        ("gravity.json", "gravity compensation of the dVRK"),
    ):
        if (result.folder / file).exists():
            print_written(result.folder / file, what)
    if result.is_usable:
        model = result.folder / "model.yaml"
        print_line(f"In the driver's configuration of the arm: model: {model.resolve()}")
        suggest(f"dvrk-drake control {connected.as_text()} --model {model} --mode guide --friction-ratio 0.3")
    else:
        print_warning("a joint failed the validation; look at the reports before you use the models")


def _confirm(name: str) -> None:
    """Asks the operator before a motion.

    Raises:
        KeyboardInterrupt: The input ended.
    """
    # Keys that were pressed before the question do not answer it.
    termios.tcflush(sys.stdin, termios.TCIFLUSH)
    try:
        input(f"Clear the workspace of {name}. Enter starts the motion, Ctrl-C ends the command. ")
    except EOFError:
        raise KeyboardInterrupt from None
