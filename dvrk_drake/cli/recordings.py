"""Commands for recordings: samples, check and convert."""

from __future__ import annotations

import sys
from typing import Annotated

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.cli.support import ResultsAndJson
from dvrk_drake.errors import ModelError, RecordingError

_FILE = options.FileOptions()
_RESULTS = ResultsAndJson()
_SOURCE = options.one_of("Arm or its model (one is required)")


@options.app.command(group=options.IDENTIFY)
def samples(folder: str, /, *, overwrite: options.Overwrite = False) -> None:
    """Write sample recordings of simulated arms, as CSV and MCAP.

    Args:
        folder: Folder to write to, which must be new or empty.
    """
    from dvrk_drake.recordings.formats import SAMPLES

    target = support.new_folder(folder, overwrite=overwrite)
    with support.Steps("writing") as steps:
        files = dvrk.write_samples(target, overwrite=True, progress=steps)
    for file in files:
        support.print_written(file)
    support.suggest(f"dvrk-drake check {files[0]} --arm {SAMPLES[files[0].stem]}")


@options.app.command(group=options.IDENTIFY)
def check(
    recording: options.Recording,
    /,
    *,
    arm: Annotated[options.Arm | None, Parameter(group=_SOURCE)] = None,
    model: Annotated[
        options.Model | None,
        Parameter(group=_SOURCE, help="Model of the arm. A motion of another individual arm is reported."),
    ] = None,
    file: options.FileOptions = _FILE,
    locked: options.Locked = None,
    results: ResultsAndJson = _RESULTS,
) -> None:
    """Check a recording and report its problems.

    The exit code is 2 if the recording is not suitable for identification.
    """
    from dvrk_drake.analysis.check.recording_check import other_arm
    from dvrk_drake.models.locked_joints import locked_option
    from dvrk_drake.reports.recording_check import check_page, has_spectra

    if model is not None and locked is not None:
        raise ModelError("--locked requires --arm; with --model, the locked joints of the model are used")
    identified = None if model is None else support.load_model(model, None)
    recorded_arm = support.mounted(dvrk.load_arm(arm or ""), None, locked) if identified is None else identified.arm
    results.check(recording, model)
    with support.Steps("reading", "checking the recording") as steps:
        checked = file.read(recording, recorded_arm, steps)
        report = dvrk.check(checked, identified or recorded_arm, progress=steps)
    options = f"--arm {arm}{locked_option(recorded_arm)}" if model is None else f"--model {model}"
    other = other_arm(checked, recorded_arm)
    page = check_page(
        report,
        source=options + file.as_text(),
        is_model=model is not None,
        other_arm=f"{other}{file.as_text()}" if other else "",
        recording=None if results.plots is None else checked,
        arm=recorded_arm,
    )
    results.show(page, recording, model, content=report.as_dict())
    if results.plots is not None and not has_spectra(report):
        support.print_notes(recording, ["no plots were written; spectra require a motion with efforts and time stamps"])
    for refusal in report.refusals[1:]:
        print(f"dvrk-drake: {refusal}", file=sys.stderr)
    if report.refusals:
        raise RecordingError(report.refusal)


@options.app.command(group=options.IDENTIFY)
def convert(
    recording: options.Recording,
    /,
    *,
    output: Annotated[str, Parameter(metavar="FILE")],
    file: options.FileOptions = _FILE,
    arm: Annotated[str | None, Parameter(metavar="ARM")] = None,
    locked: options.Locked = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Convert a recording to a CSV with a header, or to an MCAP bag.

    Args:
        output: File to write: .csv, or .mcap for ROS 2 tools, Foxglove and Rerun.
        arm: Convert to joint coordinates of this arm. Required for bags, LeRobot data sets and files of the cisst
            collector.
    """
    from dvrk_drake.recordings.formats import convert as convert_recording

    support.check_output(output, recording, overwrite=overwrite)
    if arm is None and locked is not None:
        raise RecordingError("--locked requires --arm")
    loaded = None if arm is None else support.mounted(dvrk.load_arm(arm), None, locked)
    with support.Steps("reading") as steps:
        converted = convert_recording(recording, output, arm=loaded, progress=steps, **file.as_arguments())
    support.print_written(output, f"{len(converted)} rows, {converted.coordinates} coordinates")
    for note in converted.notes:
        print(note)
