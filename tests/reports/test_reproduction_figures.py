"""Figures of the reproduction keep the rules of the style, for drifts and step responses with known properties."""

import numpy as np
import pytest
from figure_rules import checked_figures

from dvrk_drake.experiments.reproduction import published
from dvrk_drake.experiments.reproduction.drift_experiment import BAND, Drifts
from dvrk_drake.experiments.reproduction.step_response import PERIOD
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.page import Page, Section
from dvrk_drake.reports.reproduction import drift, step_response


def drifts(name, size):
    """Returns ten releases with linear drifts. The largest drifts are between `size` / 10 and `size`."""
    sizes = size * np.linspace(0.1, 1.0, 10)
    return Drifts(load_arm(name), sizes[:, None, None] * np.linspace(0, 1, 50)[:, None] * np.ones(7))


def test_drift_plots_name_the_joints():
    ours, paper = drifts("mtml", 0.01), drifts("mtml", 0.3)
    plots = drift._plots("fig5", "all torques on", ours, paper, published.FIGURE_5, published.FIGURE_5_MEANS)
    assert [plot.name for plot in plots] == ["fig5_time", "fig5_distribution"]
    for plot in plots:
        assert [panel.title for panel in plot.panels][:2] == ["J1 outer_yaw", "J2 shoulder_pitch"]
        assert len(plot.panels) == 7


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_distributions_have_one_range_for_all_joints(name, monkeypatch, tmp_path):
    released = drifts(name, 0.02)
    plot = drift.largest_drifts_plot("drifts", "test", {"ours": (drift.FITTED, released)})
    assert len({panel.x_range for panel in plot.panels}) == 1
    for j, panel in enumerate(plot.panels):
        curve = panel.marks[0]
        band = released.arm.per_joint(*BAND)[j]
        held = curve.y[curve.x <= band].max(initial=0.0)
        assert held == pytest.approx(100 * released.held[:, j].mean(), abs=1e-9)
    with checked_figures(monkeypatch):
        write_images(Page("Reproduction", "", [Section("", [plot])]), tmp_path)


def test_figure_7_shows_ours_first():
    t = PERIOD * np.arange(2000)
    q = np.exp(-t)[:, None] * np.ones(7)
    plot = step_response._plot(q, q[:1000])
    assert plot.panels[0].title.startswith("ours")
    assert {"J7 wrist_roll", "target"} <= {mark.name for mark in plot.panels[0].marks}
