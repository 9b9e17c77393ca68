"""Plots the spectra of the efforts in a recording and of the noise in these efforts."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dvrk_drake.analysis.check.findings import RecordingReport
from dvrk_drake.analysis.signals.noise import spectra
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.figures.style import MEASURED_COLOUR, MODEL_COLOUR, ZERO_COLOUR, save_figure


def plot_report(folder: Path, report: RecordingReport, recording: Recording, arm: Arm) -> bool:
    """Writes spectra.png: the effort spectrum, the noise spectrum and the cut-off frequency of each joint.

    Above the cut-off frequency, the noise exceeds the effort signal. Rows are treated as evenly spaced in time, so the
    spectra of a motion with gaps are approximate.

    Returns:
        True if the file was written. False for static poses and for motions without efforts.
    """
    if report.rate is None or report.joints[0].effort_cut_off is None:
        return False
    tau = recording.in_actuator_coordinates(arm).measured_effort()
    of = spectra(tau, report.rate, report.period)
    noise = "noise (differs between periods)" if report.period is not None else "noise (estimated as white)"
    figure, axes = plt.subplots(2, -(-arm.num_joints // 2), figsize=(13, 6.5), layout="constrained", sharex=True)
    for j, (joint, ax) in enumerate(zip(report.joints, axes.flat, strict=False)):
        # Avoids the logarithm of zero.
        bottom = 0.1 * max(float(np.min(of.noise[1:, j])), 1e-12 * float(np.max(of.signal[:, j])), 1e-30)
        for density, colour, label in ((of.signal, MODEL_COLOUR, "signal"), (of.noise, MEASURED_COLOUR, noise)):
            ax.loglog(of.frequency[1:], np.maximum(density[1:, j], bottom), color=colour, label=label)
        ax.axvline(joint.effort_cut_off, color=ZERO_COLOUR, label="cut-off frequency")
        ax.set_title(f"J{j + 1} {joint.name}: cut-off {joint.effort_cut_off:.1f} Hz", fontsize=10)
        ax.set_ylabel(f"tau{j + 1} [({'N' if arm.prismatic[j] else 'N m'})$^2$/Hz]", fontsize=8)
        ax.set_xlabel("frequency [Hz]", fontsize=8)
        ax.tick_params(labelsize=7)
    for ax in axes.flat[arm.num_joints :]:
        ax.axis("off")
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="lower right", fontsize=8)
    figure.suptitle(f"{arm.name}: power spectral density of the actuator efforts, {Path(report.source).name}")
    save_figure(figure, folder / "spectra.png")
    return True
