"""Commands that record an arm: record and collect."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dvrk_drake.cli.app import HARDWARE, Arm, Key, LcmUrl, Seconds, Seed, app, one_of, whole_number
from dvrk_drake.cli.collect_motion import collect_motion
from dvrk_drake.cli.lcm import ControlledArm, checked_start, ready_controller
from dvrk_drake.cli.support import (
    check_output,
    check_ros_options,
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

_SOURCE = one_of("Poses or a motion (one is required)")
_TASK = one_of("Task (one is required)")
#: Default time to move a joint over its full range [s].
_TRAVERSE_TIME = 5.0


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RosCollection:
    """Options of `collect` for a dVRK arm on ROS 2."""

    ros: Annotated[
        bool,
        Parameter(
            show_default=False,
            help="Use ROS 2 instead of LCM. The dVRK moves the arm (move_jp); needs --output.",
        ),
    ] = False
    topic: Annotated[
        str | None,
        Parameter(metavar="TOPIC", help="With --ros: topic measured_js of the arm, or its namespace. Default: /<ARM>."),
    ] = None
    domain: Annotated[
        int | None,
        Parameter(
            metavar="N", converter=whole_number, help="With --ros: ROS domain. Default: $ROS_DOMAIN_ID, or else 0."
        ),
    ] = None
    max_effort: Annotated[
        float | None,
        Parameter(
            metavar="SHARE",
            help="With --ros: stop if an effort differs from the gravity effort of the model by this share of its "
            "limit, 0.05 to 2. Default: 0.6.",
        ),
    ] = None
    yes: Annotated[
        bool, Parameter(show_default=False, help="With --ros: move the arm without a question on the terminal.")
    ] = False


_ROS = RosCollection()


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
        file: New file: .mcap for a bag for ROS 2 tools, Foxglove and Rerun, .csv for a CSV, .log for an LCM log.
        duration: Duration [s], counted from the first message. Default: until Ctrl-C.
        ros: Record the JointState messages of a dVRK over ROS 2 instead of LCM, to an .mcap bag.
        topic: With --ros: JointState topic or its namespace. Default: measured_js of the arm.
        domain: With --ros: ROS domain. Default: $ROS_DOMAIN_ID, or else 0.
    """
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.recorder import Recorder
    from dvrk_drake.processes.ros_recorder import RosRecorder
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.writer_stream import check_stream_output
    from dvrk_drake.systems.lcm.lcm_network import open_lcm

    check_ros_options(ros, {"topic": topic, "domain": domain}, {"lcm_url": lcm_url, "key": key})
    recorded, line = load_arm(arm), LiveLine(sys.stderr)
    recorder: Recorder | RosRecorder
    if ros:
        recorder = RosRecorder(recorded, file, topic, domain, line.report)
    else:
        check_stream_output(file)
        recorder = Recorder(recorded, file, open_lcm(lcm_url).get_lcm_url(), load_key(key))
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
    poses: Annotated[str | None, Parameter(metavar="POSES.yaml", group=_SOURCE)] = None,
    motion: Annotated[str | None, Parameter(metavar="MOTION.yaml", group=_SOURCE)] = None,
    output: Annotated[str | None, Parameter(metavar="FILE.csv", group=_TASK)] = None,
    teach: Annotated[bool, Parameter(show_default=False, group=_TASK)] = False,
    random: Annotated[int | None, Parameter(metavar="N", group=_TASK, converter=whole_number)] = None,
    rehearse: Annotated[bool, Parameter(show_default=False, group=_TASK)] = False,
    at_rest: Annotated[bool, Parameter(show_default=False)] = False,
    seed: Seed = 0,
    both_sides: Annotated[bool, Parameter(negative="--no-both-sides")] = True,
    traverse_time: Seconds = _TRAVERSE_TIME,
    ros: RosCollection = _ROS,
) -> None:
    """Record static poses or a motion of an arm, with the efforts. A motion requires LCM.

    After an interruption, run the same command again to continue. Enter pauses a motion, or a collection with --ros.
    Ctrl-C ends the command. In all cases, the arm holds its pose. With --ros, the messages of each run are also written
    to a new bag beside the CSV: POSES_1.mcap, POSES_2.mcap, ...

    Args:
        poses: Pose file. With --output, the arm moves to the poses in this file. --teach and --random add poses to it.
        motion: Motion file written by dvrk-drake excite. The arm follows this motion.
        output: Move the arm, and write one row per pose, or the measurements during the motion, to this CSV file.
        teach: Compensate gravity so that you can move the arm by hand. The Enter key adds the current pose to the file.
        random: Add N random poses to the pose file.
        rehearse: Follow one period of the motion at a fifth of its speed. Required once before the first recording.
        at_rest: With --teach: also add each pose at which the arm is at rest for one second.
        both_sides: Approach each pose from below and from above, and average the torques to cancel dry friction.
        traverse_time: Time to move a joint over its full range, 1 to 60 s. This time defines the speed between poses.
    """
    lcm_only = {name: getattr(controlled, name) for name in ("lcm_url", "key", "realtime", "reset")}
    check_ros_options(ros.ros, vars(ros) | {"ros": None}, lcm_only | {"motion": motion})
    if motion is not None:
        given = {
            "--teach": teach,
            "--random": random is not None,
            "--at-rest": at_rest,
            "--no-both-sides": not both_sides,
            "--traverse-time": traverse_time != _TRAVERSE_TIME,
        }
        if wrong := [name for name, is_given in given.items() if is_given]:
            raise CollectionError(f"{', '.join(wrong)} cannot be used with --motion, only with --poses")
        collect_motion(controlled, motion, None if rehearse else output)
        return
    assert poses is not None
    if rehearse:
        raise CollectionError("--rehearse requires --motion, but --poses was given")
    if ros.ros and output is None:
        raise CollectionError(
            "--ros requires --output; --random needs no arm, and --teach needs LCM (dvrk-drake bridge)"
        )
    check_output(poses, overwrite=True)
    if random is not None:
        _add_random_poses(controlled.arm, poses, random, seed)
    elif teach:
        _teach(controlled, poses, at_rest)
    else:
        assert output is not None
        visit = _visit_over_ros if ros.ros else _visit
        visit(controlled, poses, output, both_sides, traverse_time, ros)


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
    save_poses(np.vstack([poses, added]), arm, path)
    if len(poses):
        print(f"added {count} poses; {path} has {len(poses) + count} poses of {arm.name}", flush=True)
    else:
        print_written(path, f"{count} poses of {arm.name}")


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


