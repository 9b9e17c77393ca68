"""Commands that record an arm: record, and collect with its subcommands."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from dvrk_drake.cli.app import HARDWARE, AnyArm, CollectedArm, ControlledArm, Seconds, app, one_of
from dvrk_drake.cli.collect_motion import follow_motion
from dvrk_drake.cli.lcm import checked_start, ready_controller
from dvrk_drake.cli.support import (
    check_output,
    interrupt_ends_process,
    load_key,
    load_model,
    print_notes,
    print_written,
    quiet_drake,
)
from dvrk_drake.errors import CollectionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dvrk_drake.models.arm import Arm as LoadedArm
    from dvrk_drake.processes.collector import Collector
    from dvrk_drake.processes.crtk_collector import CrtkCollector
    from dvrk_drake.recordings.pose_file import CollectionFile

collect = App(name="collect", group=HARDWARE, help="Measure an arm: teach poses, collect static poses or a motion.")
app.command(collect)
_TASK = one_of("Task (one is required)")


@app.command(group=HARDWARE)
def record(
    file: Annotated[str, Parameter(metavar="FILE")],
    /,
    *,
    connected: AnyArm,
    duration: Annotated[Seconds | None, Parameter(metavar="S")] = None,
) -> None:
    """Record the measurements of an arm over LCM or ROS 2.

    The file contains only complete rows, even after Ctrl-C or an error.

    Args:
        file: New file: .mcap for a bag for ROS 2 tools, Foxglove and Rerun. With LCM also .csv, or .log for an LCM log.
        duration: Duration [s], counted from the first message. Default: until Ctrl-C.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.recorder import Recorder
    from dvrk_drake.processes.ros_recorder import RosRecorder
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.writer_stream import check_stream_output
    from dvrk_drake.systems.lcm.lcm_network import open_lcm

    connected.check()
    recorded, line = load_arm(connected.arm), LiveLine(sys.stderr)
    recorder: Recorder | RosRecorder
    if connected.is_ros:
        recorder = RosRecorder(recorded, file, connected.topic, connected.domain, line.report)
    else:
        check_stream_output(file)
        url, key = open_lcm(connected.lcm_url).get_lcm_url(), load_key(connected.key)
        recorder = Recorder(recorded, file, url, key)
    stopped = stop_on_signals()
    print(f"recording {recorded.name} on {recorder.source}; Ctrl-C ends the recording", flush=True)
    try:
        recorder.run(float("inf") if duration is None else duration, stopped, line.show)
    finally:
        line.clear()
    print_written(file, f"{recorder.num_rows} rows")
    print_notes(file, recorder.notes())


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
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey, Teacher
    from dvrk_drake.recordings.pose_file import load_poses_if_any

    check_output(poses, overwrite=True)
    load_poses_if_any(poses, load_arm(controlled.arm))  # rejects an invalid file before the arm is connected
    with interrupt_ends_process():
        controller, link, _ = ready_controller(controlled, "gravity")
        stopped = stop_on_signals()
    line = LiveLine(sys.stderr)
    teacher = Teacher(controller, poses, at_rest=at_rest, requested=EnterKey(sys.stdin), report=line.report)
    event = "Enter or one second of rest" if at_rest else "Enter"
    print(
        f"{controller.arm.name} compensates gravity; move the arm by hand; {event} adds a pose, Ctrl-C ends", flush=True
    )
    try:
        control(
            link(),
            controller,
            stopped,
            lambda text: line.show(lambda: f"{len(teacher.poses)} poses; {text}"),
            teacher.update,
        )
    finally:
        teacher.close()
        line.clear()
    print_written(poses, f"{len(teacher.poses)} poses; the guard of {controller.arm.name} regulates the pose")


