"""Commands for recordings: samples, check and convert."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli.app import (
    IDENTIFY,
    Arm,
    FileOptions,
    Locked,
    Model,
    Overwrite,
    Recording,
    app,
    one_of,
)
from dvrk_drake.cli.report import ResultsAndJson
from dvrk_drake.cli.support import (
    Steps,
    check_output,
    load_model,
    mounted,
    new_folder,
    print_notes,
    print_written,
    suggest,
)
from dvrk_drake.errors import ModelError, RecordingError

if TYPE_CHECKING:
    from dvrk_drake.models.arm import Arm as LoadedArm
    from dvrk_drake.recordings.recording import Recording as LoadedRecording

_FILE = FileOptions()
_RESULTS = ResultsAndJson()
_SOURCE = one_of("Arm or its model (one is required)")


@app.command(group=IDENTIFY)
def samples(folder: str, /, *, overwrite: Overwrite = False) -> None:
    """Write sample recordings of simulated arms, as CSV and MCAP.

    Args:
        folder: Folder to write to, which must be new or empty.
    """
    from dvrk_drake.recordings.samples import SAMPLES

    target = new_folder(folder, overwrite=overwrite)
    with Steps("writing") as steps:
        files = dvrk.write_samples(target, overwrite=True, progress=steps)
    for file in files:
        print_written(file)
    suggest(f"dvrk-drake check {files[0]} --arm {SAMPLES[files[0].stem]}")


@app.command(group=IDENTIFY)
def check(
    recording: Recording,
    /,
    *,
    arm: Annotated[Arm | None, Parameter(group=_SOURCE)] = None,
    model: Annotated[
        Model | None, Parameter(group=_SOURCE, help="Model of the arm. A motion of another individual arm is reported.")
    ] = None,
    file: FileOptions = _FILE,
    locked: Locked = None,
    results: ResultsAndJson = _RESULTS,
) -> None:
    """Check a recording and report its problems.

    The exit code is 2 if the recording is not suitable for identification.
    """
    from dvrk_drake.models.locked_joints import locked_option
    from dvrk_drake.reports.recording_check import check_page, has_spectra

    if model is not None and locked is not None:
        raise ModelError("--locked requires --arm; with --model, the locked joints of the model are used")
    identified = None if model is None else load_model(model, None)
    recorded_arm = mounted(dvrk.load_arm(arm or ""), None, locked) if identified is None else identified.arm
    results.check(recording, model)
    with Steps("reading", "checking the recording") as steps:
        checked = file.read(recording, recorded_arm, steps)
        report = dvrk.check(checked, identified or recorded_arm, progress=steps)
    options = f"--arm {arm}{locked_option(recorded_arm)}" if model is None else f"--model {model}"
    other = _other_arm(checked, recorded_arm)
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
        print_notes(recording, ["no plots were written; spectra require a motion with efforts and time stamps"])
    for refusal in report.refusals[1:]:
        print(f"dvrk-drake: {refusal}", file=sys.stderr)
    if report.refusals:
        raise RecordingError(report.refusal)


def _other_arm(recording: LoadedRecording, arm: LoadedArm) -> str:
    """Returns the arm of a recording that is outside the limits of `arm`, "ARM" if several arms fit, "" if none."""
    from dvrk_drake.models.arm_files import known_arms

    def fits(tested: LoadedArm) -> bool:
        try:
            recording.check_fits(tested)
        except RecordingError:
            return False
        return True

    if arm.locked_joints or fits(arm):
        return ""
    fitting = [name for name in known_arms() if fits(dvrk.load_arm(name))]
    return fitting[0] if len(fitting) == 1 else "ARM" if fitting else ""


@app.command(group=IDENTIFY)
def convert(
    recording: Recording,
    /,
    *,
    output: Annotated[str, Parameter(metavar="FILE")],
    file: FileOptions = _FILE,
    arm: Annotated[str | None, Parameter(metavar="ARM")] = None,
    locked: Locked = None,
    overwrite: Overwrite = False,
) -> None:
    """Convert a recording to a CSV with a header, or to an MCAP bag.

    Args:
        output: File to write: .csv, or .mcap for ROS 2 tools, Foxglove and Rerun.
        arm: Convert to joint coordinates of this arm. Required for bags, LeRobot data sets and files of the cisst
            collector.
    """
    from dvrk_drake.recordings.writing import convert as convert_recording

    check_output(output, recording, overwrite=overwrite)
    if arm is None and locked is not None:
        raise RecordingError("--locked requires --arm")
    loaded = None if arm is None else mounted(dvrk.load_arm(arm), None, locked)
    with Steps("reading") as steps:
        converted = convert_recording(recording, output, arm=loaded, progress=steps, **file.as_arguments())
    print_written(output, f"{len(converted)} rows, {converted.coordinates} coordinates")
    for note in converted.notes:
        print(note)
