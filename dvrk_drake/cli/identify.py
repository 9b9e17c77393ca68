"""The verbs that learn from recordings and put to the test what was learnt."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dvrk_drake.cli.dynamics import identify_motion, refuse_unusable, show_motion_validation
from dvrk_drake.cli.support import (
    ProgressBar,
    add_gravity,
    add_overwrite,
    add_recording,
    check_output,
    made_folder,
    mounted,
    print_notes,
    write_tables,
)

if TYPE_CHECKING:
    from dvrk_drake.analysis.static.validation import Validation
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.recordings.recording import Recording


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
    from dvrk_drake.analysis.check.recording_check import check_with_channels
    from dvrk_drake.analysis.signals.static_segments import find_poses
    from dvrk_drake.analysis.static.static_identification import identify_static
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.recordings.recording import read_recording
    from dvrk_drake.reports.figures import plot_identification
    from dvrk_drake.reports.terminal_tables import make_console, print_doubts, print_model

    check_output(options.output, options.recording, overwrite=options.overwrite)
    if options.tables is not None:
        check_output(options.tables, options.recording, options.output, overwrite=options.overwrite)
    arm = mounted(load_arm(options.arm), options.gravity)
    recording = read_recording(options.recording, arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    plots = None if options.plots is None else made_folder(options.plots)
    console = make_console()
    recording, measured, note, moves = find_poses(recording, arm, options.slow_parts)
    refuse_unusable(console, recording, arm, warn=True, check=check_with_channels)
    if moves:
        identify_motion(options, recording, arm, plots)
        return
    if note:
        console.print(note)
    with ProgressBar("identifying") as (progress, task):
        result = identify_static(
            recording, arm, options.method, lambda share: progress.update(task, completed=100 * share), measured
        )
    print_doubts(console, result.doubts)
    print_model(console, result.model)
    if options.tables is not None:
        write_tables(options.tables, lambda file: print_model(file, result.model))
        console.print(f"all parameters: {options.tables}")
    if len(result.recording) < len(recording):
        console.print(
            f"{len(recording)} rows are {len(result.recording)} distinct poses; samples of a pose are averaged"
        )
    result.model.save(options.output)
    console.print(f"model: {options.output}")
    commanded = [joint.name for joint in result.model.joints if joint.trust > 0]
    if measured is not None and commanded:
        print(
            f"dvrk-drake: warning: {options.recording}: friction in low-speed segments can look like gravity, also in "
            f"the ten-fold error; the torque on {', '.join(commanded)} may be worse than zero torque elsewhere: "
            "validate the model on static poses before it commands an arm",
            file=sys.stderr,
        )
    if plots is not None:
        plot_identification(plots, result)
        console.print(f"plots: {options.plots}")


def _validate(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.dynamic.validation import DynamicValidation, validate_motion
    from dvrk_drake.analysis.signals.static_segments import find_poses
    from dvrk_drake.analysis.static.validation import validate
    from dvrk_drake.analysis.verdict import unfit
    from dvrk_drake.dynamics.identified_model import IdentifiedModel, ValidationSummary
    from dvrk_drake.errors import ModelError
    from dvrk_drake.recordings.recording import read_recording
    from dvrk_drake.reports.terminal_tables import make_console

    if options.json is not None:
        check_output(options.json, options.recording, options.model, overwrite=options.overwrite)
    model = IdentifiedModel.load(options.model)
    arm = model.load_arm()
    recording = read_recording(options.recording, arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    plots = None if options.plots is None else made_folder(options.plots)
    console = make_console()
    sha256, source = recording.sha256, recording.source
    same = bool(sha256) and sha256 == model.provenance.sha256
    if options.save:
        check_output(options.model, options.recording, overwrite=True)
        if same:
            raise ModelError(f"{source}: --save needs a recording that the model was not identified from")
        if model.validation is not None and not options.overwrite:
            saved = model.validation.recording
            raise ModelError(f"{options.model}: has verdicts from {saved} already; replace them with --overwrite")
    recording, measured, note, moves = find_poses(recording, arm, options.slow_parts)
    warnings = refuse_unusable(console, recording, arm)
    in_motion = moves and model.dynamics is not None
    validation = validate_motion(model, recording) if in_motion else validate(model, recording, measured)
    # Before anything is printed: whoever reads the output may close it (head).
    if options.save:
        summary = ValidationSummary(source, sha256, dict(validation.verdicts))
        replace(model, validation=summary).save(options.model)
    failed = [] if options.require is None else unfit(validation.verdicts, options.require)
    if isinstance(validation, DynamicValidation):
        show_motion_validation(options, validation, model, source, plots)
    else:
        _show_validation(options, validation, model, recording, plots)
        if note:
            console.print(note)
    for warning in warnings:
        console.print(warning, style="yellow", markup=False, soft_wrap=True)
    if options.save:
        console.print(f"verdicts saved: {options.model}")
    if same:
        print(
            f"dvrk-drake: warning: {source}: the model was identified from this recording, so these are errors of the "
            "fit; validate with another one",
            file=sys.stderr,
        )
    if failed:
        raise ModelError(
            f"{options.model}: not {options.require} on {source}: {', '.join(failed)}; identify from a recording with "
            "more varied poses, or recalibrate"
        )


def _show_validation(
    options: argparse.Namespace,
    validation: Validation,
    model: IdentifiedModel,
    recording: Recording,
    plots: Path | None,
) -> None:
    """Writes the JSON of a model compared with poses, prints verdicts and errors, writes the plots."""
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.figures import plot_validation
    from dvrk_drake.reports.terminal_tables import make_console, print_doubts, print_validation

    console, arm = make_console(), model.load_arm()
    if options.json is not None:
        with atomic_write(options.json) as stream:
            json.dump(validation.as_dict(), stream, indent=2)
            stream.write("\n")
    print_validation(console, validation)
    if motion := recording.motion(arm):
        console.print(
            f"the arm moves in this recording ({motion}): the model holds poses, and "
            "knows nothing of inertia and of moving friction",
            style="yellow",
            soft_wrap=True,
        )
    print_doubts(console, validation.doubts)
    if plots is not None:
        plot_validation(plots, model, validation, recording.in_joint_coordinates(arm))
        console.print(f"plots: {options.plots}")


def _predict(options: argparse.Namespace) -> None:
    import numpy as np

    from dvrk_drake.analysis.dynamic.validation import predict_motion
    from dvrk_drake.analysis.signals.static_segments import find_poses
    from dvrk_drake.analysis.static.validation import predict
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.recordings.recording import read_recording, write_csv
    from dvrk_drake.reports.terminal_tables import make_console

    check_output(options.output, options.recording, options.model, overwrite=options.overwrite)
    model = IdentifiedModel.load(options.model)
    arm = model.load_arm()
    recording = read_recording(options.recording, arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    # Positions and velocities suffice, but what judges a motion wants efforts.
    measured = recording if recording.tau is not None else replace(recording, tau=np.zeros_like(recording.q))
    if model.dynamics is not None and find_poses(measured, arm).moves:
        of_efforts = () if recording.tau is not None else ("no effort",)
        refuse_unusable(make_console(), measured, arm, warn=True, apart_from=of_efforts)
        tau = predict_motion(model, recording)
        if recording.coordinates == "joint":
            tau = arm.transmission.pull_back_effort(tau)
    else:
        tau = predict(model, recording)
    write_csv(options.output, [f"tau{i + 1}" for i in range(tau.shape[1])], tau)


def _convert(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
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
        arm=None if options.arm is None else load_arm(options.arm),
        skip_invalid=options.skip_invalid,
    )
    for note in recording.notes:
        console.print(note, soft_wrap=True)
    console.print(f"{options.output}: {len(recording)} rows, {recording.coordinates} coordinates", soft_wrap=True)


_slow_parts_help = "of a motion without rests, take where a joint is slow as poses"
