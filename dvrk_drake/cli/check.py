"""The verb `check`."""

from __future__ import annotations

import argparse
import json
import sys

from dvrk_drake.cli.support import ProgressBar, add_overwrite, add_recording, check_output, made_folder
from dvrk_drake.errors import RecordingError


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
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


def _check(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.check.recording_check import check_for_identification
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.recordings.recording import read_recording
    from dvrk_drake.reports.recording_check import plot_report, print_report
    from dvrk_drake.reports.terminal_tables import make_console

    arm = load_arm(options.arm)
    if options.json is not None:
        check_output(options.json, options.recording, overwrite=options.overwrite)
    plots = None if options.plots is None else made_folder(options.plots)
    with ProgressBar("reading") as (progress, task):
        recording = read_recording(
            options.recording, arm, options.coordinates, lambda share: progress.update(task, completed=100 * share)
        )
    with ProgressBar("checking"):
        report = check_for_identification(recording, arm)
    print_report(make_console(), report)
    if options.json is not None:
        with atomic_write(options.json) as stream:
            json.dump(report.as_dict(), stream, indent=2)
            stream.write("\n")
    if plots is not None and not plot_report(plots, report, recording, arm):
        print("no plots: spectra need a motion with efforts at a known rate", file=sys.stderr)
    if report.refusals:
        first, *others = report.refusals
        reasons = f"refused for {len(others) + 1} reasons, the first: " if others else "refused: "
        where = "" if first.where == report.source else f"{first.where}: "
        raise RecordingError(f"{options.recording}: {reasons}{where}{first.what}; {first.advice}")
