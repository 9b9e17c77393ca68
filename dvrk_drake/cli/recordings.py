"""The commands `check` and `convert`, for recordings."""

from __future__ import annotations

import sys
from typing import Annotated, Literal

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli.app import IDENTIFY, Arm, Coordinates, Json, Overwrite, Plots, Verbose, app
from dvrk_drake.cli.support import Steps, check_output, plots_folder, print_notes, print_written, write_json
from dvrk_drake.errors import RecordingError


@app.command(group=IDENTIFY)
def check(
    recording: str,
    /,
    *,
    arm: Arm,
    coordinates: Coordinates = "joint",
    json: Json = None,
    plots: Plots = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
) -> None:
    """Say what is wrong with a recording.

    The exit code is 2 where no model can be identified from it.

    Args:
        recording: CSV with header q1..qn, tau1..taun (t, qd1..qdn optional), or an LCM log.
    """
    from dvrk_drake.reports.recording_check import print_report
    from dvrk_drake.reports.terminal_tables import make_console

    recorded_arm = dvrk.load_arm(arm)
    if json is not None:
        check_output(json, recording, overwrite=overwrite)
    folder = plots_folder(plots, overwrite=overwrite)
    with Steps("reading", "checking the recording") as steps:
        checked = dvrk.read_recording(recording, recorded_arm, coordinates, progress=steps)
        report = dvrk.check(checked, recorded_arm, progress=steps)
    # Before anything is printed: the reader of the output may close it (head).
    if json is not None:
        write_json(json, report.as_dict())
    options = arm if coordinates == "joint" else f"{arm} --coordinates {coordinates}"
    print_report(make_console(), report, arm=options, verbose=verbose)
    if json is not None:
        print_written(json)
    if folder is not None:
        from dvrk_drake.reports.figures.recording_check import plot_report

        if plot_report(folder, report, checked, recorded_arm):
            print_written(folder)
        else:
            print_notes(recording, ["no plots: spectra need a motion with efforts at a known rate"])
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
    input_format: Literal["csv", "team-mat", "wpi-csv", "lcm-log"] | None = None,
    coordinates: Literal["joint", "actuator"] | None = None,
    variable: Annotated[str | None, Parameter(metavar="NAME")] = None,
    rate: Annotated[float | None, Parameter(metavar="HZ")] = None,
    arm: Annotated[str | None, Parameter(metavar="ARM")] = None,
    skip_invalid: Annotated[bool, Parameter(show_default=False)] = False,
    overwrite: Overwrite = False,
) -> None:
    """Convert a recording to the CSV of this project.

    It reads CSV, LCM logs, .mat files of the JHU-WPI team, and CSV of WPI.

    Args:
        recording: The file to convert.
        output: The CSV to write.
        input_format: Format of the recording. Without it: detected.
        coordinates: Coordinates of q and tau in a CSV with a header. Needed there; the other formats define it.
        variable: Variable of the .mat file, where several fit.
        rate: Samples per second of a CSV without time stamps. Without it: 200 for WPI, no times with a header.
        arm: CSV, WPI: convert the actuators' coordinates to the joints' of this arm. LCM log: the arm to read.
        skip_invalid: Leave out and count rows with an empty cell, a NaN or an infinity.
    """
    from dvrk_drake.recordings.conversion import convert as convert_recording

    check_output(output, recording, overwrite=overwrite)
    converted = convert_recording(
        recording,
        output,
        format=input_format,
        coordinates=coordinates,
        variable=variable,
        rate=rate,
        arm=None if arm is None else dvrk.load_arm(arm),
        skip_invalid=skip_invalid,
    )
    print_written(output, f"{len(converted)} rows, {converted.coordinates} coordinates")
    for note in converted.notes:
        print(note)