def _visit(
    controlled: ControlledArm,
    poses_file: str,
    output_file: str,
    both_sides: bool,
    traverse_time: float,
    _: RosCollection,
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
    controlled: ControlledArm,
    poses_file: str,
    output_file: str,
    both_sides: bool,
    traverse_time: float,
    options: RosCollection,
) -> None:
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.processes.crtk_collection import Dialog, bag_path, run_crtk_collection
    from dvrk_drake.processes.crtk_collector import CrtkCollectionSettings
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.systems.ros.open_domain import domain_number

    quiet_drake()
    domain_number(options.domain)  # rejects an invalid number before any other step
    settings = CrtkCollectionSettings(traverse_time, both_sides)
    if options.max_effort is not None:
        settings = CrtkCollectionSettings(traverse_time, both_sides, options.max_effort)
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
        if has_keys and not options.yes:
            print("Clear the workspace of the arm. Enter starts the motion, Ctrl-C ends the command.", flush=True)
            while not stopped() and not enter():
                time.sleep(0.02)

    print(f"{remaining} poses of {arm.name} remain; after Ctrl-C, the same command continues", flush=True)
    dialog = Dialog(stopped, confirm, enter, line.report, line.show)
    collector = None
    try:
        collector = run_crtk_collection(
            arm, poses, output, bag, settings, dialog, model=model, topic=options.topic, domain=options.domain
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
