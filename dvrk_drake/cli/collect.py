"""Commands that record an arm: record, and collect with its subcommands."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import HARDWARE, ConnectedArm, ControlledArm, Seconds, app, collect, one_of
from dvrk_drake.cli.control import connect_arm
from dvrk_drake.cli.support import (
    check_output,
    interrupt_ends_process,
    print_line,
    print_notes,
    print_written,
    suggest,
)
from dvrk_drake.errors import CollectionError

if TYPE_CHECKING:
    from dvrk_drake.processes.connection import ArmConnection
    from dvrk_drake.processes.live_status import LiveLine

StopOnContact = Annotated[
    float | None,
    Parameter(
        metavar="N",
        help="Hold the arm if the external effort shows a contact, with N expected false alarms per hour, e.g. 0.1. It "
        "requires --model, identified from a motion.",
    ),
]
_TASK = one_of("Task (one is required)")


@app.command(group=HARDWARE)
def record(
    file: Annotated[str, Parameter(metavar="FILE")],
    /,
    *,
    connected: ConnectedArm,
    duration: Annotated[Seconds | None, Parameter(metavar="S")] = None,
) -> None:
    """Record the measurements of an arm over LCM or ROS 2.

    The file contains only complete rows, even after Ctrl-C or an error.

    Args:
        file: New file: .mcap for a bag for ROS 2 tools, Foxglove and Rerun. With LCM also .csv, or .log for an LCM log.
        duration: Duration [s], counted from the first message. Default: until Ctrl-C.
    """
    from dvrk_drake.processes.arm_session import Dialog
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals

    connected.check()
    stopped, line = stop_on_signals(), LiveLine(sys.stderr)
    connection = connected.connect(Dialog(stopped, report=line.report, show=line.show))
    try:
        notes = connection.record(file, float("inf") if duration is None else duration)
    finally:
        line.clear()
    print_notes(file, notes)
    suggest(f"dvrk-drake check {file} --arm {connected.arm}")


@collect.command
def teach(
    poses: Annotated[str, Parameter(metavar="POSES.yaml")],
    /,
    *,
    controlled: ControlledArm,
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
    check_output(poses, overwrite=True)
    with interrupt_ends_process():
        connection, line = _connect(controlled, keys=True)
    event = "Enter or one second of rest" if at_rest else "Enter"
    print(f"{event} adds a pose, Ctrl-C ends", flush=True)
    try:
        with interrupt_ends_process():
            count = connection.teach(poses, at_rest=at_rest)
    finally:
        line.clear()
    print_written(poses, f"{count} poses; the arm holds its pose")
    suggest(f"dvrk-drake collect poses {poses} {controlled.as_text()} --output {Path(poses).with_suffix('.csv')}")


@collect.command(name="poses")
def collect_poses(
    poses: Annotated[str, Parameter(metavar="POSES.yaml")],
    /,
    *,
    controlled: ControlledArm,
    output: Annotated[str, Parameter(metavar="FILE.csv")],
    both_sides: Annotated[bool, Parameter(negative="--no-both-sides")] = True,
    traverse_time: Seconds = 5.0,
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
    lcm_only = {"realtime": controlled.realtime, "reset": controlled.reset}
    controlled.check(lcm=lcm_only, ros={"max_effort": max_effort, "yes": yes})
    check_output(poses, overwrite=True)
    check_output(output, poses, controlled.model or "", overwrite=True)
    given = {} if max_effort is None else {"max_effort": max_effort}
    with interrupt_ends_process():
        from dvrk_drake.processes.collector import CollectionSettings

        settings = CollectionSettings(traverse_time, both_sides, **given)
        connection, line = _connect(
            controlled, keys=controlled.is_ros, confirms=controlled.is_ros and not yes, stop_on_contact=stop_on_contact
        )
    try:
        with interrupt_ends_process():
            collector = connection.collect_poses(poses, output, settings)
    finally:
        line.clear()
    if collector is None:
        if connection.dialog.stopped():
            raise KeyboardInterrupt
        return
    # Over ROS 2, a missing confirmation of `hold` was reported.
    holds = "" if controlled.is_ros else "; the arm holds its pose"
    print_line(f"{output}: {collector.done.sum()} of {len(collector.done)} poses{holds}")
    if collector.problem is not None:
        raise collector.problem
    if connection.dialog.stopped():
        raise KeyboardInterrupt
    if collector.unsettled:
        numbers = ", ".join(map(str, collector.unsettled))
        raise CollectionError(
            f"the arm did not come to rest at poses {numbers}. Run the command again to repeat these poses"
        )
    suggest(f"dvrk-drake identify {output} --arm {controlled.arm} --output model.yaml")


@collect.command(name="motion")
def collect_motion(
    motion: Annotated[str, Parameter(metavar="MOTION.yaml")],
    /,
    *,
    controlled: ControlledArm,
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
    check_output(motion, overwrite=True)
    if output is not None:
        check_output(output, motion, controlled.model or "", overwrite=True)
    with interrupt_ends_process():
        connection, line = _connect(controlled, keys=True, stop_on_contact=stop_on_contact)
    try:
        with interrupt_ends_process():
            played = connection.play(motion, output)
    finally:
        line.clear()
    if played.path is not None:
        what = f"{played.begin:.1f} to {played.end:.1f} s of {played.duration:g} s"
        if output is None:
            what = f"largest tracking error {100 * played.tracking_error:.1f} % of the range of a joint"
        print_written(played.path, what)
    if not played.is_complete:
        if connection.dialog.stopped():
            raise KeyboardInterrupt
        raise CollectionError(f"{motion}: the motion ended early, at {played.end:.1f} s; run the command again")
    if output is not None:
        from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
        from dvrk_drake.processes.motion_parts import recorded_parts, useful

        parts = recorded_parts(output, connection.arm, PeriodicMotion.load(motion, connection.arm))
        files = " ".join(str(part.path) for part in useful(parts, played.duration))
        suggest(f"dvrk-drake identify {files} --arm {controlled.arm} --output model.yaml")
    else:
        recording = Path(motion).with_suffix(".csv")
        suggest(f"dvrk-drake collect motion {motion} {controlled.as_text()} --output {recording}")


def _connect(
    controlled: ControlledArm, *, keys: bool, confirms: bool = False, stop_on_contact: float | None = None
) -> tuple[ArmConnection, LiveLine]:
    """Returns the connection to the arm, with a dialog on the terminal, and its status line.

    Args:
        controlled: Options of the command.
        keys: Whether the Enter key has an effect.
        confirms: Whether the operator must confirm the first motion, if there is a terminal.
        stop_on_contact: See `dvrk_drake.connect`.
    """
    from dvrk_drake.processes.arm_session import Dialog
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.teacher import EnterKey

    line = LiveLine(sys.stderr)
    has_keys = keys and sys.stdin is not None and sys.stdin.isatty()
    enter = EnterKey(sys.stdin) if has_keys else None

    def confirm() -> None:
        if confirms and enter is not None:
            print("Clear the workspace of the arm. Enter starts the motion, Ctrl-C ends the command.", flush=True)
            while not connection.dialog.stopped() and not enter():
                time.sleep(0.02)

    dialog = Dialog(confirm=confirm, enter=enter, report=line.report, show=line.show)
    connection = connect_arm(controlled, dialog, stop_on_contact=stop_on_contact)
    return connection, line
