"""Plots the spectra of the efforts in a recording and of the noise in these efforts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.check.findings import RecordingReport
from dvrk_drake.analysis.observations.noise import spectra
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.figures.colours import LIMIT, MEASURED, REFERENCE
from dvrk_drake.reports.figures.style import add_legend, effort_unit, joint_title, panel_grid, save_figure, set_title

#: Number of bins per octave of frequency. The power spectral densities are averaged in each bin.
_BINS_PER_OCTAVE = 4


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
    densities = spectra(tau, report.rate, report.period)
    noise_label = "noise (differs between periods)" if report.period is not None else "noise (estimated as white)"
    f, total = _averaged(densities.frequency, densities.signal + densities.noise)
    _, noise = _averaged(densities.frequency, densities.noise)
    figure, panels = panel_grid(arm.num_joints, height=2.8, sharex=True)
    for j, (joint, ax) in enumerate(zip(report.joints, panels, strict=True)):
        assert joint.effort_cut_off is not None
        # Avoids the logarithm of zero.
        bottom = 0.1 * max(float(np.min(noise[:, j])), 1e-12 * float(np.max(total[:, j])), 1e-30)
        for density, colour, label in ((total, MEASURED, "measured effort"), (noise, REFERENCE, noise_label)):
            ax.loglog(f, np.maximum(density[:, j], bottom), color=colour, label=label)
        ax.axvline(joint.effort_cut_off, color=LIMIT, linestyle="--", label="cut-off frequency: noise exceeds signal")
        ax.set_title(f"{joint_title(arm, j)}\ncut-off {joint.effort_cut_off:.1f} Hz")
        ax.set_ylabel(f"PSD of tau{j + 1} [({effort_unit(arm, j)})$^2$/Hz]")
        ax.set_xlabel("frequency [Hz]")
    explanation = f"Averaged over 1/{_BINS_PER_OCTAVE} octave."
    if report.period is not None:
        explanation += (
            f" The motion repeats every {report.period:.2f} s, so its effort has lines at multiples of "
            f"{1 / report.period:.3f} Hz, which the average merges."
        )
    set_title(
        figure,
        f"{arm.name}, {Path(report.source).name}: power spectral density (PSD) of the actuator efforts and of their "
        f"noise\n{explanation}",
    )
    add_legend(figure)
    save_figure(figure, folder / "spectra.png")
    return True


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
