"""Command that designs a motion or static poses for the identification of an arm."""

from __future__ import annotations

import os
import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli.app import (
    IDENTIFY,
    Arm,
    EnvironmentFile,
    Gravity,
    Instrument,
    Seconds,
    Seed,
    Table,
    app,
    whole_number,
    with_instrument,
)
from dvrk_drake.cli.report import Results
from dvrk_drake.cli.support import Steps, check_output, load_environment, mounted, print_written
from dvrk_drake.errors import ExcitationError
from dvrk_drake.workers import local_executor

if TYPE_CHECKING:
    from dvrk_drake.models.environment import Environment

#: Default rate of the rows of --csv [Hz].
DEFAULT_RATE = 200.0
_RESULTS = Results()


@app.command(group=IDENTIFY)
def excite(
    *,
    arm: Arm,
    output: Annotated[str, Parameter(metavar="FILE.yaml")],
    instrument: Instrument = "",
    static: Annotated[int | None, Parameter(metavar="N", converter=whole_number)] = None,
    model: Annotated[str | None, Parameter(metavar="MODEL.yaml")] = None,
    csv: Annotated[str | None, Parameter(metavar="FILE.csv")] = None,
    rate: Annotated[float | None, Parameter(metavar="HZ")] = None,
    duration: Seconds | None = None,
    period: Seconds | None = None,
    harmonics: Annotated[int | None, Parameter(metavar="N", converter=whole_number)] = None,
    starts: Annotated[int | None, Parameter(metavar="N", converter=whole_number)] = None,
    seed: Seed = 0,
    margin: Annotated[float | None, Parameter(metavar="SHARE")] = None,
    traverse_time: Seconds | None = None,
    effort: Annotated[float, Parameter(metavar="SHARE")] = 0.8,
    position: Annotated[list[str] | None, Parameter(metavar="JOINT=LOWER:UPPER ..", consume_multiple=True)] = None,
    table: Table = None,
    environment: EnvironmentFile = None,
    gravity: Gravity = None,
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

    from dvrk_drake.recordings.writer_csv import write_csv
    from dvrk_drake.reports.excitation import motion_page

    of_motion = {
        "model": model,
        "csv": csv,
        "rate": rate,
        "duration": duration,
        "period": period,
        "harmonics": harmonics,
        "starts": starts,
        "traverse-time": traverse_time,
    }
    arm = with_instrument(arm, instrument)
    if static is not None:
        if given := [f"--{name}" for name, value in of_motion.items() if value is not None]:
            raise ExcitationError(f"{' and '.join(given)} cannot be used with --static")
        results.check(output=output)
        around = load_environment(table, environment)
        _select_poses(arm, output, static, seed, margin, effort, _positions(position or []), around, gravity, results)
        return
    if csv is None and rate is not None:
        raise ExcitationError("--rate requires --csv")
    results.check(model, output=output)
    if csv is not None:
        check_output(csv, output, overwrite=results.overwrite)
    rate = DEFAULT_RATE if rate is None else rate
    if not 1.0 <= rate <= 10_000.0:
        raise ExcitationError(f"--rate is {rate:g}; allowed: 1 to 10000")
    limits = dvrk.MotionLimits(
        margin=0.05 if margin is None else margin,
        traverse_time=1.0 if traverse_time is None else traverse_time,
        effort=effort,
        positions=_positions(position or []),
        environment=load_environment(table, environment),
    )
    if model is not None and gravity is not None:
        raise ExcitationError("--gravity cannot be used with --model, because the model contains the gravity vector")
    moved = mounted(dvrk.load_arm(arm), gravity, None)
    earlier = None if model is None else dvrk.IdentifiedModel.load(model, moved)
    starts = 2 if starts is None else starts
    pool = local_executor(min(starts, os.cpu_count() or 1)) if starts > 1 else nullcontext()
    with Steps("optimising") as steps, pool as executor:
        design = dvrk.design_excitation(
            moved,
            duration=30.0 if duration is None else duration,
            period=period,
            harmonics=16 if harmonics is None else harmonics,
            limits=limits,
            model=earlier,
            starts=starts,
            seed=seed,
            executor=executor,
            progress=steps,
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
        print_written(csv)


def _select_poses(
    name: str,
    output: str,
    count: int,
    seed: int,
    margin: float | None,
    effort: float,
    positions: dict[str, tuple[float, float]],
    environment: Environment,
    gravity: tuple[float, float, float] | None,
    results: Results,
) -> None:
    """Selects static poses, writes the pose file and prints the expected errors."""
    from dvrk_drake.analysis.excitation.static_poses import MARGIN
    from dvrk_drake.reports.excitation import poses_page

    limits = dvrk.MotionLimits(
        margin=MARGIN if margin is None else margin, effort=effort, positions=positions, environment=environment
    )
    arm = mounted(dvrk.load_arm(name), gravity, None)
    with Steps("selecting poses") as steps:
        design = dvrk.design_poses(arm, count, limits=limits, seed=seed, progress=steps)
    design.save(output, overwrite=True)
    recording = str(Path(output).with_suffix(".csv"))
    collect = "dvrk-drake collect poses " + shlex.join([output, "--arm", name, "--output", recording])
    results.show(poses_page(design, next_step=collect), saved=output)


def _positions(texts: list[str]) -> dict[str, tuple[float, float]]:
    positions: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, _, limits = text.partition("=")
        if name in positions:
            raise ExcitationError(f"--position: {name} was given twice; give each joint once")
        lower, _, upper = limits.partition(":")
        try:
            positions[name] = float(lower), float(upper)
        except ValueError:
            raise ExcitationError(
                f'--position: "{text}" is not of the form JOINT=LOWER:UPPER, e.g. insertion=0.05:0.2'
            ) from None
    return positions
