"""The tables of Fig. 5 and 6: drifts beside the published ones, errors of torque, drift rates without friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.reproduction.drift_experiment import SAMPLE_PERIOD, Drifts
from dvrk_drake.experiments.reproduction.laboratory import Laboratory
from dvrk_drake.experiments.reproduction.recordings import PAPER_ARM
from dvrk_drake.experiments.tuning.model_based import friction
from dvrk_drake.reports.reproduction.page import ResultTable, numbers

#: Over what a drift rate is taken [s].
RATE_TIME = 1.0
_JOINTS = tuple(f"J{j}" for j in range(1, 8))
_UNPUBLISHED = ("-",)


def drift_table(
    name: str,
    what: str,
    trial: Sequence[float],
    means: Sequence[float],
    paper: Drifts,
    ours: Drifts,
    led: Drifts | None = None,
    kept: Drifts | None = None,
) -> ResultTable:
    """Drifts of the paper\'s and of ours beside the published `trial` and `means` of joints 2-7 [rad].

    `led` and `kept`: ours when led there first, without and with its hysteresis compensated.
    """
    rows: tuple[tuple[str, ...], ...] = (
        ("published, the trial of the figure (final)", *_UNPUBLISHED, *numbers(np.abs(trial), "{:.4f}")),
        ("published, five trials (mean)", *_UNPUBLISHED, *numbers(means, "{:.4f}")),
        (f"the paper's, {len(paper.positions)} poses (mean)", *numbers(np.abs(paper.final).mean(axis=0), "{:.4f}")),
        (f"ours, {len(ours.positions)} poses (mean)", *numbers(np.abs(ours.final).mean(axis=0), "{:.4f}")),
        ("the paper's (largest at any time)", *_largest(paper)),
        ("ours (largest at any time)", *_largest(ours)),
        ("the paper's, share held", *_shares(paper)),
        ("ours, share held", *_shares(ours)),
    )
    if led is not None:
        rows += (
            (f"ours, led there, {len(led.positions)} poses (largest at any time)", *_largest(led)),
            ("ours, led there, share held", *_shares(led)),
        )
    if kept is not None:
        rows += (
            ("the same, hysteresis compensated (largest at any time)", *_largest(kept)),
            ("the same, hysteresis compensated, share held", *_shares(kept)),
        )
    return ResultTable(name, f"Absolute drift after release [rad], {what}", ("", *_JOINTS), rows)


def _largest(drifts: Drifts) -> tuple[str, ...]:
    return numbers(drifts.largest.max(axis=0), "{:.4f}")


def _shares(drifts: Drifts) -> tuple[str, ...]:
    return numbers(drifts.held.mean(axis=0), "{:.3f}")


def torque_table(laboratory: Laboratory) -> ResultTable:
    """How wrong the torques are over the joint box; the truth is known here."""
    mtm = laboratory.mtm
    q = laboratory.random_poses(PAPER_ARM, 500)
    true = mtm.truth.model.holding_torque(q)
    paper = IdentifiedModel.load(laboratory.paper_file).holding_torque(q)

    def rms(values: NDArray[np.float64]) -> tuple[str, ...]:
        return numbers(np.sqrt(np.mean(values**2, axis=0)), "{:.4f}")

    rows = (
        ("zero torque", *rms(true)),
        ("the paper's", *rms(paper - true)),
        ("ours", *rms(mtm.model.holding_torque(q) - true)),
        ("dry friction of the joint that can resist it", *numbers(friction(mtm.truth.arm)[0], "{:.4f}")),
    )
    return ResultTable("fig5_torques", "Why: RMS torque error over the joint box [N m]", ("", *_JOINTS), rows)


def rate_table(releases: dict[str, Drifts]) -> ResultTable:
    """How fast joints drift in the first and the last `RATE_TIME` of releases, by name."""
    window = round(RATE_TIME / SAMPLE_PERIOD)
    rows = []
    for label, drifts in releases.items():
        q = drifts.positions
        rate = np.abs(q[:, window:] - q[:, :-window]) / RATE_TIME
        rows.append((f"{label}: first second, median", *numbers(np.median(rate[:, 0], axis=0), "{:.3f}")))
        rows.append((f"{label}: last second, median", *numbers(np.median(rate[:, -1], axis=0), "{:.3f}")))
        rows.append((f"{label}: any second, largest", *numbers(rate.max(axis=(0, 1)), "{:.3f}")))
    title = "Friction switched off: mean drift rate of a second [rad/s]"
    return ResultTable("fig5_without_friction", title, ("", *_JOINTS), tuple(rows))
