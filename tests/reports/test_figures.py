"""Figures of identifications, validations and simulations keep the rules of the style, and show what they state."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from figure_rules import checked_figures, colours_of, figure_faults
from matplotlib.collections import LineCollection

from dvrk_drake.experiments.simulation import scenario_of_arm, simulate
from dvrk_drake.analysis.dynamic.validation import validate_motion
from dvrk_drake.analysis.static.excluded_measurements import ExcludedMeasurement
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.figures import colours, identification, motion, simulation
from dvrk_drake.reports.figures.style import WIDTH, add_legend, panel_grid, set_title

MTM = load_arm("mtml")


@pytest.mark.parametrize("count", range(1, 10))
def test_unused_panels_are_removed(count):
    figure, panels = panel_grid(count)
    assert len(figure.axes) == len(panels) == count
    assert figure.get_figwidth() == pytest.approx(WIDTH)
    plt.close(figure)


def test_rules_find_faults():
    figure, (one, two) = panel_grid(2)
    one.plot([0, 1], [0, 1], label="curve")
    one.set_xlabel("time", fontsize=7)
    one.legend()
    faults = " ".join(figure_faults(figure))
    for text in ("7", "no title", "is empty", "legend over the data", 'axis label "time" has no unit'):
        assert text in faults
    plt.close(figure)


def test_legend_has_each_label_once_and_is_outside_the_panels():
    figure, panels = panel_grid(7)
    for ax in panels:
        ax.plot([0, 1], [0, 1], label="a long label of a curve in all panels")
        ax.plot([0, 1], [1, 0], label="another long label of a curve in all panels")
    set_title(figure, "A long title " * 20)
    add_legend(figure)
    assert not figure_faults(figure)
    assert len(figure.legends[0].get_texts()) == 2
    plt.close(figure)


def poses(count=40):
    generator = np.random.default_rng(0)
    measured = generator.normal(size=(count, 7))
    return measured, measured + 0.1 * generator.normal(size=(count, 7))


def test_torque_errors_are_dots_with_intervals(monkeypatch, tmp_path):
    measured, predicted = poses()
    usable = np.ones(measured.shape, dtype=bool)
    rms, intervals = identification._errors_and_intervals({"zero torque": measured, "model": measured - predicted}, usable)
    for name, (lower, upper) in intervals.items():
        assert np.all((lower < rms[name]) & (rms[name] < upper))
    with checked_figures(monkeypatch) as figures:
        identification.plot_torque_error(
            tmp_path / "a.png", MTM, rms.pop("zero torque"), rms, "RMS torque error", intervals
        )
        identification.plot_torque_error(tmp_path / "b.png", MTM, np.zeros(7), {"model": np.full(7, np.nan)}, "No errors")
    axes = figures[0].axes[0]
    assert axes.get_xscale() == "log"
    assert not [patch for patch in axes.patches if patch.get_height() != 1.0]  # bands behind the joints, no bars
    assert len([c for c in axes.collections if isinstance(c, LineCollection)]) == 2


def test_outliers_do_not_determine_the_range_of_a_panel(monkeypatch, tmp_path):
    measured, predicted = poses()
    measured[3, 1], predicted[5, 2] = 1e3, -1e3
    excluded = [ExcludedMeasurement(3, (1,), "row 4", "outlier")]
    mask = np.ones(measured.shape, dtype=bool)
    mask[:, 6] = False
    with checked_figures(monkeypatch) as figures:
        identification.plot_measured_against_predicted(
            tmp_path / "a.png", MTM, measured, {"held out": (colours.HELD_OUT, predicted)}, mask, excluded, "Torques"
        )
    panels = figures[0].axes
    assert len(panels) == 6  # joint 7 has no measurements
    assert "J7" in figures[0].get_suptitle()
    assert all(np.ptp(ax.get_xlim()) < 20 for ax in panels)
    labels = {text.get_text() for text in figures[0].legends[0].get_texts()}
    assert {"excluded measurement", "margin: values outside the range"} <= labels
    for ax in panels:  # all points are inside the axes
        for line in ax.lines:
            assert np.all(line.get_xdata() >= ax.get_xlim()[0]) and np.all(line.get_xdata() <= ax.get_xlim()[1])


def test_simulation_shows_position_error_effort_and_disturbance(monkeypatch, tmp_path):
    start = np.zeros(7)
    scenario = scenario_of_arm(MTM, False, start, ())
    scenario.mounted_arm = MTM
    scenario.duration = 0.1
    done = simulate(MTM, effects=False, duration=0.1, start=start)
    done.hand[3:6] = 1.0
    with checked_figures(monkeypatch) as figures:
        simulation.plot_simulation(tmp_path / "a.png", done, scenario)
    axes = figures[0].axes
    assert len(axes) == 3 * 7
    assert [ax.get_ylabel().split(" [")[0] for ax in axes[:3]] == ["position", "error", "effort"]
    assert all(np.ptp(ax.get_ylim()) >= 0.0199 for ax in axes[::3])
    assert any("disturbance" in text.get_text() for text in figures[0].legends[0].get_texts())
    assert colours_of(figures[0])["measured position and effort"] == colours.MEASURED
