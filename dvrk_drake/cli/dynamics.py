"""What `identify` and `validate` do with a recording in which the arm moves."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from dvrk_drake.cli.support import ProgressBar, write_tables
from dvrk_drake.errors import RecordingError

if TYPE_CHECKING:
    from rich.console import Console

    from dvrk_drake.analysis.check.findings import RecordingReport
    from dvrk_drake.analysis.dynamic.validation import DynamicValidation
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import Arm
    from dvrk_drake.recordings.recording import Recording


def refuse_unusable(
    console: Console,
    recording: Recording,
    arm: Arm,
    warn: bool = False,
    apart_from: tuple[str, ...] = (),
    check: Callable[[Recording, Arm], RecordingReport] | None = None,
) -> list[str]:
    """Prints what `check` refuses in a recording, and its warnings if wanted, `apart_from` kinds of findings.

    `check` is `check_recording` by default.

    Returns:
        The warnings.

    Raises:
        RecordingError: it refuses anything.
    """
    from dvrk_drake.analysis.check.recording_check import check_recording

    with ProgressBar("checking the recording"):
        report = (check or check_recording)(recording, arm)
    findings = [f for f in report.findings if f.kind not in apart_from]
    for finding in findings:
        if finding.severity == "refusal" or (warn and finding.severity == "warning"):
            console.print(str(finding), style="yellow", markup=False, soft_wrap=True)
    if refusals := [finding for finding in findings if finding.severity == "refusal"]:
        first = refusals[0]
        raise RecordingError(f"{recording.source or 'recording'}: refused: {first.where}: {first.what}; {first.advice}")
    return [str(finding) for finding in findings if finding.severity == "warning"]


def _warn_unexplained(console: Console, errors: dict[str, float]) -> None:
    """Says which actuators' efforts are explained so badly (relative errors) that something else must be wrong."""
    from dvrk_drake.analysis.verdict import USABLE_RATIO_IN_MOTION

    if bad := [f"{name} ({error:.0%})" for name, error in errors.items() if error > USABLE_RATIO_IN_MOTION]:
        console.print(
            f"warning: {', '.join(bad)}: most of the effort is not explained; is a sign, a unit or --coordinates "
            "wrong, or is it another arm? Do not use the model for these",
            style="yellow",
            markup=False,
            soft_wrap=True,
        )


def identify_motion(options: argparse.Namespace, recording: Recording, arm: Arm, plots: Path | None) -> None:
    """Identifies the dynamics, prints them in short, writes the model, all tables and the plots."""
    from dvrk_drake.analysis.dynamic.dynamic_identification import identify_dynamic
    from dvrk_drake.analysis.dynamic.validation import validate_motion
    from dvrk_drake.reports.dynamic_identification import print_dynamics
    from dvrk_drake.reports.terminal_tables import make_console

    console = make_console()
    with ProgressBar("identifying") as (progress, task):
        result = identify_dynamic(recording, arm, lambda share: progress.update(task, completed=100 * share))
    print_dynamics(console, result)
    dynamics = result.model.dynamics
    assert dynamics is not None
    errors = {a.name: a.rms_cross_validation / a.rms_effort for a in dynamics.actuators if a.rms_effort > 0}
    _warn_unexplained(console, errors)
    result.model.save(options.output)
    console.print(f"model: {options.output}")
    if options.tables is not None:
        write_tables(options.tables, lambda file: print_dynamics(file, result, full=True))
        console.print(f"all parameters: {options.tables}")
    if plots is not None:
        from dvrk_drake.reports.dynamic_identification import plot_motion

        title = f"{arm.name}, fitted to {Path(recording.source).name}"
        plot_motion(plots, arm, validate_motion(result.model, recording), title)
        console.print(f"plots: {options.plots}")


def show_motion_validation(
    options: argparse.Namespace, validation: DynamicValidation, model: IdentifiedModel, source: str, plots: Path | None
) -> None:
    """Writes the JSON of a dynamic model compared with a motion, prints verdicts and errors, writes the plots."""
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.dynamic_identification import print_dynamic_validation
    from dvrk_drake.reports.terminal_tables import make_console

    console = make_console()
    if options.json is not None:
        with atomic_write(options.json) as stream:
            json.dump(validation.as_dict(), stream, indent=2)
            stream.write("\n")
    print_dynamic_validation(console, validation)
    bad = (a for a in validation.actuators if a.verdict == "do not use")
    errors = {a.name: a.relative_error for a in bad if a.relative_error is not None}
    _warn_unexplained(console, errors)
    if plots is not None:
        from dvrk_drake.reports.dynamic_identification import plot_motion

        arm = model.load_arm()
        plot_motion(plots, arm, validation, f"{arm.name}, {Path(source).name}")
        console.print(f"plots: {options.plots}")
