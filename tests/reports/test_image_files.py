"""Plots as image files keep the rules of the style, and show what they state."""

import dataclasses
from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from figure_rules import checked_figures, colours_of, figure_faults

from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports import colours
from dvrk_drake.reports.colours import FITTED, MEASURED, SERIES
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


# Colours of roles and series are different for people with and without deuteranopia, and in a grey print.


ROLES = [value for name, value in vars(colours).items() if name.isupper() and isinstance(value, str)]
#: Linear RGB of a colour -> linear RGB that a deuteranope sees as the same colour. Machado, Oliveira and
#: Fernandes (2009), "A physiologically-based model for simulation of color vision deficiency", severity 1.0.
DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
#: Linear RGB -> XYZ (IEC 61966-2-1), and its white.
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = TO_XYZ.sum(axis=1)
#: Smallest colour difference Delta E (CIE 1976). A difference of 2.3 is just noticeable for adjacent areas. Thin lines
#: need about ten times this difference.
SMALLEST_DIFFERENCE = 30.0
#: Smallest difference of the lightness L*, for prints without colour.
SMALLEST_LIGHTNESS_DIFFERENCE = 6.0


def linear_rgb(colour):
    c = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """Returns L*, a*, b* (CIE 1976) of a colour in linear RGB."""
    x = TO_XYZ @ rgb / WHITE
    fx, fy, fz = np.where(x > 216 / 24389, np.cbrt(x), (24389 / 27 * x + 16) / 116)
    return np.array([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)])


def deuteranope(rgb):
    return np.clip(DEUTERANOPIA @ rgb, 0.0, 1.0)


@pytest.mark.parametrize("palette", [ROLES, SERIES], ids=["roles", "series"])
def test_all_colours_differ(palette):
    for one, other in combinations(palette, 2):
        a, b = linear_rgb(one), linear_rgb(other)
        assert np.linalg.norm(lab(a) - lab(b)) > SMALLEST_DIFFERENCE, (one, other)
        assert np.linalg.norm(lab(deuteranope(a)) - lab(deuteranope(b))) > SMALLEST_DIFFERENCE, (one, other)
        assert abs(lab(a)[0] - lab(b)[0]) > SMALLEST_LIGHTNESS_DIFFERENCE, (one, other)
