"""Page of identify and validate: numbers in tables and plots, options of the commands, page in a browser."""

from importlib.resources import files

import numpy as np
import pytest
from command_output import refused
from figure_rules import checked_figures
from report_checks import check_report

import dvrk_drake as dvrk
from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.analysis.validation import baseline_efforts
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.models.effects_schema import half_width
from dvrk_drake.reports.efforts import MAX_ROWS, bin_means, budget_of, budget_plot, efforts_of, efforts_plot
from dvrk_drake.reports.html_file import write_report
from dvrk_drake.reports.identification import identification_page
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.page import Plot, Scene, Table
from dvrk_drake.reports.parameters import estimate_cells, interval, parameter_blocks
from dvrk_drake.reports.playback import MAX_FRAMES, MAX_RATE, frame_times
from dvrk_drake.reports.plot import Bars, Curve, axis_range, decimated

SAMPLES = files("dvrk_drake") / "samples"
TITLES = [
    "Verdict per joint",
    "Measured and predicted efforts",
    "Residuals",
    "Error budget",
    "Data quality",
    "Friction and cable curves",
    "Parameters and physical consistency",
]


def sample(name, arm):
    return dvrk.read_recording(SAMPLES / name, arm)


@pytest.fixture(scope="module")
def motion():
    """Validation of the PSM's nominal model on the sample motion."""
    arm = dvrk.load_arm("psm")
    return dvrk.validate(dvrk.IdentifiedModel.from_arm(arm, dynamics=True), sample("psm_motion.csv", arm))


@pytest.fixture(scope="module")
def poses():
    """Identification of an MTM from the sample poses, by the least squares of the paper."""
    arm = dvrk.load_arm("mtmr")
    return identify_static(sample("mtm_poses.csv", arm), arm, "paper")


def blocks(page, kind):
    return [block for block in page.blocks if isinstance(block, kind)]


@pytest.mark.parametrize("case", ["motion", "poses"])
def test_sections_are_in_order(case, request):
    result = request.getfixturevalue(case)
    page = identification_page(result, model_path="own.yaml")
    titles = [section.title for section in page.sections]
    assert titles == [title for title in TITLES if title in titles] and len(titles) >= 6
    assert "own.yaml" in page.next_step or "dvrk-drake check" in page.next_step
    assert blocks(page, Scene)
    table = blocks(page, Table)[0]
    assert table.header[:2] == ("joint", "verdict")
    assert len({plot.name for plot in blocks(page, Plot)}) == len(blocks(page, Plot))


@pytest.mark.parametrize("case", ["motion", "poses"])
def test_errors_of_other_models_are_shown_beside_the_new_ones(case, request):
    result = request.getfixturevalue(case)
    found = baseline_efforts(result, result.model)
    assert found.keys() == {"SDF", "previous"}
    efforts = efforts_of(result, found)
    last = "predicted" if case == "motion" else "fitted"
    scaled = case == "motion"  # the fit of the paper has no feedforward scales
    np.testing.assert_allclose(found["previous"], efforts.predicted[last], atol=1e-9 if scaled else 1e-6)
    table = blocks(identification_page(result, baselines=found), Table)[0]
    column = table.header.index("SDF error")
    ratios = efforts.rms_of_baseline("SDF") / efforts.rms(efforts.measured)
    shown = [float(row[column].removesuffix(" %")) for row in table.rows if row[0] != "mean"]
    np.testing.assert_allclose(shown, 100 * ratios if case == "motion" else ratios, atol=0.06)


def test_previous_model_of_another_arm_is_rejected(poses):
    with pytest.raises(dvrk.DvrkDrakeError, match="the previous model belongs to PSM, the recording to MTMR"):
        baseline_efforts(poses, dvrk.IdentifiedModel.from_arm(dvrk.load_arm("psm")))


def test_plotted_residual_is_measured_minus_predicted(motion):
    efforts = efforts_of(motion)
    panels = efforts_plot(efforts).panels
    for i in range(efforts.arm.num_joints):
        own = {mark.name: mark for mark in panels[2 * i].marks}
        (residual,) = (mark for mark in panels[2 * i + 1].marks if isinstance(mark, Curve))
        np.testing.assert_allclose(residual.y, own["measured"].y - own["predicted"].y, atol=1e-12)
        assert len(residual.y) <= MAX_ROWS
        assert own["measured"].y.max() == efforts.measured[:, i].max()


def test_plotted_poses_are_the_predictions_of_the_model(poses):
    efforts = efforts_of(poses)
    tau = poses.model.holding_torque(poses.recording.q)
    for j, panel in enumerate(efforts_plot(efforts).panels[::2]):
        (curve,) = (mark for mark in panel.marks if mark.name == "fitted")
        np.testing.assert_allclose(curve.y, tau[efforts.usable[:, j], j], atol=1e-9)
    assert efforts_plot(efforts).panels[-1].x_label == f"pose, 1 to {len(tau)} [1]"


def test_decimation_keeps_the_smallest_and_the_largest_value():
    values = np.random.default_rng(0).normal(size=1003)
    rows = decimated(values, 40)
    assert values[rows].min() == values.min() and values[rows].max() == values.max()
    assert len(rows) <= 2 * 26 and np.all(np.diff(rows) > 0)
    np.testing.assert_array_equal(decimated(values, 1), np.arange(1003))


def test_bin_means_of_a_line():
    x = np.random.default_rng(0).uniform(-1, 2, 5000)
    center, mean, deviation = bin_means(x, 3 * x + 1)
    np.testing.assert_allclose(mean, 3 * center + 1, atol=1e-12)
    assert len(center) == 25 and np.all(np.diff(center) > 0) and np.all(deviation < 3 * 0.1)
    center, mean, _ = bin_means(np.zeros(50), np.arange(50.0))  # a joint that does not move
    assert center.tolist() == [0.0] and mean.tolist() == [24.5]


