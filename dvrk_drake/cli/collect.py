"""Commands that record an arm: record, collect with its subcommands, and calibrate."""

from __future__ import annotations

import sys
import termios
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.cli.control import connect_arm
from dvrk_drake.errors import CollectionError, DvrkDrakeError

StopOnContact = Annotated[
    float | None,
    Parameter(
        metavar="N",
        help="Hold the arm if the external effort shows a contact, with N expected false alarms per hour, e.g. 0.1. It "
        "requires --model, identified from a motion.",
    ),
]
_TASK = options.one_of("Task (one is required)")


@options.app.command(group=options.HARDWARE)
def record(
    file: Annotated[str, Parameter(metavar="FILE")],
    /,
    *,
    connected: options.ConnectedArm,
    duration: Annotated[options.Seconds | None, Parameter(metavar="S")] = None,
) -> None:
    """Record the measurements of an arm over LCM or ROS 2.

    The file contains only complete rows, even after Ctrl-C or an error.

    Args:
        file: New file: .mcap for a bag for ROS 2 tools, Foxglove and Rerun. With LCM also .csv, or .log for an LCM log.
        duration: Duration [s], counted from the first message. Default: until Ctrl-C.
    """
    from dvrk_drake.processes.control import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals

    connected.check()
    stopped, line = stop_on_signals(), LiveLine(sys.stderr)
    connection = connected.connect(dvrk.Dialog(stopped, report=line.report, show=line.show))
    try:
        notes = connection.record(file, float("inf") if duration is None else duration)
    finally:
        line.clear()
    support.print_notes(file, notes)
    support.suggest(f"dvrk-drake check {file} --arm {connected.arm}")


@options.collect.command
def teach(
    poses: Annotated[str, Parameter(metavar="POSES.yaml")],
    /,
    *,
    controlled: options.ControlledArm,
    at_rest: Annotated[bool, Parameter(show_default=False)] = False,
) -> None:
    """Add poses to a pose file while you move the arm by hand.

    The arm compensates gravity. The Enter key adds the current pose. Ctrl-C ends the command, and the arm holds its
    pose.

    Args:
        poses: Pose file to write. The poses of an existing file are kept.
        at_rest: Also add each pose at which the arm is at rest for one second.
    """
    controlled.check(lcm={"reset": controlled.reset})
    support.check_output(poses, overwrite=True)
    with connect_arm(controlled, keys=True) as connection:
        print(f"{'Enter or one second of rest' if at_rest else 'Enter'} adds a pose, Ctrl-C ends", flush=True)
        count = connection.teach(poses, at_rest=at_rest)
    support.print_written(poses, f"{count} poses; the arm holds its pose")
    support.suggest(
        f"dvrk-drake collect poses {poses} {controlled.as_text()} --output {Path(poses).with_suffix('.csv')}"
    )


@options.collect.command(name="poses")
def collect_poses(
    poses: Annotated[str, Parameter(metavar="POSES.yaml")],
    /,
    *,
    controlled: options.ControlledArm,
    output: Annotated[str, Parameter(metavar="FILE.csv")],
    both_sides: Annotated[bool, Parameter(negative="--no-both-sides")] = True,
    traverse_time: options.Seconds = 5.0,
    max_effort: Annotated[float | None, Parameter(metavar="SHARE")] = None,
    stop_on_contact: StopOnContact = None,
    yes: Annotated[bool, Parameter(show_default=False)] = False,
) -> None:
    """Move an arm to the poses of a file, and record its efforts at rest.

    After an interruption, run the same command again to continue. Ctrl-C ends the command, and the arm holds its pose.
    With --transport ros, the dVRK moves the arm (move_jp), Enter pauses, and the messages of each run are also written
    to a new bag beside the CSV: POSES_1.mcap, POSES_2.mcap, ...

    Args:
        poses: Pose file, written by dvrk-drake excite --static or dvrk-drake collect teach.
        output: CSV file with one row per pose.
        both_sides: Approach each pose from below and from above, and average the torques to cancel dry friction.
        traverse_time: Time to move a joint over its full range, 1 to 60 s. This time defines the speed between poses.
        max_effort: ROS 2: stop if an effort differs from the gravity effort of the model by this share of its limit,
            0.05 to 2. Default: 0.6.
        yes: ROS 2: move the arm without a question on the terminal.
    """
    controlled.check(lcm={"reset": controlled.reset}, ros={"max_effort": max_effort, "yes": yes})
    support.check_output(poses, overwrite=True)
    support.check_output(output, poses, controlled.model or "", overwrite=True)
    given = {} if max_effort is None else {"max_effort": max_effort}
    confirms = controlled.is_ros and not yes
    with connect_arm(
        controlled, keys=controlled.is_ros, confirms=confirms, stop_on_contact=stop_on_contact
    ) as connection:
        settings = dvrk.CollectionSettings(traverse_time, both_sides, **given)
        collector = connection.collect_poses(poses, output, settings)
    if collector is None:
        if connection.dialog.stopped():
            raise KeyboardInterrupt
        return
    # Over ROS 2, a missing confirmation of `hold` was reported.
    holds = "" if controlled.is_ros else "; the arm holds its pose"
    support.print_line(f"{output}: {collector.done.sum()} of {len(collector.done)} poses{holds}")
    if collector.problem is not None:
        raise collector.problem
    if connection.dialog.stopped():
        raise KeyboardInterrupt
    if collector.unsettled:
        numbers = ", ".join(map(str, collector.unsettled))
        raise CollectionError(
            f"the arm did not come to rest at poses {numbers}. Run the command again to repeat these poses"
        )
    support.suggest(f"dvrk-drake identify {output} --arm {controlled.arm} --output model.yaml")


