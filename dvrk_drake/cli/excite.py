"""Command that designs a motion for the identification of an arm."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli.app import IDENTIFY, Arm, Gravity, Overwrite, Seconds, Seed, app, whole_number
from dvrk_drake.cli.support import Steps, check_output, mounted, print_written, quiet_drake
from dvrk_drake.errors import ExcitationError

#: Default rate of the rows of --csv [Hz].
DEFAULT_RATE = 200.0


@app.command(group=IDENTIFY)
def excite(
    *,
    arm: Arm,
    output: Annotated[str, Parameter(metavar="MOTION.yaml")],
    model: Annotated[str | None, Parameter(metavar="MODEL.yaml")] = None,
    csv: Annotated[str | None, Parameter(metavar="FILE.csv")] = None,
    rate: Annotated[float, Parameter(metavar="HZ")] = DEFAULT_RATE,
    duration: Seconds = 30.0,
    period: Seconds | None = None,
    harmonics: Annotated[int, Parameter(metavar="N", converter=whole_number)] = 16,
    starts: Annotated[int, Parameter(metavar="N", converter=whole_number)] = 2,
    seed: Seed = 0,
    margin: Annotated[float, Parameter(metavar="SHARE")] = 0.05,
    traverse_time: Seconds = 1.0,
    effort: Annotated[float, Parameter(metavar="SHARE")] = 0.6,
    position: Annotated[list[str] | None, Parameter(metavar="JOINT=LOWER:UPPER ..", consume_multiple=True)] = None,
    table: Annotated[float | None, Parameter(metavar="Z")] = None,
    gravity: Gravity = None,
    overwrite: Overwrite = False,
) -> None:
    """Design a motion for the identification of an arm.

    The motion is periodic, at rest at both ends, and within all limits. It minimises the expected error of the efforts
    that an identified model predicts for random motions within the limits.

    Args:
        output: Motion file to write.
        model: Earlier model of the arm, written by identify. It replaces the parameters and the gravity vector of the
            arm, and the motion gives the most additional information. Default: no earlier model.
        csv: File for the positions and velocities over time, for other programs.
        rate: Rate of the rows of --csv, 1 to 10000.
        duration: Duration of the motion, rounded up to whole periods.
        period: Period of the motion. Default: the duration divided by the smallest number for which the period is at
            most 30 s.
        harmonics: Number of harmonics, 2 to 20.
        starts: Number of random motions from which the optimisation starts.
        margin: Share of each position range that is not used, at each end, 0 to 0.4.
        traverse_time: Shortest time in which a joint may cross its position range. It determines the speed limits.
        effort: Largest predicted effort, as a share of the effort limits, 0.05 to 1.
        position: Additional position limits [rad, m], e.g. insertion=0.05:0.2.
        table: Height of a table in the base frame [m].
    """
    import numpy as np

    from dvrk_drake.recordings.recording import write_csv
    from dvrk_drake.reports.terminal_tables import make_console, print_answer

    quiet_drake()
    if csv is None and rate != DEFAULT_RATE:
        raise ExcitationError("--rate requires --csv")
    check_output(output, overwrite=overwrite)
    if csv is not None:
        check_output(csv, output, overwrite=overwrite)
    if not 1.0 <= rate <= 10_000.0:
        raise ExcitationError(f"--rate is {rate:g}; allowed: 1 to 10000")
    limits = dvrk.MotionLimits(
        margin=margin, traverse_time=traverse_time, effort=effort, positions=_positions(position or []), table=table
    )
    if model is not None and gravity is not None:
        raise ExcitationError("--gravity cannot be used with --model, because the model contains the gravity vector")
    moved = mounted(dvrk.load_arm(arm), gravity, None)
    earlier = None if model is None else dvrk.IdentifiedModel.load(model, moved)
    with Steps("optimising") as steps:
        design = dvrk.design_excitation(
            moved,
            duration=duration,
            period=period,
            harmonics=harmonics,
            limits=limits,
            model=earlier,
            starts=starts,
            seed=seed,
            progress=steps,
        )
    motion = design.motion
    motion.save(output, overwrite=True)
    if csv is not None:
        t = np.arange(round(motion.duration * rate) + 1) / rate
        q, v = motion.evaluate(t)[:2]
        names = ["t", *(f"{name}{j + 1}" for name in ("q", "qd") for j in range(moved.num_joints))]
        write_csv(csv, names, np.column_stack([t, q, v]))
    console = make_console()
    print_answer(
        console,
        f"{moved.name}: motion of {motion.duration:g} s. Expected error of predicted efforts: "
        f"{100 * design.expected_error:.1f} % ({100 * design.random_error:.1f} % with the best random motion).",
        f"dvrk-drake identify RECORDING.csv --arm {arm} --output model.yaml",
    )
    console.print(
        f"Base parameters known to 10 %: {design.known_parameters} of {design.num_parameters}. Condition number: "
        f"{design.condition_number:.3g}. Information per parameter (log-determinant): {design.log_determinant:.2f}."
    )
    print_written(output)
    if csv is not None:
        print_written(csv)


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
