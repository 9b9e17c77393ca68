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


def _identify(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.identification import plot_identification, print_identification
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
    print_identification(console, result)
    result.save(options.output, overwrite=True)
    console.print(f"model: {options.output}")
    if options.tables is not None:
        write_tables(options.tables, lambda file: print_identification(file, result, full=True))
        console.print(f"all parameters: {options.tables}")
    if plots is not None:
        plot_identification(plots, result)
        console.print(f"plots: {options.plots}")


def _validate(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.identification import plot_validation, print_validation
    from dvrk_drake.reports.terminal_tables import make_console

    if options.json is not None:
        check_output(options.json, options.recording, options.model, overwrite=options.overwrite)
    model = dvrk.IdentifiedModel.load(options.model)
    recording = dvrk.read_recording(options.recording, model.arm, options.coordinates)
    print_notes(options.recording, recording.notes)
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
    print_validation(console, validation)
    if plots is not None:
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
    model = dvrk.IdentifiedModel.load(options.model)
    recording = dvrk.read_recording(options.recording, model.arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    with ProgressBar("predicting") as bar:
        prediction = dvrk.predict(model, recording, progress=bar)
    print_warnings(make_console(), prediction.warnings)
    tau = prediction.tau
    write_csv(options.output, [f"tau{i + 1}" for i in range(tau.shape[1])], tau)


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


_slow_parts_help = "of a motion without rests, take where a joint is slow as poses"
