"""The verbs `check` and `convert`, for recordings."""

from __future__ import annotations

import argparse
import sys

import dvrk_drake as dvrk
from dvrk_drake.cli.support import (
    ProgressBar,
    add_overwrite,
    add_recording,
    check_output,
    made_folder,
    write_json,
)
from dvrk_drake.errors import RecordingError


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verbs and their options."""
    verb = verbs.add_parser(
        "check",
        help="say what is wrong with a recording before anything is identified from it; exit code 2: unusable",
    )
    add_recording(verb)
    verb.add_argument("--arm", required=True, help="the arm that was recorded: mtml, mtmr, psm, or a YAML file")
    verb.add_argument("--json", metavar="FILE", help="write the findings and numbers as JSON")
    add_overwrite(verb)
    verb.add_argument("--plots", metavar="DIR", help="of a motion: write spectra of its efforts into this folder")
    verb.set_defaults(run=_check)

    verb = verbs.add_parser("convert", help="turn a recording (CSV, LCM log, team .mat, WPI CSV) into our CSV")
    verb.add_argument("input", metavar="INPUT")
    verb.add_argument("output", metavar="OUTPUT.csv")
    verb.add_argument("--format", choices=("csv", "team-mat", "wpi-csv", "lcm-log"), help="default: detected")
    verb.add_argument(
        "--coordinates",
        choices=("joint", "actuator"),
        help="what q and tau of a CSV with a header are of; needed there, the other formats define it",
    )
    verb.add_argument("--variable", metavar="NAME", help="the .mat's variable, where several fit")
    verb.add_argument(
        "--rate",
        type=float,
        metavar="HZ",
        help="samples a second of a CSV without time stamps; default: WPI 200, with a header none are written",
    )
    verb.add_argument(
        "--arm", help="e.g. psm; CSV, WPI: write its joint coordinates, not the actuators'; LCM log: which arm"
    )
    verb.add_argument(
        "--skip-invalid",
        action="store_true",
        help="leave out rows with an empty cell, a NaN or an infinity, and count them",
    )
    add_overwrite(verb)
    verb.set_defaults(run=_convert)


def _check(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.recording_check import print_report
    from dvrk_drake.reports.terminal_tables import make_console

    arm = dvrk.load_arm(options.arm)
    if options.json is not None:
        check_output(options.json, options.recording, overwrite=options.overwrite)
    plots = None if options.plots is None else made_folder(options.plots)
    with ProgressBar("reading") as bar:
        recording = dvrk.read_recording(options.recording, arm, options.coordinates, progress=bar)
        bar("checking the recording", 0.0)
        report = dvrk.check(recording, arm, progress=bar)
    print_report(make_console(), report, arm=options.arm)
    if options.json is not None:
        write_json(options.json, report.as_dict())
    if plots is not None:
        from dvrk_drake.reports.figures.recording_check import plot_report

        if not plot_report(plots, report, recording, arm):
            print("no plots: spectra need a motion with efforts at a known rate", file=sys.stderr)
    if report.refusals:
        raise RecordingError(report.refusal)


def _convert(options: argparse.Namespace) -> None:
    from dvrk_drake.recordings.conversion import convert
    from dvrk_drake.reports.terminal_tables import make_console

    check_output(options.output, options.input, overwrite=options.overwrite)
    console = make_console()
    recording = convert(
        options.input,
        options.output,
        format=options.format,
        coordinates=options.coordinates,
        variable=options.variable,
        rate=options.rate,
        arm=None if options.arm is None else dvrk.load_arm(options.arm),
        skip_invalid=options.skip_invalid,
    )
    for note in recording.notes:
        console.print(note, soft_wrap=True)
    console.print(f"{options.output}: {len(recording)} rows, {recording.coordinates} coordinates", soft_wrap=True)
