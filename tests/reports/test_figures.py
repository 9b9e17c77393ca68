"""Figures of identifications, validations and simulations keep the rules of the style, and show what they state."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from figure_rules import checked_figures, colours_of, figure_faults
from matplotlib.collections import LineCollection

from dvrk_drake.analysis.dynamic.validation import ActuatorError, DynamicValidation, ErrorShares
from dvrk_drake.analysis.static.excluded_measurements import ExcludedMeasurement
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports import colours
from dvrk_drake.reports.figures import identification, motion
from dvrk_drake.reports.figures.style import WIDTH, add_legend, panel_grid, set_title

MTM = load_arm("mtml")


@pytest.mark.parametrize("count", range(1, 10))
def test_unused_panels_are_removed(count):
    figure, panels = panel_grid(count)
    assert len(figure.axes) == len(panels) == count
    assert figure.get_figwidth() == pytest.approx(WIDTH)
    plt.close(figure)


def test_rules_find_faults():
    figure, panels = panel_grid(2)
    one = panels[0]
    one.plot([0, 1], [0, 1], label="curve")
    one.set_xlabel("time", fontsize=7)
    one.legend()
    figure.canvas.draw()
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
    figure.canvas.draw()
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
    rms, intervals = identification._errors_and_intervals(
        {"zero torque": measured, "model": measured - predicted}, usable
    )
    for name, (lower, upper) in intervals.items():
        assert np.all((lower < rms[name]) & (rms[name] < upper))
    with checked_figures(monkeypatch) as figures:
        identification.plot_torque_error(
            tmp_path / "a.png", MTM, rms.pop("zero torque"), rms, "RMS torque error", intervals
        )
        identification.plot_torque_error(
            tmp_path / "b.png", MTM, np.zeros(7), {"model": np.full(7, np.nan)}, "No errors"
        )
    axes = figures[0].axes[0]
    assert axes.get_xscale() == "log"
    assert not [patch for patch in axes.patches if patch.get_height() != 1.0]  # bands behind the joints, no bars
    assert len([c for c in axes.collections if isinstance(c, LineCollection)]) == 2


def test_outliers_do_not_determine_the_range_of_a_panel(monkeypatch, tmp_path):
    measured, predicted = poses()
    measured[3, 1], predicted[5, 2] = 1e3, -1e3
    excluded = [ExcludedMeasurement(row, (6,), f"row {row + 1}", "at its stop") for row in range(len(measured))]
    excluded.append(ExcludedMeasurement(3, (1,), "row 4", "outlier"))
    with checked_figures(monkeypatch) as figures:
        identification.plot_measured_against_predicted(
            tmp_path / "a.png", MTM, measured, {"held out": (colours.HELD_OUT, predicted)}, excluded, "Torques"
        )
    panels = figures[0].axes
    assert len(panels) == 6  # all measurements of joint 7 are excluded
    assert "J7" in figures[0].get_suptitle()
    assert all(np.ptp(ax.get_xlim()) < 20 for ax in panels)
    labels = {text.get_text() for text in figures[0].legends[0].get_texts()}
    assert {"excluded measurement", "margin: values outside the range"} <= labels
    for ax in panels:  # all points are inside the axes
        for line in ax.lines:
            assert np.all(line.get_xdata() >= ax.get_xlim()[0]) and np.all(line.get_xdata() <= ax.get_xlim()[1])


@pytest.fixture(scope="module")
def validation():
    """Returns a validation with errors from friction and noise."""
    arm, rng, t = load_arm("psm"), np.random.default_rng(0), np.arange(1200) / 100
    q = 0.3 * np.sin(2 * np.pi / 6.0 * (np.arange(7) % 3 + 1) * t[:, None] + np.arange(7))
    v = np.gradient(q, t, axis=0)
    predicted = np.sin(q) + 0.3 * np.sign(v)
    measured = predicted + 0.1 * np.sign(v) + 0.02 * rng.normal(size=q.shape)
    return DynamicValidation(
        model=IdentifiedModel.from_arm(arm),
        recording=Recording(q=q, qd=v, tau=measured, t=t, source="simulated"),
        actuators=[
            ActuatorError(name, 1.0, 0.1, 0.1, ErrorShares(0.0, 0.9, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0), 0.02, "good", 0.8)
            for name in arm.joint_names
        ],
        cut_off=15.0,
        t=t,
        q=q,
        v=v,
        vd=np.gradient(v, t, axis=0),
        period=6.0,
        measured=measured,
        predicted=predicted,
        grid=None,
    )


@pytest.mark.parametrize("is_fitted", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_motion_figures_show_held_out_predictions(validation, is_fitted, monkeypatch, tmp_path):
    held_out = validation.predicted * 0.9 if is_fitted else None
    with checked_figures(monkeypatch) as figures:
        motion.plot_motion(tmp_path, validation, held_out)
    efforts, residuals, budget = figures
    expected = {"measured": colours.MEASURED}
    if is_fitted:
        expected |= {"fitted": colours.FITTED, "held out (cross-validation)": colours.HELD_OUT}
    else:
        expected["held out (the motion was not used to fit)"] = colours.HELD_OUT
    assert colours_of(efforts) == expected
    assert len(efforts.axes) == len(residuals.axes) == 2 * 7
    # The measurement is drawn wider than the predictions, so that they do not hide it.
    measured, *predictions = efforts.axes[0].lines
    assert all(line.get_linewidth() < measured.get_linewidth() / 2 for line in predictions)
    # The bars have the lengths of the relative errors.
    lengths = np.array([sum(p.get_width() for p in budget.axes[0].patches[i::7]) for i in range(7)])
    predicted = validation.predicted if held_out is None else held_out
    error = np.sqrt(np.mean((validation.measured - predicted) ** 2, axis=0) / np.mean(validation.measured**2, axis=0))
    np.testing.assert_allclose(lengths, 100 * error, atol=1e-6)
