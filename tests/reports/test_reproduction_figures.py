"""Figures of the reproduction keep the rules of the style, for drifts and step responses with known properties."""

import numpy as np
import pytest
from figure_rules import checked_figures

from dvrk_drake.experiments.reproduction import published
from dvrk_drake.experiments.reproduction.drift_experiment import BAND, Drifts
from dvrk_drake.experiments.reproduction.step_response import PERIOD
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.reproduction import drift, step_response


def drifts(name, size):
    """Returns ten releases with linear drifts. The largest drifts are between `size` / 10 and `size`."""
    sizes = size * np.linspace(0.1, 1.0, 10)
    return Drifts(load_arm(name), sizes[:, None, None] * np.linspace(0, 1, 50)[:, None] * np.ones(7))


def test_drift_figures_name_the_joints(monkeypatch, tmp_path):
    ours, paper = drifts("mtml", 0.01), drifts("mtml", 0.3)
    with checked_figures(monkeypatch) as figures:
        captions = drift._plots(
            tmp_path, "fig5", "all torques on", ours, paper, published.FIGURE_5, published.FIGURE_5_MEANS
        )
    assert set(captions) == {"fig5_time.png", "fig5_distribution.png"} == {p.name for p in tmp_path.iterdir()}
    for figure in figures:
        assert [ax.get_title() for ax in figure.axes][:2] == ["J1 outer_yaw", "J2 shoulder_pitch"]
        assert len(figure.axes) == 7


@pytest.mark.parametrize("name", ["mtml", pytest.param("psm", marks=pytest.mark.slow)])
def test_distributions_have_one_range_for_all_joints(name, monkeypatch, tmp_path):
    released = drifts(name, 0.02)
    with checked_figures(monkeypatch) as figures:
        drift.plot_largest_drifts(tmp_path / "a.png", "test", {"ours": (drift.FITTED, released)})
    panels = figures[0].axes
    assert len({ax.get_xlim() for ax in panels}) == 1
    for j, ax in enumerate(panels):
        sizes, shares = ax.lines[0].get_xdata(), ax.lines[0].get_ydata()
        band = released.arm.per_joint(*BAND)[j]
        assert shares[sizes <= band].max(initial=0.0) == pytest.approx(100 * released.held[:, j].mean(), abs=1e-9)


def test_figure_7_shows_ours_first(monkeypatch, tmp_path):
    t = PERIOD * np.arange(2000)
    q = np.exp(-t)[:, None] * np.ones(7)
    with checked_figures(monkeypatch) as figures:
        step_response._plot(tmp_path / "a.png", q, q[:1000])
    assert figures[0].axes[0].get_title().startswith("ours")
    labels = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert "J7 wrist_roll" in labels and "target" in labels
