"""Command that designs a motion or static poses for the identification of an arm."""

from __future__ import annotations

import os
import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.cli.support import Results
from dvrk_drake.errors import ExcitationError
from dvrk_drake.workers import local_executor

#: Default rate of the rows of --csv [Hz].
DEFAULT_RATE = 200.0
_RESULTS = Results()


@options.app.command(group=options.IDENTIFY)
def excite(
    *,
    arm: options.Arm,
    output: Annotated[str, Parameter(metavar="FILE.yaml")],
    instrument: options.Instrument = "",
    static: Annotated[int | None, Parameter(metavar="N", converter=options.whole_number)] = None,
    model: Annotated[str | None, Parameter(metavar="MODEL.yaml")] = None,
    csv: Annotated[str | None, Parameter(metavar="FILE.csv")] = None,
    rate: Annotated[float | None, Parameter(metavar="HZ")] = None,
    duration: options.Seconds | None = None,
    period: options.Seconds | None = None,
    harmonics: Annotated[int | None, Parameter(metavar="N", converter=options.whole_number)] = None,
    starts: Annotated[int | None, Parameter(metavar="N", converter=options.whole_number)] = None,
    seed: options.Seed = 0,
    margin: Annotated[float | None, Parameter(metavar="SHARE")] = None,
    traverse_time: options.Seconds | None = None,
    effort: Annotated[float, Parameter(metavar="SHARE")] = 0.8,
    position: Annotated[list[str] | None, Parameter(metavar="JOINT=LOWER:UPPER ..", consume_multiple=True)] = None,
    table: options.Table = None,
    environment: options.EnvironmentFile = None,
    gravity: options.Gravity = None,
    results: Results = _RESULTS,
) -> None:
    """Design a motion or static poses for the identification of an arm.

    The motion is periodic, at rest at both ends, and within all limits. It minimises the expected error of the efforts
    that an identified model predicts for random motions within the limits. With --static, the command selects poses for
    collect instead of a motion. The poses minimise the expected error of predicted holding efforts.

    Args:
        output: Motion file or pose file to write.
        static: Select N static poses, 8 to 300.
        model: Earlier model of the arm, written by identify. It replaces the parameters and the gravity vector of the
            arm, and the motion gives the most additional information. Default: no earlier model.
        csv: File for the positions and velocities over time, for other programs.
        rate: Rate of the rows of --csv, 1 to 10000. Default: 200.
        duration: Duration of the motion, rounded up to whole periods. Default: 30.
        period: Period of the motion. Default: the duration, at most 30 s.
        harmonics: Number of harmonics, 2 to 20. Default: 16.
        starts: Number of random motions from which the optimisation starts. Default: 2.
        margin: Share of each position range that is not used, at each end, 0 to 0.4. Default: 0.05, with --static 0.1.
        traverse_time: Shortest time in which a joint may cross its position range. It determines the speed limits.
            Default: 1.
        effort: Largest predicted effort, as a share of the effort limits, 0.05 to 1.
        position: Additional position limits [rad, m], e.g. insertion=0.05:0.2.
    """
    import numpy as np

    from dvrk_drake.analysis.excitation.static_poses import MARGIN
    from dvrk_drake.recordings.csv_files import write_csv
    from dvrk_drake.reports.excitation import motion_page, poses_page

    design_options = {"duration": duration, "period": period, "harmonics": harmonics, "starts": starts}
    motion_options = {"model": model, "csv": csv, "rate": rate, "traverse-time": traverse_time, **design_options}
    if static is not None and (words := [f"--{name}" for name in options.given(motion_options)]):
        raise ExcitationError(f"{' and '.join(words)} cannot be used with --static")
    if csv is None and rate is not None:
        raise ExcitationError("--rate requires --csv")
    if model is not None and gravity is not None:
        raise ExcitationError("--gravity cannot be used with --model, because the model contains the gravity vector")
    results.check(model, output=output)
    if csv is not None:
        support.check_output(csv, output, overwrite=results.overwrite)
    rate = DEFAULT_RATE if rate is None else rate
    if not 1.0 <= rate <= 10_000.0:
        raise ExcitationError(f"--rate is {rate:g}; allowed: 1 to 10000")
    if static is not None and margin is None:
        margin = MARGIN
    limits = dvrk.MotionLimits(
        effort=effort,
        positions=options.named("position", position or [], "JOINT=LOWER:UPPER, e.g. insertion=0.05:0.2", _limits),
        environment=support.load_environment(table, environment),
        **options.given({"margin": margin, "traverse_time": traverse_time}),
    )
    arm = options.with_instrument(arm, instrument)
    moved = support.mounted(dvrk.load_arm(arm), gravity)
    if static is not None:
        with support.Steps("selecting poses") as steps:
            poses = dvrk.design_poses(moved, static, limits=limits, seed=seed, progress=steps)
        poses.save(output, overwrite=True)
        recording = str(Path(output).with_suffix(".csv"))
        collect = "dvrk-drake collect poses " + shlex.join([output, "--arm", arm, "--output", recording])
        results.show(poses_page(poses, next_step=collect), saved=output)
        return
    earlier = None if model is None else dvrk.IdentifiedModel.load(model, moved)
    num_workers = min(2 if starts is None else starts, os.cpu_count() or 1)
    pool = local_executor(num_workers) if num_workers > 1 else nullcontext()
    with support.Steps("optimising") as steps, pool as executor:
        design = dvrk.design_excitation(
            moved,
            limits=limits,
            model=earlier,
            seed=seed,
            executor=executor,
            progress=steps,
            **options.given(design_options),
        )
    motion = design.motion
    motion.save(output, overwrite=True)
    if csv is not None:
        t = np.arange(round(motion.duration * rate) + 1) / rate
        q, v = motion.evaluate(t)[:2]
        write_csv(csv, {"t": t, "q": q, "qd": v}, moved, {"coordinates": "joint", "arm": moved.name})
    with_model = "" if model is None else f" --model {shlex.quote(model)}"
    collect = "dvrk-drake collect motion " + shlex.join([output, "--arm", arm]) + f"{with_model} --rehearse"
    results.show(motion_page(design, next_step=collect), model, saved=output)
    if csv is not None:
        support.print_written(csv)


def _limits(text: str) -> tuple[float, float]:
    lower, _, upper = text.partition(":")
    return float(lower), float(upper)
