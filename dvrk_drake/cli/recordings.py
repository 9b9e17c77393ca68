"""Commands for recordings: check and convert."""

from __future__ import annotations

import sys
from typing import Annotated, Literal

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli.app import IDENTIFY, Arm, Coordinates, Json, Locked, Overwrite, Plots, Topic, Verbose, app
from dvrk_drake.cli.support import Steps, check_output, mounted, plots_folder, print_notes, print_written, write_json
from dvrk_drake.errors import RecordingError


@app.command(group=IDENTIFY)
def check(
    recording: str,
    /,
    *,
    arm: Arm,
    coordinates: Coordinates = "joint",
    topic: Topic = None,
    locked: Locked = None,
    json: Json = None,
    plots: Plots = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
) -> None:
    """Check a recording and report its problems.

    The exit code is 2 if the recording is not suitable for identification.

    Args:
        recording: CSV with columns q1..qn, tau1..taun (optionally t, qd1..qdn), ROS bag, or LCM log.
    """
    from dvrk_drake.models.locked_joints import locked_option
    from dvrk_drake.reports.recording_check import print_report
    from dvrk_drake.reports.terminal_tables import make_console

    recorded_arm = mounted(dvrk.load_arm(arm), None, locked)
    if json is not None:
        check_output(json, recording, overwrite=overwrite)
    folder = plots_folder(plots, overwrite=overwrite)
    with Steps("reading", "checking the recording") as steps:
        checked = dvrk.read_recording(recording, recorded_arm, coordinates, topic=topic, progress=steps)
        report = dvrk.check(checked, recorded_arm, progress=steps)
    # Results are saved before printing, because the reader of the output (e.g. head) may close the pipe.
    if json is not None:
        write_json(json, report.as_dict())
    options = (arm if coordinates == "joint" else f"{arm} --coordinates {coordinates}") + locked_option(recorded_arm)
    print_report(make_console(), report, arm=options, verbose=verbose)
    if json is not None:
        print_written(json)
    if folder is not None:
        from dvrk_drake.reports.figures.recording_check import plot_report

        if plot_report(folder, report, checked, recorded_arm):
            print_written(folder)
        else:
            print_notes(recording, ["no plots were written; spectra require a motion with efforts and time stamps"])
    for refusal in report.refusals[1:]:
        print(f"dvrk-drake: {refusal}", file=sys.stderr)
    if report.refusals:
        raise RecordingError(report.refusal)


@app.command(group=IDENTIFY)
def convert(
    recording: str,
    /,
    *,
    output: Annotated[str, Parameter(metavar="FILE.csv")],
    input_format: Literal["csv", "team-mat", "wpi-csv", "lcm-log", "ros-bag"] | None = None,
    coordinates: Literal["joint", "actuator"] | None = None,
    variable: Annotated[str | None, Parameter(metavar="NAME")] = None,
    topic: Topic = None,
    rate: Annotated[float | None, Parameter(metavar="HZ")] = None,
    arm: Annotated[str | None, Parameter(metavar="ARM")] = None,
    skip_invalid: Annotated[bool, Parameter(show_default=False)] = False,
    overwrite: Overwrite = False,
) -> None:
    """Convert a recording to the CSV format of this project.

    The formats are csv, ros-bag, lcm-log, team-mat (MATLAB files of JHU and WPI) and wpi-csv (CSV files of WPI).

    Args:
        recording: File to convert.
        output: CSV file to write.
        input_format: Format of the recording. Default: detected from the content.
        coordinates: Coordinates of q and tau. Required for csv. All other formats define the coordinates.
        variable: Variable of a team-mat file that contains the recording. Required if several variables are possible.
        rate: Sampling rate [Hz] of rows without time stamps. Default: 200 for wpi-csv, no time stamps for csv.
        arm: csv, wpi-csv: convert to joint coordinates of this arm. ros-bag, lcm-log: read messages of this arm.
        skip_invalid: Skip rows with an empty cell, NaN or an infinite value, and print the number of skipped rows.
    """
    from dvrk_drake.recordings.conversion import convert as convert_recording

    check_output(output, recording, overwrite=overwrite)
    converted = convert_recording(
        recording,
        output,
        format=input_format,
        coordinates=coordinates,
        variable=variable,
        topic=topic,
        rate=rate,
        arm=None if arm is None else dvrk.load_arm(arm),
        skip_invalid=skip_invalid,
    )
    print_written(output, f"{len(converted)} rows, {converted.coordinates} coordinates")
    for note in converted.notes:
        print(note)