@pytest.mark.parametrize("case", ["motion", "poses"])
def test_shares_of_the_error_budget(case, request):
    efforts = efforts_of(request.getfixturevalue(case))
    budgets = budget_of(efforts)
    for name, shares in budgets.items():
        assert sum(shares.values()) == pytest.approx(1.0, abs=1e-6), name
    (panel,) = budget_plot(efforts).panels
    drawn = sum(np.asarray(bar.values) for bar in panel.marks if isinstance(bar, Bars))
    relative = 100 * efforts.rms(efforts.residuals) / efforts.rms(efforts.measured)
    # Causes with shares below 0.5 % are not drawn.
    np.testing.assert_allclose(drawn, relative, rtol=0.04, atol=1e-9)


@pytest.mark.parametrize("case", ["motion", "poses"])
def test_plots_are_written_as_images(case, request, monkeypatch, tmp_path):
    result = request.getfixturevalue(case)
    with checked_figures(monkeypatch):
        names = {path.stem for path in write_images(identification_page(result), tmp_path)}
    assert names >= {"efforts", "residuals", "error_budget"}


@pytest.mark.parametrize("dynamics", [False, True])
def test_nominal_parameters_are_those_of_the_sdf(dynamics):
    model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtmr"), dynamics=dynamics)
    tables = [block for block in parameter_blocks(model) if isinstance(block, Table) and "SDF" in block.header]
    assert tables
    for table in tables:
        estimate = 1 if table.header[1] == "mass [kg]" else table.header.index("estimate")
        for row in table.rows:
            nominal = float(row[table.header.index("SDF")])
            # The texts have at least three digits.
            assert float(row[estimate]) == pytest.approx(nominal, rel=1e-2, abs=1e-12), row


def test_interval_contains_the_estimate():
    for value, error in ((1.234, 0.05), (-2e-4, 3e-6), (1e3, 20.0), (5e-9, 1e-9)):
        lower, upper = (float(text) for text in interval(value, half_width(error, 7.0)).split(".."))
        assert lower < value < upper
        assert (upper - lower) / 2 == pytest.approx(2.365 * error, rel=0.1)
    assert interval(1.0, 0.0) == "none"


def test_estimate_has_the_digits_of_its_interval():
    for value, error, text in (
        (-8e-15, 0.4, "0.00"),
        (6.8884, 0.7, "6.9"),
        (0.0415, 0.0033, "0.0415"),
        (-3.2e-10, 6.4e-8, "0"),
        (1.2981e-7, 6.4e-8, "1.3e-07"),
        (-2e-4, 3e-6, "-2.000e-04"),
        (1.23456, 0.0, "1.235"),
        (1e-15, 0.0, "0"),
    ):
        assert estimate_cells(value, error, None)[0] == text


def test_axis_of_a_joint_at_rest_does_not_show_rounding_errors():
    lower, upper = axis_range(np.full(5, -0.0118) + 1e-12 * np.arange(5))
    assert lower < -0.0118 < upper
    assert upper - lower > 1e-3
    assert axis_range(np.array([0.0, 1.0])) is None


def test_key_frames_are_limited():
    short, long = frame_times(1.0, 3.0), frame_times(0.0, 1e4)
    assert (short[0], short[-1]) == (1.0, 3.0) and np.diff(short).min() >= 1 / MAX_RATE - 1e-12
    assert len(long) <= MAX_FRAMES and long[-1] == 1e4


def test_verdicts_have_the_words_of_the_result(motion):
    table = blocks(identification_page(motion), Table)[0]
    assert {row[0]: row[1].word for row in table.rows if row[0] != "mean"} == motion.verdicts


@pytest.mark.parametrize(
    ("name", "message"),
    [("report.txt", "must end in .html"), ("missing/report.html", "its folder does not exist"), ("old.html", "exists")],
)
@pytest.mark.parametrize("command", ["identify", "validate"])
def test_bad_path_is_rejected_before_work_begins(command, name, message, tmp_path, capsys):
    (tmp_path / "old.html").write_text("old")
    model = tmp_path / "model.yaml"
    dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtmr")).save(model)
    options = (
        ["--arm", "mtmr", "--output", f"{tmp_path}/new.yaml"] if command == "identify" else ["--model", f"{model}"]
    )
    words = [command, f"{SAMPLES / 'mtm_poses.csv'}", *options, "--report", f"{tmp_path / name}"]
    assert message in refused(capsys, *words)
    assert (tmp_path / "old.html").read_text() == "old" and not (tmp_path / "new.yaml").exists()


def test_page_in_a_browser(motion, open_page, tmp_path):
    path = tmp_path / "report.html"
    write_report(motion, path)
    opened = check_report(open_page, path)
    opened.wait_for("document.querySelector('figure.meshcat .player').checkVisibility()")
    frame = opened.page.frames[1]
    arm = motion.model.arm
    links = f"/drake/{arm.name.lower()}/links"
    script = "(name) => Object.keys(viewer.scene_tree.children.drake.children[name].children.links.children)"
    (model,) = frame.evaluate(script, arm.name.lower())
    body = f"{links}/{model}/{DynamicRegressor(arm).links[3].link}"
    before = opened.translation(body, frame)
    opened.page.locator("figure.meshcat .seek").fill("3")
    moved = opened.translation(body, frame) - before
    assert np.any(np.abs(moved) > 1e-4), "the cursor moves the arm"
