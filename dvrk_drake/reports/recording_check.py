"""The check of a recording as tables in a terminal and as a figure: efforts and their noise over frequency."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console

from dvrk_drake.analysis.check.findings import RecordingReport
from dvrk_drake.analysis.signals.noise import spectra
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.figures import MEASURED_COLOUR, MODEL_COLOUR, ZERO_COLOUR, save_figure
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


def plot_report(folder: Path, report: RecordingReport, recording: Recording, arm: Arm) -> bool:
    """Writes spectra.png: one panel a joint, with the cut-off that follows.

    Rows are taken as evenly spaced; of a motion with gaps the spectra are rough.

    Returns:
        Whether it was written: poses, and motions without efforts, have no spectra.
    """
    if report.rate is None or report.joints[0].effort_cut_off is None:
        return False
    tau = recording.in_actuator_coordinates(arm).measured_effort()
    of = spectra(tau, report.rate, report.period)
    noise = "does not repeat" if report.period is not None else "white noise"
    figure, axes = plt.subplots(2, -(-arm.num_joints // 2), figsize=(13, 6.5), layout="constrained", sharex=True)
    for j, (joint, ax) in enumerate(zip(report.joints, axes.flat, strict=False)):
        # Without a bottom, a silent or a perfect effort has no logarithm.
        bottom = 0.1 * max(float(np.min(of.noise[1:, j])), 1e-12 * float(np.max(of.signal[:, j])), 1e-30)
        for density, colour, label in ((of.signal, MODEL_COLOUR, "signal"), (of.noise, MEASURED_COLOUR, noise)):
            ax.loglog(of.frequency[1:], np.maximum(density[1:, j], bottom), color=colour, label=label)
        ax.axvline(joint.effort_cut_off, color=ZERO_COLOUR, label="cut-off")
        ax.set_title(f"J{j + 1} {joint.name}: {joint.effort_cut_off:.1f} Hz", fontsize=10)
        ax.set_ylabel(f"tau{j + 1} [({'N' if arm.prismatic[j] else 'N m'})$^2$/Hz]", fontsize=8)
        ax.set_xlabel("frequency [Hz]", fontsize=8)
        ax.tick_params(labelsize=7)
    for ax in axes.flat[arm.num_joints :]:
        ax.axis("off")
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="lower right", fontsize=8)
    figure.suptitle(f"{arm.name}: efforts of the actuators, {Path(report.source).name}")
    save_figure(figure, folder / "spectra.png")
    return True
