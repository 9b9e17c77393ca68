"""Command collect motion: moves an arm along a designed motion and records it."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from dvrk_drake.cli.app import ControlledArm
from dvrk_drake.cli.lcm import checked_start, ready_controller
from dvrk_drake.cli.support import check_output, interrupt_ends_process, print_written, quiet_drake
from dvrk_drake.errors import CollectionError

if TYPE_CHECKING:
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.recordings.motion_parts import MotionPartFile
    from dvrk_drake.recordings.periodic_motion import PeriodicMotion


def follow_motion(controlled: ControlledArm, path: str, output: str | None) -> None:
    """Moves the arm along the motion in a file, and records it, or rehearses it.

    Args:
        controlled: Options of the command.
        path: Motion file.
        output: CSV file for the measurements. If it contains a part of the motion, the missing part is written to a new
            file beside it. None: rehearsal, which is not recorded.

    Raises:
        DvrkDrakeError: A file is not valid, the motion exceeds a limit of the arm or was not rehearsed, or the arm
            cannot be controlled or does not follow.
        KeyboardInterrupt: A signal ended the motion. The arm holds its pose.
    """
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm_files import load_arm
    from dvrk_drake.processes.control import control
    from dvrk_drake.processes.live_status import LiveLine
    from dvrk_drake.processes.motion_player import REHEARSAL_SPEED, MotionPlayer
    from dvrk_drake.processes.simulated_arm import stop_on_signals
    from dvrk_drake.processes.teacher import EnterKey
    from dvrk_drake.recordings import motion_parts
    from dvrk_drake.recordings.periodic_motion import PeriodicMotion

    arm = load_arm(controlled.arm)
    motion = PeriodicMotion.load(path, arm)
    begin, end, create = 0.0, motion.period, None
    quiet_drake()
    if output is None:
        check_output(str(motion_parts.rehearsal_path(path)), overwrite=True)
    else:
        check_output(output, path, controlled.model or "", overwrite=True)
        parts = motion_parts.recorded_parts(output, arm, motion)
        rest = motion_parts.begin_of_rest(parts, motion.duration)
        if rest is None:
            print(f"{output}: contains the whole motion already")
            _print_next(output, controlled.arm, arm, motion)
            return
        if not motion_parts.is_rehearsed(path, arm, motion):
            raise CollectionError(
                f"{path}: the motion was not rehearsed on {arm.name}. First run: dvrk-drake collect motion {path} "
                f"--arm {controlled.arm} --rehearse"
            )
        begin, end = rest, motion.duration
        part_path = motion_parts.next_part(output, parts)

        def create() -> MotionPartFile:
            return motion_parts.MotionPartFile(part_path, arm, motion)

    model = IdentifiedModel.from_arm(arm) if controlled.model is None else IdentifiedModel.load(controlled.model, arm)
    _check_motion(path, motion, arm, model)
    with interrupt_ends_process():
        controller, link, _period = ready_controller(controlled, "hold")
        q = checked_start(model, link, motion.evaluate([begin]).q[0], motion.environment)
        stopped = stop_on_signals()
    line, speed = LiveLine(sys.stderr), REHEARSAL_SPEED if create is None else 1.0
    has_keys = sys.stdin is not None and sys.stdin.isatty()
    player = MotionPlayer(
        motion,
        controller,
        q,
        output=create,
        begin=begin,
        end=end,
        speed=speed,
        stopped=stopped,
        enter=EnterKey(sys.stdin) if has_keys else lambda: False,
        report=line.report,
    )
    what = f"rehearsal of {path} at {100 * speed:.0f} % speed" if create is None else path
    print(
        f"{arm.name} moves to the start and then for {(end - begin) / speed:.0f} s: {what}. "
        + ("Enter pauses, " if has_keys else "")
        + "Ctrl-C ends the motion",
        flush=True,
    )
    try:
        control(
            link(),
            controller,
            lambda: player.finished,
            lambda text: line.show(lambda: f"{player.describe()}; {text}"),
            player.update,
        )
    finally:
        player.close()
        line.clear()
        if create is not None and player.motion_time > begin:
            print_written(part_path, f"{begin:.1f} to {player.motion_time:.1f} s of {motion.duration:g} s")
    if player.problem is not None:
        raise player.problem
    if stopped():
        raise KeyboardInterrupt
    if player.motion_time < end:
        raise CollectionError(f"{path}: the motion ended early, at {player.motion_time:.1f} s; run the command again")
    if output is not None:
        _print_next(output, controlled.arm, arm, motion)
        return
    rehearsal = motion_parts.Rehearsal(
        arm=arm.name, motion=motion.digest(), speed=speed, tracking_error=player.largest_error.tolist()
    )
    share = 100 * float((player.largest_error / (arm.position_upper - arm.position_lower)).max())
    print_written(rehearsal.save(path), f"largest tracking error {share:.1f} % of the range of a joint")


def _print_next(output: str, name: str, arm: Arm, motion: PeriodicMotion) -> None:
    from dvrk_drake.recordings.motion_parts import recorded_parts, useful

    files = " ".join(str(part.path) for part in useful(recorded_parts(output, arm, motion), motion.duration))
    print(f"Next: dvrk-drake identify {files} --arm {name} --output model.yaml", flush=True)


def _check_motion(path: str, motion: PeriodicMotion, arm: Arm, model: IdentifiedModel) -> None:
    """Checks the motion with the limits of the arm and of its guard, independently of the limits of its design."""
    from dvrk_drake.analysis.excitation.motion_limits import execution_limits, motion_violations

    if violations := motion_violations(motion, model.arm, execution_limits(motion.environment), model):
        raise CollectionError(f"{path}: {violations[0]}; design a motion within the limits of {arm.name}")
