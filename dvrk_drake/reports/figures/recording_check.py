"""Figure of a recording: spectra of its efforts and of their noise."""

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