@options.collect.command(name="motion")
def collect_motion(
    motion: Annotated[str, Parameter(metavar="MOTION.yaml")],
    /,
    *,
    controlled: options.ControlledArm,
    output: Annotated[str | None, Parameter(metavar="FILE.csv", group=_TASK)] = None,
    rehearse: Annotated[bool, Parameter(show_default=False, group=_TASK)] = False,
    stop_on_contact: StopOnContact = None,
) -> None:
    """Move an arm along a motion and record its efforts.

    After an interruption, run the same command again to continue. Enter pauses the motion. Ctrl-C ends it, and the arm
    holds its pose.

    Args:
        motion: Motion file, written by dvrk-drake excite.
        output: CSV file for the measurements.
        rehearse: Follow one period of the motion at a fifth of its speed. Required once before the first recording.
    """
    controlled.check(lcm={"reset": controlled.reset})
    support.check_output(motion, overwrite=True)
    if output is not None:
        support.check_output(output, motion, controlled.model or "", overwrite=True)
    with connect_arm(controlled, keys=True, stop_on_contact=stop_on_contact) as connection:
        played = connection.play(motion, output)
    if played.path is not None:
        what = f"{played.begin:.1f} to {played.end:.1f} s of {played.duration:g} s"
        if output is None:
            what = f"largest tracking error {100 * played.tracking_error:.1f} % of the range of a joint"
        support.print_written(played.path, what)
    if not played.is_complete:
        if connection.dialog.stopped():
            raise KeyboardInterrupt
        raise CollectionError(f"{motion}: the motion ended early, at {played.end:.1f} s; run the command again")
    if output is not None:
        files = " ".join(map(str, played.recordings))
        support.suggest(f"dvrk-drake identify {files} --arm {controlled.arm} --output model.yaml")
    else:
        recording = Path(motion).with_suffix(".csv")
        support.suggest(f"dvrk-drake collect motion {motion} {controlled.as_text()} --output {recording}")


@options.app.command(group=options.HARDWARE)
def calibrate(
    *,
    connected: options.ConnectedArm,
    output: Annotated[str, Parameter(metavar="FOLDER")],
    poses: Annotated[int, Parameter(metavar="N", converter=options.whole_number)] = 40,
    duration: options.Seconds = 30.0,
    seed: options.Seed = 0,
    gravity: options.Gravity = None,
    table: options.Table = None,
    environment: options.EnvironmentFile = None,
    realtime: options.Realtime = False,
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
    support.load_key(connected.key)  # rejects an invalid file before the first step
    around = support.load_environment(table, environment)
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
        report=support.print_line,
    )
    print(*result.summary(), sep="\n", flush=True)
    support.print_line(
        f"{result.duration / 60:.1f} min in total, of which the arm was controlled for {result.moving / 60:.1f} min"
    )
    for path, what in result.files().items():
        support.print_written(path, what)
    if result.is_usable:
        model = result.folder / "model.yaml"
        support.print_line(f"In the driver's configuration of the arm: model: {model.resolve()}")
        support.suggest(f"dvrk-drake control {connected.as_text()} --model {model} --mode guide --friction-ratio 0.3")
    else:
        support.print_warning("a joint failed the validation; look at the reports before you use the models")


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
