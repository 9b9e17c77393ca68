"""Commands that identify models from recordings and validate them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, Token

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.cli.support import Results, ResultsAndJson
from dvrk_drake.errors import ModelError, RecordingError

if TYPE_CHECKING:
    from dvrk_drake.analysis.results import Identification, Validation
    from dvrk_drake.reports.page import Page


def _gravity(argument: object, tokens: Sequence[Token]) -> tuple[float, float, float] | Literal["estimate"]:
    """Converts the words after --gravity or --mount. Raises ValueError unless they are numbers or "estimate"."""
    if [token.value for token in tokens] == ["estimate"]:
        return "estimate"
    if len(tokens) != 3 and {token.keyword for token in tokens} == {"--gravity"}:
        raise ValueError("--gravity needs three numbers [m/s^2], or the word estimate")
    return options.gravity_vector(argument, tokens)


OwnGravity = Annotated[
    tuple[float, float, float] | Literal["estimate"] | None,
    Parameter(
        metavar="X Y Z",
        alias="--mount",
        converter=_gravity,
        n_tokens=-1,
        consume_multiple=True,
        help=f"{options.GRAVITY_HELP} The word estimate estimates the direction from the recording. "
        "Default: the vector in the arm file.",
    ),
]
Compare = Annotated[
    str | None,
    Parameter(metavar="MODEL.yaml", help="Previous model. Its errors on the recording are shown beside the new ones."),
]
NewModel = Annotated[str, Parameter(metavar="MODEL.yaml", help="Model file to write.")]
_FILE = options.FileOptions()
_PAGE, _RESULTS = Results(), ResultsAndJson()
_STEPS = "reading", "checking the recording"
_SOURCE = options.one_of("Source of the model (one is required)")


@options.identify.default
def identify_model(
    recording: options.Recording,
    /,
    *others: str,
    arm: options.Arm,
    output: NewModel,
    instrument: options.Instrument = "",
    file: options.FileOptions = _FILE,
    method: Literal["robust", "paper"] = "robust",
    gravity: OwnGravity = None,
    locked: options.Locked = None,
    compare: Compare = None,
    results: Results = _PAGE,
) -> None:
    """Identify a model from a recording, or from several.

    A motion determines the full dynamics, including friction. Static poses determine only the holding torque.
    Several motions give one model. Offsets and friction may differ between them, for example from day to day.
    Static poses in addition to motions correct the holding torque.

    Args:
        others: More motions of the same arm, or static poses.
        method: Method for static poses: robust regression, or the least squares of the paper (Rutfield et al., 2015).
    """

    paths = (recording, *others)
    results.check(*paths, output=output)
    recorded_arm = support.mounted(dvrk.load_arm(arm, instrument), None if gravity == "estimate" else gravity, locked)
    with support.Steps(*_STEPS, "identifying") as steps:
        read = []
        for path in paths:
            read.append(file.read(path, recorded_arm, steps))
            support.print_notes(path, read[-1].notes)
        result = dvrk.identify(
            read,
            recorded_arm,
            method=method,
            estimate_gravity=gravity == "estimate",
            progress=steps,
        )
    # Results are saved before printing, because the reader of the output (e.g. head) may close the pipe.
    result.save(output, overwrite=True)
    page = _page(result, output, file, compare)
    results.show(page, *paths, note=result.note, warnings=result.warnings, saved=output)
    _print_report_option(results.report)


def _page(
    result: Identification | Validation,
    model: str,
    file: options.FileOptions,
    compare: str | None,
    *,
    saved: bool = False,
) -> Page:
    """Returns the page of a result, with the errors of the SDF and of the model given with --compare.

    Args:
        result: Result of the command.
        model: Path of the model file.
        file: Options with which the recording was read.
        compare: Path of a previous model, or None.
        saved: Whether the verdicts are stored in the model file.
    """
    from dvrk_drake.analysis.validation import baseline_efforts
    from dvrk_drake.reports.identification import identification_page

    baselines = baseline_efforts(result, None if compare is None else support.load_model(compare, None))
    return identification_page(result, model_path=model, file_options=file.as_text(), saved=saved, baselines=baselines)


def _print_report_option(report: str | None) -> None:
    if report is None:
        print("--report FILE.html writes plots, parameters with intervals and a 3D view of the recording.", flush=True)


def _model_and_recording(
    model: str, recording: str, file: options.FileOptions, steps: support.Steps
) -> tuple[dvrk.IdentifiedModel, dvrk.Recording]:
    """Loads a model and a recording of its arm, and prints the notes on the recording."""
    loaded = support.load_model(model, None)
    try:
        read = file.read(recording, loaded.arm, steps)
    except RecordingError as error:
        if not Path(recording).exists():
            raise
        # A recording of another arm lacks columns or exceeds limits, and its own message cannot name the cause.
        raise RecordingError(f"{error}. {model} is a model of {loaded.arm.name}") from error
    support.print_notes(recording, read.notes)
    return loaded, read


@options.app.command(group=options.IDENTIFY)
def validate(
    recording: options.Recording,
    /,
    *,
    model: options.Model,
    file: options.FileOptions = _FILE,
    compare: Compare = None,
    require: Literal["good", "usable"] | None = None,
    save: Annotated[bool, Parameter(show_default=False)] = False,
    results: ResultsAndJson = _RESULTS,
) -> None:
    """Evaluate the error of a model on another recording.

    Args:
        require: Exit with code 2 unless each joint with feedforward has at least this verdict.
        save: Store the verdicts in the model file, which dvrk-drake control checks. With
            --overwrite, stored verdicts are replaced.
    """

    results.check(recording, model)
    with support.Steps(*_STEPS, "validating") as steps:
        loaded, read = _model_and_recording(model, recording, file, steps)
        if (save or require) and loaded.provenance.includes(read.sha256):
            option = "--save" if save else "--require"
            raise ModelError(
                f"{read.source}: the model was identified from this recording; {option} requires another recording"
            )
        if save:
            support.check_output(model, recording, overwrite=True)
            if loaded.validation is not None and not results.overwrite:
                saved = loaded.validation.recording
                raise ModelError(f"{model}: contains verdicts from {saved}; use --overwrite to replace them")
        validation = dvrk.validate(loaded, read, progress=steps)
    # Results are saved before printing, because the reader of the output (e.g. head) may close the pipe.
    if save:
        validation.save(model, overwrite=True)
    page, content = _page(validation, model, file, compare, saved=save), validation.as_dict()
    results.show(page, recording, model, content=content, note=validation.note, warnings=validation.warnings)
    if save:
        support.print_written(model, "verdicts stored")
    _print_report_option(results.report)
    if require is not None and (failed := validation.unfit(require)):
        advice = "identify from a recording with more varied poses"
        if loaded.dynamics is not None:
            advice = "identify from a recording with more varied motions, or recalibrate"
        raise ModelError(f"{model}: verdicts below {require} on {read.source}: {', '.join(failed)}; {advice}")


@options.app.command(group=options.IDENTIFY)
def predict(
    recording: options.Recording,
    /,
    *,
    model: options.Model,
    output: Annotated[str, Parameter(metavar="FILE.csv")],
    file: options.FileOptions = _FILE,
    overwrite: options.Overwrite = False,
) -> None:
    """Predict the efforts of a recording with a model.

    A model with dynamics predicts the total efforts of a motion, low-pass filtered as in the identification.
    In all other cases, the command predicts the holding efforts.

    Args:
        output: CSV file to write, with columns tau1..taun [N m; N if prismatic] in the coordinates of the recording.
            For a motion, it also contains the time t, and the columns lower1..lowern and upper1..uppern are the limits
            of the 95 % prediction interval. The columns lower_other_day1..n and upper_other_day1..n are those on
            another day than that of the model's recording.
    """
    from dvrk_drake.recordings.csv_files import write_csv
    from dvrk_drake.reports.terminal import make_console

    support.check_output(output, recording, model, overwrite=overwrite, suffix=".csv")
    with support.Steps(*_STEPS, "predicting") as steps:
        loaded, read = _model_and_recording(model, recording, file, steps)
        coordinates = read.file_coordinates or read.coordinates
        prediction = dvrk.predict(loaded, read, coordinates=coordinates, progress=steps)
    columns = {} if read.t is None else {"t": read.t}
    columns["tau"] = tau = prediction.tau
    for suffix, width in (("", prediction.half_width), ("_other_day", prediction.half_width_other_day)):
        if width is not None:
            columns |= {f"lower{suffix}": tau - width, f"upper{suffix}": tau + width}
    write_csv(output, columns, loaded.arm, {"coordinates": coordinates, "arm": loaded.arm.name})
    support.print_warnings(make_console(), prediction.warnings)
    support.print_written(output, f"{len(tau)} rows, {coordinates} coordinates")
    if prediction.half_width is not None:
        print(loaded.interval_scope, flush=True)


@options.identify.command
def recalibrate(
    recording: options.Recording,
    /,
    *,
    model: options.Model,
    output: NewModel,
    file: options.FileOptions = _FILE,
    overwrite: options.Overwrite = False,
    verbose: options.Verbose = False,
) -> None:
    """Refit the friction and offsets of a model to a short new motion.

    The result is valid only for similar motions, positions and speeds (docs/payload.md).
    """
    from dvrk_drake.reports.identification import recalibration_page

    support.check_output(output, recording, model, overwrite=overwrite)
    with support.Steps(*_STEPS, "refitting friction") as steps:
        result = dvrk.recalibrate(*_model_and_recording(model, recording, file, steps), progress=steps)
    result.save(output, overwrite=True)
    support.show_page(recalibration_page(result, model_path=output, file_options=file.as_text()), verbose=verbose)
    support.print_written(output)


@options.app.command(group=options.IDENTIFY)
def payload(
    recording: str,
    loaded: str | None = None,
    /,
    *,
    arm: Annotated[
        options.Arm | None, Parameter(group=_SOURCE, help="Identify the model of this arm from the first recording.")
    ] = None,
    model: Annotated[options.Model | None, Parameter(group=_SOURCE, help="Model identified from a motion.")] = None,
    link: Annotated[str | None, Parameter(metavar="NAME")] = None,
    file: options.FileOptions = _FILE,
    gravity: options.Gravity = None,
    locked: options.Locked = None,
    results: ResultsAndJson = _RESULTS,
) -> None:
    """Estimate the mass and centre of mass of a payload.

    The command compares two recordings of the same motion, one without and one with the payload. With --model and one
    recording, it compares the recording with the efforts of the model.

    Args:
        recording: Recording of the motion without the payload. If LOADED is not given: recording with the payload.
        loaded: Recording of the same motion with the payload.
        link: SDF link to which the payload is attached. Default: the link with the smallest cross-validated error.
    """
    from dvrk_drake.reports.payload import payload_page

    if model is not None and gravity is not None:
        raise ModelError("--gravity requires --arm; with --model, the gravity vector of the model is used")
    if model is not None and locked is not None:
        raise ModelError("--locked requires --arm; with --model, the locked joints of the model are used")
    if model is None and loaded is None:
        raise ModelError(
            "--arm requires two recordings, without and with the payload; with one recording, give --model"
        )
    paths = [recording] if loaded is None else [recording, loaded]
    results.check(*paths, model)
    identified = None if model is None else support.load_model(model, None)
    recorded_arm = support.mounted(dvrk.load_arm(arm or ""), gravity, locked) if identified is None else identified.arm
    with support.Steps(*_STEPS, *(["identifying"] if identified is None else []), "estimating") as steps:
        recordings = [file.read(path, recorded_arm, steps) for path in paths]
        for read in recordings:
            support.print_notes(read.source, read.notes)
        reference = recordings[0] if loaded else None
        result = dvrk.payload(reference, recordings[-1], identified or recorded_arm, link, progress=steps)
    options = file.as_text() + ("" if gravity is None else f" --gravity {' '.join(map(repr, gravity))}")
    page = payload_page(result, model_path=model, options=options)
    warnings = [warning for warning in result.warnings if warning.kind == "other link"]
    results.show(page, *paths, model, content=result.as_dicts(), warnings=warnings)


_VECTOR = Parameter(metavar="X Y Z")


@options.app.command(group=options.IDENTIFY)
def force(
    recording: options.Recording,
    /,
    *,
    model: options.Model,
    frame: Annotated[str, Parameter(metavar="NAME", show_default=False)] = "",
    point: Annotated[tuple[float, float, float], _VECTOR] = (0.0, 0.0, 0.0),
    axes: Literal["base", "frame"] = "base",
    direction: Annotated[tuple[float, float, float] | None, _VECTOR] = None,
    cannula: Annotated[bool, Parameter(show_default=False)] = False,
    same_day: Annotated[bool, Parameter(show_default=False)] = False,
    output: Annotated[str | None, Parameter(metavar="FILE.csv")] = None,
    file: options.FileOptions = _FILE,
    results: Results = _PAGE,
) -> None:
    """Estimate the force on a point of the arm over a recording.

    The force is estimated from the motor efforts that the model does not explain. Nothing else may touch the arm.

    Args:
        frame: Frame of the SDF in which the point is fixed. Default: the tip of an instrument, or the handle.
        point: Position of the point in the frame [m].
        axes: Axes of the force: those of the base or of the frame.
        direction: Direction of the force in these axes, if it is known.
        cannula: A cannula can exert an unknown axial force on the shaft.
        same_day: The model was identified on the day of the recording. Default: the intervals contain the assumed
            change of the efforts between days.
        output: CSV file to write, with columns force1..3 [N], or force1 with --direction, and the external joint
            efforts tau1..taun [N m; N if prismatic]. Columns with _lower, _upper, lower and upper are the limits of the
            95 % intervals. A force is nan in rows in which the arm cannot measure it.
    """
    from dvrk_drake.reports.external_force import force_page

    results.check(recording, model, output=output)
    with support.Steps(*_STEPS, "estimating the force") as steps:
        loaded, read = _model_and_recording(model, recording, file, steps)
        result = dvrk.estimate_force(
            read,
            loaded,
            frame=frame,
            point=point,
            axes=axes,
            direction=direction,
            cannula=cannula,
            same_day=same_day,
            progress=steps,
        )
    if output is not None:
        result.save(output, overwrite=True)
    page = force_page(result, model_path=model, file_options=file.as_text())
    results.show(page, recording, model, note=result.note, warnings=result.warnings, saved=output)
