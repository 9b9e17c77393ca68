"""Page of the check of a recording, with the spectra of its efforts and of their noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.report import RecordingReport
from dvrk_drake.analysis.observations.signals import spectra
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.colours import LIMIT, MEASURED, REFERENCE
from dvrk_drake.reports.page import Block, Level, Page, Plot, Section, Table, Text
from dvrk_drake.reports.plot import Curve, Guide, Panel, effort_unit, joint_label

#: Number of bins per octave of frequency. The power spectral densities are averaged in each bin.
_BINS_PER_OCTAVE = 4
#: Relative difference of the mean rate from the median rate above which both are printed. Clocks and jitter cause less.
_SAME_RATE = 0.01


def check_page(
    report: RecordingReport,
    *,
    source: str = "--arm ARM",
    is_model: bool = False,
    other_arm: str = "",
    recording: Recording | None = None,
    arm: Arm | None = None,
) -> Page:
    """Returns whether a recording is usable, the warnings, and the position range and effort of each joint.

    Refusals are not among the blocks, because the command prints them on stderr. docs/checking_a_recording.md defines
    all quantities.

    Args:
        report: Result of the check.
        source: --arm or --model with its value, and further options, for the suggested next command.
        is_model: Whether `source` is a model.
        other_arm: Value of --arm and options for another arm to which the recording probably belongs, or "".
        recording, arm: Recording and arm of the report, for the spectra. None: no spectra.
    """
    notes = [finding for finding in report.findings if finding.severity == "note"]
    blocks: list[Block] = [Text(str(finding), "warning", unwrapped=True) for finding in report.warnings]
    blocks += [Text(str(finding), show="details", unwrapped=True) for finding in notes]
    if notes:
        prints = f"{_count(len(notes), 'note')}: --verbose prints {'it' if len(notes) == 1 else 'them'}."
        blocks.append(Text(prints, show="brief"))
    signals = []
    if report.joints:
        blocks.append(_joint_table(report))
        signals = _signals(report) if report.joints[0].speed is not None else []
        if recording is not None and arm is not None and has_spectra(report):
            signals.append(_spectra(report, recording, arm))
    what = f"{report.rows} rows of {report.kind}"
    if report.longest and report.rate and report.duration:
        mean = (report.longest - 1) / report.duration
        what = f"motion of {report.rows} rows, "
        if report.longest < report.rows:
            what += f"of which {report.longest} without gaps of the times, "
        what += f"{report.duration:.2f} s at {report.rate:.4g} Hz"
        if abs(mean / report.rate - 1) > _SAME_RATE:
            what += f" (median; {mean:.4g} Hz on average, because rows are missing or times are irregular)"
    verdict, level, next_step = _verdict(report, source, is_model, other_arm)
    return Page(
        f"Check of {report.source}",
        f"Verdict: {verdict}. {report.arm}, {what}.",
        [Section("Joints", blocks), *([Section("Signals", signals)] if signals else [])],
        level,
        next_step,
    )


def has_spectra(report: RecordingReport) -> bool:
    """Returns whether spectra can be drawn: for a motion with efforts and time stamps."""
    return report.rate is not None and bool(report.joints) and report.joints[0].effort_cut_off is not None


def _verdict(report: RecordingReport, source: str, is_model: bool, other_arm: str) -> tuple[str, Level, str]:
    """Returns the verdict, its level and the suggested next command."""
    command = f"dvrk-drake identify {report.source} {source} --output MODEL.yaml"
    if is_model:
        command = f"dvrk-drake validate {report.source} {source}"
    verdict, found = "usable", report.warnings
    level: Level = "good"
    if report.refusals:
        verdict, level, found = "unusable", "bad", report.refusals
        again = f"--arm {other_arm}" if other_arm else source
        command = f"dvrk-drake check {report.source} {again}"
    elif report.warnings:
        verdict, level = f"usable with {_count(len(report.warnings), 'warning')}", "warning"
    kinds = ", ".join(dict.fromkeys(finding.kind for finding in found))
    return verdict + (f" ({kinds})" if kinds and kinds != verdict else ""), level, command


def _joint_table(report: RecordingReport) -> Table:
    header = ["", "range [rad; m]", "share of limits", "RMS effort [N m; N]", "peak / effort limit"]
    is_periodic = report.period is not None
    rows = []
    for joint in report.joints:
        cells = [f"{joint.range:.3f}", f"{100 * joint.coverage:.0f} %"]
        cells += [_number(joint.effort, "{:.4f}"), _number(joint.peak_effort, "{:.0f} %", 1e2)]
        rows.append((joint.name, *cells, *([_number(joint.floor, "{:.1f} %", 1e2)] if is_periodic else [])))
    header += ["repeatability"] if is_periodic else []
    return Table(header, rows, "Positions and efforts of the joints")


def _signals(report: RecordingReport) -> list[Block]:
    rows = [
        (
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
        for joint in report.joints
    ]
    note = ""
    if report.period is not None:
        floors = [joint.floor for joint in report.joints if joint.floor is not None and joint.floor == joint.floor]
        note = (
            f"Repeatability: rms(tau(t) - tau(t + {report.period:.4f} s)) / sqrt(2) / rms(tau), low-pass filtered at "
            f"{report.floor_cut_off:g} Hz. Mean: {100 * sum(floors) / len(floors):.1f} %."
        )
    header = ("", "v RMS", "vd RMS", "qd / dq/dt", "qd delay", "tau delay", "work", "tau cut-off", "qd cut-off")
    caption = "Signals of the actuators [rad, m, s; delays in ms, cut-offs in Hz]"
    return [Table(header, rows, caption, note, show="details")]


def _spectra(report: RecordingReport, recording: Recording, arm: Arm) -> Plot:
    """Returns the effort spectrum, the noise spectrum and the cut-off frequency of each joint.

    Above the cut-off frequency, the noise exceeds the effort signal. Rows are treated as evenly spaced in time, so the
    spectra of a motion with gaps are approximate.
    """
    assert report.rate is not None
    tau = recording.in_actuator_coordinates(arm).measured_effort()
    densities = spectra(tau, report.rate, report.period)
    noise_name = "noise (differs between periods)" if report.period is not None else "noise (estimated as white)"
    f, total = _averaged(densities.frequency, densities.signal + densities.noise)
    _, noise = _averaged(densities.frequency, densities.noise)
    panels = []
    for j, joint in enumerate(report.joints):
        assert joint.effort_cut_off is not None
        # Avoids the logarithm of zero.
        bottom = 0.1 * max(float(np.min(noise[:, j])), 1e-12 * float(np.max(total[:, j])), 1e-30)
        curves = [
            Curve(name, f, np.maximum(density[:, j], bottom), colour)
            for density, colour, name in ((total, MEASURED, "measured effort"), (noise, REFERENCE, noise_name))
        ]
        cut_off = Guide("x", joint.effort_cut_off, None, LIMIT, "cut-off frequency: noise exceeds signal")
        panels.append(
            Panel(
                f"{joint_label(arm, j)}, cut-off {joint.effort_cut_off:.1f} Hz",
                [*curves, cut_off],
                "frequency [Hz]",
                f"PSD of tau{j + 1} [({effort_unit(arm, j)})²/Hz]",
                log_x=True,
                log_y=True,
                height=200,
            )
        )
    caption = (
        "power spectral density (PSD) of the actuator efforts and of their noise, averaged over "
        f"1/{_BINS_PER_OCTAVE} octave"
    )
    if report.period is not None:
        caption += (
            f". The motion repeats every {report.period:.2f} s, so its effort has lines at multiples of "
            f"{1 / report.period:.3f} Hz, which the average merges"
        )
    return Plot("spectra", caption, panels, columns=2)


def _averaged(
    frequency: NDArray[np.float64], density: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns mean frequencies (b,) and mean densities (b, n) in bins of equal width on a logarithmic scale.

    The frequency 0 is omitted. Bins without a frequency are omitted.
    """
    f = frequency[1:]
    index = np.floor(_BINS_PER_OCTAVE * np.log2(f / f[0]) + 1e-9).astype(int)
    used = np.unique(index)
    return (
        np.array([np.exp(np.mean(np.log(f[index == k]))) for k in used]),
        np.array([density[1:][index == k].mean(axis=0) for k in used]),
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "-" if value is None or value != value else form.format(scale * value)
