"""Commands that record an arm: record and collect."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import HARDWARE, Arm, Key, LcmUrl, Seconds, Seed, app, one_of, whole_number
from dvrk_drake.cli.lcm import ControlledArm, ready_controller
from dvrk_drake.cli.support import check_output, interrupt_ends_process, load_key, print_notes, print_written
from dvrk_drake.errors import CollectionError, RecordingError

if TYPE_CHECKING:
    from dvrk_drake.processes.live_status import LiveLine

_TASK = one_of("Task (one is required)")


@app.command(group=HARDWARE)
def record(
    file: Annotated[str, Parameter(metavar="FILE")],
    /,
    *,
    arm: Arm,
    duration: Annotated[Seconds | None, Parameter(metavar="S")] = None,
    lcm_url: LcmUrl = "",
    key: Key = None,
    ros: Annotated[bool, Parameter(show_default=False)] = False,
    topic: Annotated[str | None, Parameter(metavar="TOPIC")] = None,
    domain: Annotated[int | None, Parameter(metavar="N", converter=whole_number)] = None,
) -> None:
    """Record the measurements of an arm over LCM or ROS 2.

    The file contains only complete rows, even after Ctrl-C or an error.

    Args:
        file: New file: .mcap for a bag for ROS 2 tools and Foxglove, .csv for a CSV, .log for an LCM log.
        duration: Duration [s], counted from the first message. Default: until Ctrl-C.
        ros: Record the JointState messages of a dVRK over ROS 2 instead of LCM, to an .mcap bag.
        topic: With --ros: JointState topic or its namespace. Default: measured_js of the arm.
        domain: With --ros: ROS domain. Default: $ROS_DOMAIN_ID, or else 0.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.lcm_network import open_lcm
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.recorder import Recorder
    from dvrk_drake.processes.ros_recorder import RosRecorder
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.recording_stream import check_stream_output

    if ros and (lcm_url or key):
        raise RecordingError("--lcm-url and --key cannot be used with --ros")
    if not ros and (topic is not None or domain is not None):
        raise RecordingError("--topic and --domain require --ros")
    recorded = load_arm(arm)
    recorder: Recorder | RosRecorder
    if ros:
        recorder = RosRecorder(recorded, file, topic, domain)
    else:
        check_stream_output(file)
        recorder = Recorder(recorded, file, open_lcm(lcm_url).get_lcm_url(), load_key(key))
    line = LiveLine(sys.stderr)
    stopped = stop_on_signals()
    print(f"recording {recorded.name} on {recorder.source}; Ctrl-C ends the recording", flush=True)
    try:
        recorder.run(float("inf") if duration is None else duration, stopped, line.show)
    finally:
        line.clear()
    print_written(file, f"{recorder.num_rows} rows")
    print_notes(file, recorder.notes())


@app.command(group=HARDWARE)
def collect(
    *,
    controlled: ControlledArm,
    poses: Annotated[str, Parameter(metavar="POSES.yaml")],
    output: Annotated[str | None, Parameter(metavar="POSES.csv", group=_TASK)] = None,
    teach: Annotated[bool, Parameter(show_default=False, group=_TASK)] = False,
    random: Annotated[int | None, Parameter(metavar="N", group=_TASK, converter=whole_number)] = None,
    at_rest: Annotated[bool, Parameter(show_default=False)] = False,
    seed: Seed = 0,
    both_sides: Annotated[bool, Parameter(negative="--no-both-sides")] = True,
    traverse_time: Seconds = 5.0,
) -> None:
    """Collect static poses and their holding torques over LCM.

    After an interruption, run the same command again to continue.

    Args:
        poses: Pose file. With --output, the arm moves to the poses in this file. --teach and --random add poses to it.
        output: Move the arm to each pose of the pose file, and append one row per pose to this CSV file.
        teach: Compensate gravity so that you can move the arm by hand. The Enter key adds the current pose to the file.
        random: Add N random poses to the pose file.
        at_rest: With --teach: also add each pose at which the arm is at rest for one second.
        both_sides: Approach each pose from below and from above, and average the torques to cancel dry friction.
        traverse_time: Time to move a joint over its full range, 1 to 60 s. This time defines the speed between poses.
    """
    check_output(poses, overwrite=True)
    if random is not None:
        _add_random_poses(controlled.arm, poses, random, seed)
    elif teach:
        _teach(controlled, poses, at_rest)
    else:
        assert output is not None
        _visit(controlled, poses, output, both_sides, traverse_time)


def _add_random_poses(name: str, path: str, count: int, seed: int) -> None:
    import numpy as np

    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.recordings.pose_file import load_poses_if_any, save_poses

    if count < 1:
        raise CollectionError(f"--random must be 1 or larger; got {count}")
    arm = load_arm(name)
    poses = load_poses_if_any(path, arm)
    # Near a joint limit the guard adds a restoring effort, and there is no room to approach a pose from both sides.
    added = arm.sample_poses(count, np.random.default_rng([seed, len(poses)]), margin=0.1)
    poses = np.vstack([poses, added])
    save_poses(poses, arm, path)
    print_written(path, f"{len(poses)} poses of {arm.name}")


def _teach(controlled: ControlledArm, poses: str, at_rest: bool) -> None:
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey, Teacher
    from dvrk_drake.recordings.pose_file import load_poses_if_any

    load_poses_if_any(poses, load_arm(controlled.arm))  # rejects an invalid file before the arm is connected
    with interrupt_ends_process():
        controller, link, _ = ready_controller(controlled, "gravity")
        stopped = stop_on_signals()
    line = LiveLine(sys.stderr)
    teacher = Teacher(controller, poses, at_rest=at_rest, requested=EnterKey(sys.stdin), report=_reporter(line))
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


def _visit(
    controlled: ControlledArm, poses_file: str, output_file: str, both_sides: bool, traverse_time: float
) -> None:
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.collector import CollectionSettings, Collector
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.pose_file import CollectionFile, load_poses

    settings = CollectionSettings(traverse_time, both_sides)
    arm = load_arm(controlled.arm)
    poses = load_poses(poses_file, arm)
    check_output(output_file, poses_file, controlled.model or "", overwrite=True)
    output = CollectionFile(output_file, arm, both_sides)
    num_done = output.finished(poses).sum()
    if num_done == len(poses):
        print(f"{output_file}: contains all {len(poses)} poses already")
        return
    with interrupt_ends_process():
        controller, link, _ = ready_controller(controlled, "hold")
        stopped = stop_on_signals()
    line = LiveLine(sys.stderr)
    collector = Collector(poses, controller, output, settings, stopped=stopped, report=_reporter(line))
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
    if collector.problem is not None:
        raise collector.problem
    if stopped():
        raise KeyboardInterrupt
    if collector.unsettled:
        numbers = ", ".join(map(str, collector.unsettled))
        raise CollectionError(
            f"the arm did not come to rest at poses {numbers}. Run the command again to repeat these poses"
        )


def _reporter(line: LiveLine) -> Callable[[str], None]:
    """Returns a function that prints lines above the live line."""

    def report(text: str) -> None:
        line.clear()
        print(text, flush=True)

    return report
