"""The verbs that learn from recordings and put to the test what was learnt."""

from __future__ import annotations

import argparse

import dvrk_drake as dvrk
from dvrk_drake.cli.support import (
    ProgressBar,
    add_gravity,
    add_overwrite,
    add_recording,
    check_output,
    made_folder,
    mounted,
    print_notes,
    print_warnings,
    write_json,
    write_tables,
)
from dvrk_drake.errors import ModelError


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verbs and their options."""
    verb = verbs.add_parser(
        "identify",
        help="identify a model: of a motion the full dynamics, of poses what holds the arm",
    )
    add_recording(verb)
    verb.add_argument("--arm", required=True, help="the arm that was recorded: mtml, mtmr, psm, or a YAML file")
    verb.add_argument("--output", required=True, metavar="MODEL.yaml", help="the model file to write")
    verb.add_argument("--method", choices=("robust", "paper"), default="robust", help="for poses; default: robust")
    verb.add_argument("--plots", metavar="DIR", help="write plots into this folder")
    verb.add_argument("--tables", metavar="FILE.txt", help="write all parameters with their standard errors as text")
    add_overwrite(verb)
    verb.add_argument("--slow-parts", action="store_true", help=_slow_parts_help)
    add_gravity(verb)
    verb.set_defaults(run=_identify)

    verb = verbs.add_parser("validate", help="compare a model with a recording that it was not made from")
    verb.add_argument("model", metavar="MODEL.yaml")
    add_recording(verb)
    verb.add_argument(
        "--require",
        choices=("good", "usable"),
        help="exit code 2 unless every joint that the model commands has this verdict or a better one",
    )
    verb.add_argument("--save", action="store_true", help="store the verdicts in MODEL.yaml, where run looks for them")
    verb.add_argument("--json", metavar="FILE", help="write verdicts and errors as JSON")
    add_overwrite(verb)
    verb.add_argument("--slow-parts", action="store_true", help=_slow_parts_help)
    verb.add_argument("--plots", metavar="DIR", help="write plots into this folder")
    verb.set_defaults(run=_validate)

    verb = verbs.add_parser(
        "predict",
        help="write a model's efforts at a recording's rows: of a motion behind its low-pass, of poses what holds them",
    )
    verb.add_argument("model", metavar="MODEL.yaml")
    add_recording(verb)
    verb.add_argument("--output", required=True, metavar="FILE.csv", help="columns tau1.., one row a row")
    add_overwrite(verb)
    verb.set_defaults(run=_predict)

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

    verb = verbs.add_parser("payload", help="say what was added to an arm between two recordings of one motion")
    verb.add_argument("reference", metavar="REFERENCE", help="recording of the motion without the payload")
    verb.add_argument("loaded", metavar="LOADED", help="recording of the same motion with it")
    source = verb.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--arm", help="the arm: mtml, mtmr, psm, or a YAML file; its model is identified from REFERENCE"
    )
    source.add_argument("--model", metavar="MODEL.yaml", help="its model, identified from a motion")
    verb.add_argument("--link", help="link of the SDF that carries it, compared with all others; default: the best")
    verb.add_argument(
        "--coordinates", choices=("joint", "actuator"), default="joint", help="what q and tau are of; default: joint"
    )
    verb.add_argument("--json", metavar="FILE", help="write the estimates as JSON")
    add_overwrite(verb)
    add_gravity(verb)
    verb.set_defaults(run=_payload)


def _identify(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.identification import print_identification
    from dvrk_drake.reports.terminal_tables import make_console

    check_output(options.output, options.recording, overwrite=options.overwrite)
    if options.tables is not None:
        check_output(options.tables, options.recording, options.output, overwrite=options.overwrite)
    arm = mounted(dvrk.load_arm(options.arm), options.gravity)
    recording = dvrk.read_recording(options.recording, arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    plots = None if options.plots is None else made_folder(options.plots)
    with ProgressBar("identifying") as bar:
        result = dvrk.identify(recording, arm, method=options.method, slow_parts=options.slow_parts, progress=bar)
    console = make_console()
    print_warnings(console, result.warnings)
    if result.note:
        console.print(result.note)
    print_identification(console, result, model_path=options.output)
    result.save(options.output, overwrite=True)
    console.print(f"model: {options.output}")
    if options.tables is not None:
        write_tables(options.tables, lambda file: print_identification(file, result, verbose=True))
        console.print(f"all parameters: {options.tables}")
    if plots is not None:
        from dvrk_drake.reports.figures.identification import plot_identification

        plot_identification(plots, result)
        console.print(f"plots: {options.plots}")


def _model_and_recording(options: argparse.Namespace) -> tuple[dvrk.IdentifiedModel, dvrk.Recording]:
    """Reads a model and a recording of its arm, and prints the notes on the recording."""
    model = dvrk.IdentifiedModel.load(options.model)
    recording = dvrk.read_recording(options.recording, model.arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    return model, recording


def _validate(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.identification import print_validation
    from dvrk_drake.reports.terminal_tables import make_console

    if options.json is not None:
        check_output(options.json, options.recording, options.model, overwrite=options.overwrite)
    model, recording = _model_and_recording(options)
    plots = None if options.plots is None else made_folder(options.plots)
    if options.save:
        check_output(options.model, options.recording, overwrite=True)
        if recording.sha256 and recording.sha256 == model.provenance.sha256:
            raise ModelError(f"{recording.source}: --save needs a recording that the model was not identified from")
        if model.validation is not None and not options.overwrite:
            saved = model.validation.recording
            raise ModelError(f"{options.model}: has verdicts from {saved} already; replace them with --overwrite")
    with ProgressBar("validating") as bar:
        validation = dvrk.validate(model, recording, slow_parts=options.slow_parts, progress=bar)
    # Before anything is printed: whoever reads the output may close it (head).
    if options.save:
        validation.save(options.model, overwrite=True)
    if options.json is not None:
        write_json(options.json, validation.as_dict())
    console = make_console()
    print_validation(console, validation, model_path=options.model)
    if plots is not None:
        from dvrk_drake.reports.figures.identification import plot_validation

        plot_validation(plots, validation)
        console.print(f"plots: {options.plots}")
    if validation.note:
        console.print(validation.note)
    print_warnings(console, validation.warnings)
    if options.save:
        console.print(f"verdicts saved: {options.model}")
    if options.require is not None and (failed := validation.unfit(options.require)):
        raise ModelError(
            f"{options.model}: not {options.require} on {recording.source}: {', '.join(failed)}; identify from a "
            "recording with more varied poses, or recalibrate"
        )


def _predict(options: argparse.Namespace) -> None:
    from dvrk_drake.recordings.recording import write_csv
    from dvrk_drake.reports.terminal_tables import make_console

    check_output(options.output, options.recording, options.model, overwrite=options.overwrite)
    model, recording = _model_and_recording(options)
    with ProgressBar("predicting") as bar:
        prediction = dvrk.predict(model, recording, progress=bar)
    print_warnings(make_console(), prediction.warnings)
    tau = prediction.tau
    write_csv(options.output, [f"tau{i + 1}" for i in range(tau.shape[1])], tau)


def _recalibrate(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.identification import print_recalibration
    from dvrk_drake.reports.terminal_tables import make_console

    check_output(options.output, options.recording, options.model, overwrite=options.overwrite)
    model, recording = _model_and_recording(options)
    with ProgressBar("recalibrating") as bar:
        result = dvrk.recalibrate(model, recording, progress=bar)
    console = make_console()
    print_recalibration(console, result, model_path=options.output)
    result.save(options.output, overwrite=True)
    console.print(f"model: {options.output}")


def _payload(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.payload import print_payload
    from dvrk_drake.reports.terminal_tables import make_console

    model = None if options.model is None else dvrk.IdentifiedModel.load(options.model)
    if model is not None and options.gravity is not None:
        raise ModelError(f"{options.model}: states its gravity; --gravity is for --arm")
    arm = mounted(dvrk.load_arm(options.arm), options.gravity) if model is None else model.arm
    if options.json is not None:
        check_output(options.json, options.reference, options.loaded, overwrite=options.overwrite)
    reference, loaded = (dvrk.read_recording(p, arm, options.coordinates) for p in (options.reference, options.loaded))
    for recording in (reference, loaded):
        print_notes(recording.source, recording.notes)
    with ProgressBar("estimating") as bar:
        result = dvrk.payload(reference, loaded, model or arm, options.link, progress=bar)
    console = make_console()
    other_link = [warning for warning in result.warnings if warning.kind == "other link"]
    print_payload(console, result)
    print_warnings(console, other_link)
    if options.json is not None:
        write_json(options.json, result.as_dicts())


_slow_parts_help = "of a motion without rests, take where a joint is slow as poses"
