"""The verb `recalibrate`."""

from __future__ import annotations

import argparse

import dvrk_drake as dvrk
from dvrk_drake.cli.support import ProgressBar, add_overwrite, add_recording, check_output, print_notes


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser(
        "recalibrate",
        help="refit a model's friction and offsets to a short motion of another day",
        description="Refit a model's friction and offsets to a short motion of another day. The gain is for motions "
        "like that one; at other positions and speeds it can be much smaller (docs/payload.md).",
    )
    verb.add_argument("model", metavar="MODEL.yaml", help="a model that was identified from a motion")
    add_recording(verb)
    verb.add_argument("--output", required=True, metavar="NEW.yaml", help="the model file to write")
    add_overwrite(verb)
    verb.set_defaults(run=_recalibrate)


def _recalibrate(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.identification import print_recalibration
    from dvrk_drake.reports.terminal_tables import make_console

    check_output(options.output, options.recording, options.model, overwrite=options.overwrite)
    model = dvrk.IdentifiedModel.load(options.model)
    recording = dvrk.read_recording(options.recording, model.arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    with ProgressBar("recalibrating") as bar:
        result = dvrk.recalibrate(model, recording, progress=bar)
    console = make_console()
    print_recalibration(console, result)
    result.save(options.output, overwrite=True)
    console.print(f"model: {options.output}")
