"""Prints the check of a recording to a terminal."""

from __future__ import annotations

from rich.console import Console

from dvrk_drake.analysis.check.findings import RecordingReport
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note

_STYLES = {"refusal": "red", "warning": "yellow", "note": ""}


def print_report(
    console: Console,
    report: RecordingReport,
    *,
    source: str = "--arm ARM",
    is_model: bool = False,
    other_arm: str = "",
    verbose: bool = False,
) -> None:
    """Prints whether a recording is usable, the warnings, and the position range and effort of each joint.

    Refusals are not printed, because the command prints them on stderr. docs/checking_a_recording.md defines all
    quantities.

    Args:
        console: Console to print to.
        report: Report to print.
        source: --arm or --model with its value, and further options, for the suggested next command.
        is_model: Whether `source` is a model.
        other_arm: Value of --arm and options for another arm to which the recording probably belongs, or "".
        verbose: Whether to print the notes, and the signal properties of each actuator.
    """
    _print_verdict(console, report, source, is_model, other_arm)
    notes = [finding for finding in report.findings if finding.severity == "note"]
    for finding in [*report.warnings, *(notes if verbose else [])]:
        console.print(str(finding), style=_STYLES[finding.severity], markup=False, soft_wrap=True)
    if notes and not verbose:
        console.print(f"{_count(len(notes), 'note')}: --verbose prints {'it' if len(notes) == 1 else 'them'}.")
    if report.warnings or notes:
        console.print()
    if not report.joints:
        return
    _print_joints(console, report)
    if verbose and report.joints[0].speed is not None:
        console.print()
        _print_signals(console, report)


def _print_verdict(console: Console, report: RecordingReport, source: str, is_model: bool, other_arm: str) -> None:
    what = f"{report.rows} rows of {report.kind}"
    if report.rate is not None and report.duration is not None:
        what = f"motion of {report.rows} rows, {report.duration:.2f} s at {report.rate:.4g} Hz"
    next_command = f"dvrk-drake identify {report.source} {source} --output MODEL.yaml"
    if is_model:
        next_command = f"dvrk-drake validate {report.source} {source}"
    verdict, style, found = "usable", "green", report.warnings
    if report.refusals:
        verdict, style, found = "unusable", "red", report.refusals
        again = f"--arm {other_arm}" if other_arm else source
        next_command = f"dvrk-drake check {report.source if other_arm else 'OTHER.csv'} {again}"
    elif report.warnings:
        verdict, style = f"usable with {_count(len(report.warnings), 'warning')}", "yellow"
    kinds = ", ".join(dict.fromkeys(finding.kind for finding in found))
    verdict += f" ({kinds})" if kinds and kinds != verdict else ""
    print_answer(console, f"Verdict: {verdict}. {report.arm}, {what}.", next_command, style)


def _print_joints(console: Console, report: RecordingReport) -> None:
    columns = ("", "range [rad; m]", "share of limits", "RMS effort [N m; N]", "peak / effort limit")
    periodic = report.period is not None
    table = make_table("Positions and efforts of the joints", *columns, *(["repeatability"] if periodic else []))
    for joint in report.joints:
        cells = [f"{joint.range:.3f}", f"{100 * joint.coverage:.0f} %"]
        cells += [_number(joint.effort, "{:.4f}"), _number(joint.peak_effort, "{:.0f} %", 1e2)]
        table.add_row(joint.name, *cells, *([_number(joint.floor, "{:.1f} %", 1e2)] if periodic else []))
    console.print(table)


def _print_signals(console: Console, report: RecordingReport) -> None:
    columns = ("v RMS", "vd RMS", "qd / dq/dt", "qd delay", "tau delay", "work", "tau cut-off", "qd cut-off")
    table = make_table("Signals of the actuators [rad, m, s; delays in ms, cut-offs in Hz]", "", *columns)
    for joint in report.joints:
        table.add_row(
            joint.name,
            _number(joint.speed, "{:.3f}"),
            _number(joint.acceleration, "{:.2f}"),
            _number(joint.velocity_gain, "{:.3f}"),
            _number(joint.velocity_lag, "{:.1f}", 1e3),
            _number(joint.effort_lag, "{:.1f}", 1e3),
            _number(joint.work, "{:+.2f}"),
            _number(joint.effort_cut_off, "{:.1f}"),
            _number(joint.velocity_cut_off, "{:.1f}"),
        )
    console.print(table)
    if report.period is not None:
        floors = [joint.floor for joint in report.joints if joint.floor is not None and joint.floor == joint.floor]
        print_note(
            console,
            f"Repeatability: rms(tau(t) - tau(t + {report.period:.4f} s)) / sqrt(2) / rms(tau), low-pass filtered at "
            f"{report.floor_cut_off:g} Hz. Mean: {100 * sum(floors) / len(floors):.1f} %.",
        )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "-" if value is None or value != value else form.format(scale * value)
