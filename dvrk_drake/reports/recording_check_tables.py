"""The check of a recording in a terminal."""

from __future__ import annotations

from rich.console import Console

from dvrk_drake.analysis.check.findings import RecordingReport
from dvrk_drake.reports.terminal_tables import make_table

_STYLES = {"refusal": "red", "warning": "yellow", "note": ""}


def print_report(console: Console, report: RecordingReport) -> None:
    """One line a finding, then the numbers of each joint; docs/checking_a_recording.md defines them."""
    console.print(f"{report.source}: {report.arm}, {_what(report)}\n", markup=False, soft_wrap=True)
    for finding in report.findings:
        console.print(str(finding), style=_STYLES[finding.severity], markup=False, soft_wrap=True)
    if not report.findings:
        console.print("nothing to report")
    if not report.joints:
        return
    console.print()
    table = make_table(
        "Positions [rad; m] and efforts [N m; N]", "", "range", "of its limits", "effort RMS", "peak of limit"
    )
    for joint in report.joints:
        peak = _number(joint.peak_effort, "{:.0%}")
        table.add_row(joint.name, f"{joint.range:.3f}", f"{joint.coverage:.0%}", _number(joint.effort, "{:.4f}"), peak)
    console.print(table)
    if report.joints[0].speed is None:
        return
    columns = ["v RMS", "vd RMS", "qd / dq/dt", "qd late", "tau late", "work", "tau cut-off", "qd cut-off"]
    floor = [] if report.period is None else ["floor"]
    table = make_table("Signals of the actuators [rad/s; m/s, ms, Hz]", "", *columns, *floor)
    for joint in report.joints:
        cells = [
            _number(joint.speed, "{:.3f}"),
            _number(joint.acceleration, "{:.2f}"),
            _number(joint.velocity_gain, "{:.3f}"),
            _number(joint.velocity_lag, "{:.1f}", 1e3),
            _number(joint.effort_lag, "{:.1f}", 1e3),
            _number(joint.work, "{:+.2f}"),
            _number(joint.effort_cut_off, "{:.1f}"),
            _number(joint.velocity_cut_off, "{:.1f}"),
        ]
        table.add_row(joint.name, *cells, *([_number(joint.floor, "{:.1%}")] if floor else []))
    console.print(table)
    if report.period is not None:
        floors = [joint.floor for joint in report.joints if joint.floor is not None]
        console.print(
            f"floor: rms(tau(t) - tau(t + {report.period:.4f} s)) / sqrt(2) / rms(tau), below "
            f"{report.floor_cut_off:g} Hz; mean {sum(floors) / len(floors):.1%}",
            style="dim",
            soft_wrap=True,
        )


def _what(report: RecordingReport) -> str:
    if report.rate is None or report.duration is None:
        return f"{report.rows} rows of {report.kind}"
    return f"a motion of {report.rows} rows, {report.duration:.2f} s at {report.rate:.4g} Hz"


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "-" if value is None or value != value else form.format(scale * value)