@collect.command(name="poses")
def collect_poses(
    poses: Annotated[str, Parameter(metavar="POSES.yaml")],
    /,
    *,
    controlled: CollectedArm,
    output: Annotated[str, Parameter(metavar="FILE.csv")],
    both_sides: Annotated[bool, Parameter(negative="--no-both-sides")] = True,
    traverse_time: Seconds = 5.0,
    max_effort: Annotated[float | None, Parameter(metavar="SHARE")] = None,
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
    if controlled.is_ros:
        _visit_over_ros(controlled, poses, output, both_sides, traverse_time, max_effort, yes)
    else:
        _visit(controlled, poses, output, both_sides, traverse_time)


@collect.command(name="motion")
def collect_motion(
    motion: Annotated[str, Parameter(metavar="MOTION.yaml")],
    /,
    *,
    controlled: ControlledArm,
    output: Annotated[str | None, Parameter(metavar="FILE.csv", group=_TASK)] = None,
    rehearse: Annotated[bool, Parameter(show_default=False, group=_TASK)] = False,
) -> None:
    """Move an arm along a motion and record its efforts. Requires LCM.

    After an interruption, run the same command again to continue. Enter pauses the motion. Ctrl-C ends it, and the arm
    holds its pose.

    Args:
        motion: Motion file, written by dvrk-drake excite.
        output: CSV file for the measurements.
        rehearse: Follow one period of the motion at a fifth of its speed. Required once before the first recording.
    """
    follow_motion(controlled, motion, None if rehearse else output)


def _visit(
    controlled: ControlledArm,
    poses_file: str,
    output_file: str,
    both_sides: bool,
    traverse_time: float,
) -> None:
    import numpy as np

    from dvrk_drake.models.approach import offset_pose
    from dvrk_drake.processes.collector import CollectionSettings, Collector, short_approach_offset
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.pose_file import pose_environment

    settings = CollectionSettings(traverse_time, both_sides)
    arm, poses, output = _files(controlled, poses_file, output_file, both_sides)
    num_done = output.finished(poses).sum()
    if num_done == len(poses):
        print(f"{output_file}: contains all {len(poses)} poses already")
        return
    with interrupt_ends_process():
        controller, link, _period = ready_controller(controlled, "hold")
        first = poses[int(np.argmin(output.finished(poses)))]
        if both_sides:
            first = offset_pose(arm, first, -short_approach_offset(arm))
        checked_start(load_model(controlled.model, controlled.arm), link, first, pose_environment(poses_file))
        stopped = stop_on_signals()
    line = LiveLine(sys.stderr)
    collector = Collector(poses, controller, output, settings, stopped=stopped, report=line.report)
    print(f"{len(poses) - num_done} poses of {arm.name} remain; after Ctrl-C, the same command continues", flush=True)
    try:
        control(
            link(),
            controller,
            lambda: collector.finished,
            lambda text: line.show(lambda: f"{collector.describe()}; {text}"),
            collector.update,
        )
    finally:
        collector.close()
        line.clear()
        print(f"{output_file}: {collector.done.sum()} of {len(poses)} poses", flush=True)
    _end(collector, stopped)


def _visit_over_ros(
    controlled: CollectedArm,
    poses_file: str,
    output_file: str,
    both_sides: bool,
    traverse_time: float,
    max_effort: float | None,
    yes: bool,
) -> None:
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.processes.crtk_collection import Dialog, bag_path, run_crtk_collection
    from dvrk_drake.processes.crtk_collector import CrtkCollectionSettings
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.systems.ros.open_domain import domain_number

    quiet_drake()
    domain_number(controlled.domain)  # rejects an invalid number before any other step
    settings = CrtkCollectionSettings(traverse_time, both_sides)
    if max_effort is not None:
        settings = CrtkCollectionSettings(traverse_time, both_sides, max_effort)
    arm, poses, output = _files(controlled, poses_file, output_file, both_sides)
    remaining = len(poses) - output.finished(poses).sum()
    if not remaining:
        print(f"{output_file}: contains all {len(poses)} poses already")
        return
    model = None if controlled.model is None else IdentifiedModel.load(controlled.model, arm)
    line, bag = LiveLine(sys.stderr), bag_path(output_file)
    with interrupt_ends_process():
        stopped = stop_on_signals()
    has_keys = sys.stdin is not None and sys.stdin.isatty()
    enter = EnterKey(sys.stdin) if has_keys else lambda: False

    def confirm() -> None:
        if has_keys and not yes:
            print("Clear the workspace of the arm. Enter starts the motion, Ctrl-C ends the command.", flush=True)
            while not stopped() and not enter():
                time.sleep(0.02)

    print(f"{remaining} poses of {arm.name} remain; after Ctrl-C, the same command continues", flush=True)
    dialog = Dialog(stopped, confirm, enter, line.report, line.show)
    collector = None
    try:
        collector = run_crtk_collection(
            arm, poses, output, bag, settings, dialog, model=model, topic=controlled.topic, domain=controlled.domain
        )
    finally:
        line.clear()
    if collector is None:
        raise KeyboardInterrupt
    print(
        f"{output_file}: {collector.done.sum()} of {len(poses)} poses; messages: {bag}; hold was published", flush=True
    )
    _end(collector, stopped)


def _files(
    controlled: ControlledArm, poses_file: str, output_file: str, both_sides: bool
) -> tuple[LoadedArm, NDArray[np.float64], CollectionFile]:
    """Returns the arm, the poses, and the output file, which may contain some of the poses.

    Raises:
        CollectionError: A file is not valid, or the output file has other poses.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.recordings.pose_file import CollectionFile, load_poses

    arm = load_arm(controlled.arm)
    poses = load_poses(poses_file, arm)
    check_output(output_file, poses_file, controlled.model or "", overwrite=True)
    return arm, poses, CollectionFile(output_file, arm, both_sides)


def _end(collector: Collector | CrtkCollector, stopped: Callable[[], bool]) -> None:
    """Raises the error that ended a collection early, if there is one."""
    if collector.problem is not None:
        raise collector.problem
    if stopped():
        raise KeyboardInterrupt
    if collector.unsettled:
        numbers = ", ".join(map(str, collector.unsettled))
        raise CollectionError(
            f"the arm did not come to rest at poses {numbers}. Run the command again to repeat these poses"
        )
