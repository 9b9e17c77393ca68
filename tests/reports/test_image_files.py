"""Plots as image files keep the rules of the style, and show what they state."""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest
from figure_rules import checked_figures, colours_of, figure_faults

from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.colours import FITTED, MEASURED
from dvrk_drake.reports.image_files import WIDTH, draw_plot, write_images
from dvrk_drake.reports.page import Plot
from dvrk_drake.reports.plot import Curve, Panel
from dvrk_drake.reports.simulation import simulation_page

MTM = load_arm("mtml")


@pytest.mark.parametrize("count", [1, 2, 5])
def test_unused_panels_are_removed(count):
    panels = [Panel(f"J{k}", [Curve("curve", [0, 1], [0, 1], FITTED)], "t [s]", "q [rad]") for k in range(count)]
    figure = draw_plot(Plot("name", "caption", panels, columns=min(2, count)), "title")
    assert len(figure.axes) == count and figure.get_figwidth() == pytest.approx(WIDTH)
    plt.close(figure)


def test_logarithmic_axis_has_the_range_of_the_values():
    y = np.array([1e-6, 1e-4, 1e-2])
    panel = Panel("J1", [Curve("curve", [0, 1, 2], y, FITTED)], "t [s]", "error [1]", log_y=True)
    figure = draw_plot(Plot("name", "caption", [panel]), "title")
    low, high = figure.axes[0].get_ylim()
    assert 1e-7 < low <= y.min() and y.max() <= high < 1e-1
    plt.close(figure)


def test_rules_find_faults():
    figure, panels = plt.subplots(1, 2)
    panels[0].plot([0, 1], [0, 1], label="curve")
    panels[0].set_xlabel("time", fontsize=7)
    panels[0].legend()
    figure.canvas.draw()
    faults = " ".join(figure_faults(figure))
    for text in ("7", "no title", "is empty", "legend over the data", 'axis label "time" has no unit'):
        assert text in faults
    plt.close(figure)


def test_legend_has_each_label_once_and_is_outside_the_panels():
    curves = [Curve(f"a long label of a curve in all panels, {k}", [0, 1], [k, 1], FITTED) for k in range(3)]
    panels = [Panel(f"J{k}", curves, "t [s]", "q [rad]") for k in range(7)]
    figure = draw_plot(Plot("name", "A long caption " * 20, panels, columns=3), "title")
    figure.canvas.draw()
    assert not figure_faults(figure)
    assert len(figure.legends[0].get_texts()) == 3
    plt.close(figure)


def test_simulation_shows_position_error_effort_and_disturbance(monkeypatch, tmp_path):
    t, generator = np.arange(11) / 100, np.random.default_rng(0)
    q, noise = 0.1 * np.sin(t[:, None] + np.arange(7)), 1e-3 * generator.normal(size=(11, 7))
    hand = np.zeros((11, 6))
    hand[3:6] = 1.0
    recording = Recording(q=q + noise, qd=np.gradient(q, t, axis=0), tau=0.1 * q, t=t)
    done = Simulation(recording, np.hstack([q, q]), hand, desired=q)
    with checked_figures(monkeypatch) as figures:
        write_images(simulation_page(done, MTM), tmp_path)
        write_images(simulation_page(dataclasses.replace(done, desired=None), MTM), tmp_path)
    assert len(figures[1].axes) == 2 * 7  # no errors without desired positions
    axes = figures[0].axes
    assert len(axes) == 3 * 7
    assert [ax.get_ylabel().split(" [")[0] for ax in axes[:3]] == ["position", "error", "effort"]
    assert all(np.ptp(ax.get_ylim()) >= 0.0199 for ax in axes[::3])
    assert any("disturbance" in text.get_text() for text in figures[0].legends[0].get_texts())
    assert colours_of(figures[0])["measured position and effort"] == MEASURED
