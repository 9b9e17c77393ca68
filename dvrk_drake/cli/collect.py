"""The commands that record an arm over LCM: record, collect."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from dvrk_drake.cli.lcm import add_control, ready_controller
from dvrk_drake.cli.support import add_key, check_output, interrupt_ends_process, load_key, print_notes, seconds, seed
from dvrk_drake.errors import CollectionError

if TYPE_CHECKING:
    from dvrk_drake.processes.live_status import LiveLine


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the commands and their options."""
    _add_record(verbs)
    _add_collect(verbs)


def _add_record(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser(
        "record", help="record an arm over LCM; whatever ends it, the file is whole up to its last row"
    )
    verb.add_argument("output", metavar="OUTPUT", help="a new file: .csv, or .log for an LCM log")
    verb.add_argument("--arm", required=True, help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument(
        "--duration", type=seconds, default=float("inf"), metavar="S", help="from the first status; default: to Ctrl-C"
    )
    verb.add_argument("--lcm-url", default="", metavar="URL", help="default: LCM_DEFAULT_URL, or LCM's own")
    add_key(verb)
    verb.set_defaults(run=_record)


def _record(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.processes.lcm_network import open_lcm
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.recorder import Recorder
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.recording_stream import check_stream_output

    arm = load_arm(options.arm)
    check_stream_output(options.output)
    url = open_lcm(options.lcm_url).get_lcm_url()
    recorder = Recorder(arm, options.output, url, load_key(options.key))
    line = LiveLine(sys.stderr)
    stopped = stop_on_signals()
    print(f"recording {arm.name} on LCM {url}; end with Ctrl-C", flush=True)
    try:
        recorder.run(options.duration, stopped, line.show)
    finally:
        line.clear()
    print(f"{options.output}: {recorder.stream.num_taken} rows", flush=True)
    print_notes(options.output, recorder.notes())


def _add_collect(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser(
        "collect", help="collect poses and holding torques of an arm over LCM; the same command again goes on"
    )
    add_control(verb)
    verb.add_argument("--poses", required=True, metavar="POSES.yaml", help="file of the poses")
    task = verb.add_mutually_exclusive_group(required=True)
    task.add_argument("--output", metavar="POSES.csv", help="visit the poses, and add a row for each to this file")
    task.add_argument("--teach", action="store_true", help="add poses to the file that you show by hand, with Enter")
    task.add_argument("--random", type=int, metavar="N", help="add N random poses to the file")
    verb.add_argument("--at-rest", action="store_true", help="with --teach: also take where the arm rests for a second")
    verb.add_argument("--seed", type=seed, default=0, help="of --random; default: 0")
    verb.add_argument(
        "--both-sides",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="measure each pose approached from below and from above, and average: cancels dry friction; the default",
    )
    verb.add_argument(
        "--traverse-time", type=seconds, default=5.0, metavar="S", help="to cross a joint's range; default: 5"
    )
    verb.set_defaults(run=_collect)


def _collect(options: argparse.Namespace) -> None:
    check_output(options.poses, overwrite=True)
    if options.random is not None:
        _add_random_poses(options)
    elif options.teach:
        _teach(options)
    else:
        _visit(options)


def _add_random_poses(options: argparse.Namespace) -> None:
    import numpy as np

    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.recordings.pose_file import load_poses_if_any, save_poses

    if options.random < 1:
        raise CollectionError(f"--random must be 1 pose or more; got {options.random}")
    arm = load_arm(options.arm)
    poses = load_poses_if_any(options.poses, arm)
    # Near its limits an arm's guard pushes back, and there is no room to come from both sides.
    added = arm.sample_poses(options.random, np.random.default_rng(options.seed), margin=0.1)
    poses = np.vstack([poses, added])
    save_poses(poses, arm, options.poses)
    print(f"{options.poses}: {len(poses)} poses of {arm.name}")


def _teach(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey, Teacher
    from dvrk_drake.recordings.pose_file import load_poses_if_any

    load_poses_if_any(options.poses, load_arm(options.arm))  # refused before the arm is asked
    with interrupt_ends_process():
        controller, link, _ = ready_controller(options, "gravity")
        stopped = stop_on_signals()
    line = LiveLine(sys.stderr)
    teacher = Teacher(
        controller, options.poses, at_rest=options.at_rest, told=EnterKey(sys.stdin), report=_reporter(line)
    )
    when = "Enter, or a second's rest, takes" if options.at_rest else "Enter takes"
    print(f"the weight of {controller.arm.name} is carried: move it by hand; {when} a pose, Ctrl-C ends", flush=True)
    try:
        control(
            link(),
            controller,
            stopped,
            lambda text: line.show(lambda: f"{len(teacher.poses)} poses; {text}"),
            teacher.lead,
        )
    finally:
        teacher.close()
        line.clear()
    print(f"{options.poses}: {len(teacher.poses)} poses; {controller.arm.name} holds by itself", flush=True)


def _visit(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.processes.collector import CollectionSettings, Collector
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.recordings.pose_file import CollectionFile, load_poses

    settings = CollectionSettings(options.traverse_time, options.both_sides)
    arm = load_arm(options.arm)
    poses = load_poses(options.poses, arm)
    check_output(options.output, options.poses, options.model or "", overwrite=True)
    output = CollectionFile(options.output, arm, options.both_sides)
    num_done = output.finished(poses).sum()
    if num_done == len(poses):
        print(f"{options.output}: has all {len(poses)} poses already")
        return
    with interrupt_ends_process():
        controller, link, _ = ready_controller(options, "hold")
        stopped = stop_on_signals()
    line = LiveLine(sys.stderr)
    collector = Collector(poses, controller, output, settings, stopped=stopped, report=_reporter(line))
    print(f"{len(poses) - num_done} poses of {arm.name} to visit; Ctrl-C stops, the same command goes on", flush=True)
    try:
        control(
            link(),
            controller,
            lambda: collector.finished,
            lambda text: line.show(lambda: f"{collector.describe()}; {text}"),
            collector.lead,
        )
    finally:
        collector.close()
        line.clear()
        print(f"{options.output}: {collector.done.sum()} of {len(poses)} poses", flush=True)
    if collector.problem is not None:
        raise collector.problem
    if stopped():
        raise KeyboardInterrupt
    if collector.unsettled:
        numbers = ", ".join(map(str, collector.unsettled))
        raise CollectionError(f"poses left out: {numbers}; the arm did not come to rest there. Run again to try again")


def _reporter(line: LiveLine) -> Callable[[str], None]:
    """Prints lines of which the live one is no part."""

    def report(text: str) -> None:
        line.clear()
        print(text, flush=True)

    return report
