"""Command that calibrates a connected arm: a sequence of other commands, each with named files in one folder."""

from __future__ import annotations

import ctypes
import shlex
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import (
    HARDWARE,
    Arm,
    EnvironmentFile,
    Gravity,
    Key,
    LcmUrl,
    Realtime,
    Seconds,
    Seed,
    Table,
    app,
    whole_number,
)
from dvrk_drake.cli.support import load_environment, load_key, print_warning, print_written
from dvrk_drake.errors import DvrkDrakeError

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm as LoadedArm

#: Time after which a signal is sent to the running command, which may have received it from the terminal [s].
_FORWARD = 0.5
_SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP


@app.command(group=HARDWARE)
def calibrate(
    *,
    arm: Arm,
    output: Annotated[str, Parameter(metavar="FOLDER")],
    poses: Annotated[int, Parameter(metavar="N", converter=whole_number)] = 40,
    duration: Seconds = 30.0,
    seed: Seed = 0,
    gravity: Gravity = None,
    table: Table = None,
    environment: EnvironmentFile = None,
    lcm_url: LcmUrl = "",
    key: Key = None,
    realtime: Realtime = False,
    reset: Annotated[bool, Parameter(show_default=False)] = False,
    yes: Annotated[bool, Parameter(show_default=False)] = False,
) -> None:
    """Calibrate a connected arm: design, collect, identify, validate and export, with one command.

    The command runs other commands of dvrk-drake and prints them. Ctrl-C ends the calibration, and the arm holds its
    pose. The same command continues the calibration. Enter pauses a motion.

    Args:
        output: Folder for all files. An existing calibration in this folder is continued.
        poses: Number of static poses, 8 to 300.
        duration: Duration of the motion, 15 to 3600 s.
        reset: Print and clear a fault of the arm before its first motion. If the watchdog of the guard holds the arm,
            resume control.
        yes: Move the arm without a question. Required if there is no terminal.
    """
    from dvrk_drake.cli.calibration_steps import CalibrationSettings, calibration_steps, prepare_folder
    from dvrk_drake.models.arm_files import known_arms

    load_key(key)  # rejects an invalid file before the first step
    began = time.monotonic()
    folder = Path(output)
    settings = CalibrationSettings(
        arm=arm.lower() if arm.lower() in known_arms() else _absolute(arm),
        poses=poses,
        duration=duration,
        seed=seed,
        gravity=list(gravity or ()),
        environment=load_environment(table, environment),
    )
    if not yes and (sys.stdin is None or not sys.stdin.isatty()):
        raise DvrkDrakeError(f"{arm} would move without a question, because there is no terminal; add --yes")
    loaded = prepare_folder(folder, settings)
    connection = [f"--lcm-url={lcm_url}"] if lcm_url else []
    connection += ["--key", _absolute(key)] if key else []
    connection += ["--realtime"] if realtime else []
    count, moving = len(calibration_steps(folder, settings, loaded)), 0.0
    for number in range(count):
        # The commands depend on the files of the earlier steps.
        step = calibration_steps(folder, settings, loaded)[number]
        header = f"[{number + 1}/{count}] {step.title}"
        if step.done():
            print(f"{header}: done", flush=True)
            continue
        words = list(step.words)
        if step.moves:
            words += connection + (["--reset"] if reset else [])
            reset = False
        print(f"{header}: dvrk-drake {shlex.join(words)}", flush=True)
        if step.moves and not yes:
            _confirm(loaded.name)
        started = time.monotonic()
        code = _run(words, folder)
        moving += step.moves * (time.monotonic() - started)
        if code == 130:
            raise KeyboardInterrupt
        if code and step.is_required:
            raise DvrkDrakeError(
                f"{step.title} failed; the line above states the reason. The same command continues the calibration"
            )
        if code:
            print_warning(f"{step.title} failed; the line above states the reason. The calibration continues")
    _print_result(folder, loaded, settings.arm)
    minutes = (time.monotonic() - began) / 60
    print(f"{minutes:.1f} min in total, of which the arm was controlled for {moving / 60:.1f} min", flush=True)


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


def _absolute(path: str) -> str:
    """Returns the absolute path of a file, because the commands run in another folder. Other names are unchanged."""
    return str(Path(path).resolve()) if Path(path).is_file() else path


def _run(words: list[str], folder: Path) -> int:
    """Runs a command in the folder and returns its exit code. Signals to this process end the command first."""
    command = [sys.executable, "-m", "dvrk_drake.cli", *words]
    process = subprocess.Popen(command, cwd=folder, preexec_fn=_end_with_parent)  # noqa: PLW1509  no other thread runs
    received: list[int] = []
    num_sent = 0
    handlers = {number: signal.signal(number, lambda n, _: received.append(n)) for number in _SIGNALS}
    try:
        while True:
            try:
                code = process.wait(_FORWARD)
                break
            except subprocess.TimeoutExpired:
                # A terminal sends Ctrl-C to both processes. Other senders may have sent it only to this one.
                for number in received[num_sent:]:
                    process.send_signal(number)
                num_sent = len(received)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return 130 if received or code in (130, *(-number for number in _SIGNALS)) else code


def _end_with_parent() -> None:
    """Requests SIGTERM for this process when its parent ends, so that no motion continues without the calibration."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _print_result(folder: Path, arm: LoadedArm, name: str) -> None:
    """Prints the verdicts of both models, and the commands that use them."""
    from dvrk_drake.cli.calibration_steps import DYNAMIC, STATIC
    from dvrk_drake.dynamics.identified_model import IdentifiedModel

    is_usable = True
    for file, what in ((STATIC, "holding torques of other poses"), (DYNAMIC, "efforts of another motion")):
        validation = IdentifiedModel.load(folder / file).validation
        assert validation is not None
        joints: dict[str, list[str]] = {}
        for joint in arm.joint_names:
            joints.setdefault(validation.verdicts[joint], []).append(joint)
        verdicts = "; ".join(f"{verdict}: {', '.join(names)}" for verdict, names in joints.items())
        print(f"Verdicts on {file} for {what}: {verdicts}", flush=True)
        is_usable &= "do not use" not in joints
    for file, what in (
        ("report.html", "errors and verdict of the full dynamics"),
        ("holding_report.html", "errors and verdict of its holding torques at other poses"),
        ("static_report.html", "errors and verdict of the static model"),
        ("model_report.html", "parameters of the full dynamics"),
        ("model.sdf", "full dynamics for Drake"),
        ("gravity.json", "gravity compensation of the dVRK"),
    ):
        if (folder / file).exists():
            print_written(folder / file, what)
    if not is_usable:
        print_warning("a joint failed the validation; look at the reports before you use the models")
        return
    model = folder / DYNAMIC
    print(
        f"Next: dvrk-drake control --arm {name} --model {model} --friction-model {model} --friction-ratio 0.3\n"
        f"In the driver's configuration of the arm: model: {model.resolve()}",
        flush=True,
    )
