"""Report of identify and validate: numbers in tables and figures, options of the commands, page in a browser."""

from importlib.resources import files
from types import SimpleNamespace

import numpy as np
import pytest
from command_output import refusal
from dvrk_drake.reports.html.write import write_report
from report_checks import check_report

import dvrk_drake as dvrk
from dvrk_drake.analysis.static.static_identification import identify_static
from dvrk_drake.analysis.verdict import Tolerance, judge, reason
from dvrk_drake.cli import main
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.physical_consistency import bounding_boxes
from dvrk_drake.models.effects_schema import half_width
from dvrk_drake.reports.html.binned import bin_means
from dvrk_drake.reports.html.consistency import centres_of_mass, consistency_blocks, link_table
from dvrk_drake.reports.html.error_budget import error_budget, motion_budget, pose_budget
from dvrk_drake.reports.html.identification import identification_page
from dvrk_drake.reports.html.joint_summary import coverage_table, verdict_table
from dvrk_drake.reports.html.motion_plots import MAX_ROWS, MotionEfforts, efforts_over_time, extremes
from dvrk_drake.reports.html.page import Command, Meshcat, Table, Verdict
from dvrk_drake.reports.html.parameter_tables import _estimate, interval, parameter_tables
from dvrk_drake.reports.html.playback import MAX_FRAMES, MAX_RATE, frame_times
from dvrk_drake.reports.html.plot_style import axis_range
from dvrk_drake.reports.html.pose_plots import PoseEfforts, predicted_over_measured
from dvrk_drake.reports.provenance import Provenance

SAMPLES = files("dvrk_drake") / "samples"
TITLES = [
    "Verdict per joint",
    "Data quality",
    "Parameters",
    "efforts",
    "Residuals over position",
    "Error budget",
    "Cross-validation and repeatability",
    "Physical consistency",
    "Friction and cable curves",
    "Next step",
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


def page_of(result):
    return identification_page(result, Provenance.of(), model_path="own.yaml")


def blocks(page, kind):
    return [block for section in (*page.sections, *page.closing) for block in section.blocks if isinstance(block, kind)]


@pytest.mark.parametrize("case", ["motion", "poses"])
def test_sections_are_in_order(case, request):
    page = page_of(request.getfixturevalue(case))
    sections = [*page.sections, *page.closing]
    assert [section.title for section in sections] == [
        section.title if title in section.title else title for section, title in zip(sections, TITLES, strict=True)
    ]
    assert page.provenance.inputs[0][1] == request.getfixturevalue(case).recording.sha256
    assert "own.yaml" in blocks(page, Command)[0].command or "dvrk-drake check" in blocks(page, Command)[0].command
    assert blocks(page, Meshcat)


def test_page_states_the_days_of_the_prediction_interval(motion):
    assert motion.model.interval_scope in repr(page_of(motion))


def test_plotted_residual_is_measured_minus_predicted(motion):
    efforts = MotionEfforts.of(motion)
    figure, _ = efforts_over_time(efforts)
    for i in range(efforts.arm.num_joints):
        own = {trace.name: trace for trace in figure.data[3 * i : 3 * i + 3]}
        scale = np.max(np.abs(efforts.measured[:, i]))
        residual = own["measured"].y - own["predicted"].y
        # The traces have single precision.
        np.testing.assert_allclose(own["measured − predicted"].y, residual, rtol=0, atol=1e-6 * scale)
        assert len(residual) <= MAX_ROWS
        assert np.max(own["measured"].y) == np.float32(efforts.measured[:, i].max())


def test_plotted_poses_are_the_predictions_of_the_model(poses):
    efforts = PoseEfforts.of(poses)
    figure = predicted_over_measured(efforts)
    tau = poses.model.holding_torque(poses.recording.q)
    for j, name in enumerate(efforts.arm.joint_names):
        (trace,) = [t for t in figure.data if t.name == "fitted" and t.xaxis == ("x" if j == 0 else f"x{j + 1}")]
        use = efforts.usable[:, j]
        np.testing.assert_allclose(trace.y, tau[use, j], rtol=0, atol=1e-6 * np.abs(tau).max(), err_msg=name)


def test_extremes_keep_the_smallest_and_the_largest_value():
    values = np.random.default_rng(0).normal(size=1003)
    rows = extremes(values, 40)
    assert values[rows].min() == values.min() and values[rows].max() == values.max()
    assert len(rows) <= 2 * 26 and np.all(np.diff(rows) > 0)
    np.testing.assert_array_equal(extremes(values, 1), np.arange(1003))


def test_bin_means_of_a_line():
    x = np.random.default_rng(0).uniform(-1, 2, 5000)
    center, mean, deviation = bin_means(x, 3 * x + 1)
    np.testing.assert_allclose(mean, 3 * center + 1, atol=1e-12)
    assert len(center) == 25 and np.all(np.diff(center) > 0) and np.all(deviation < 3 * 0.1)
    center, mean, _ = bin_means(np.zeros(50), np.arange(50.0))  # a joint that does not move
    assert center.tolist() == [0.0] and mean.tolist() == [24.5]


@pytest.mark.parametrize("case", ["motion", "poses"])
def test_shares_of_the_error_budget(case, request):
    if case == "motion":
        result = request.getfixturevalue("motion")
        budgets, errors = motion_budget(MotionEfforts.of(result)), result.relative_errors
    else:
        result = request.getfixturevalue("poses")
        efforts = PoseEfforts.of(result)
        budgets = pose_budget(efforts)
        error, tau = (np.where(efforts.usable, x, 0.0) for x in (efforts.residuals, efforts.measured))
        ratios = np.sqrt(np.sum(error**2, axis=0) / np.sum(tau**2, axis=0))
        errors = dict(zip(efforts.arm.joint_names, ratios, strict=True))
    figure = error_budget(budgets)
    for budget in budgets:
        assert sum(budget.shares.values()) == pytest.approx(1.0, abs=1e-6)
        assert budget.relative_error == pytest.approx(errors[budget.name], rel=1e-9)
    drawn = sum(np.asarray(bar.x) for bar in figure.data if bar.type == "bar")
    # Causes with shares below 0.5 % are not drawn.
    np.testing.assert_allclose(drawn, [100 * budget.relative_error for budget in budgets], rtol=0.04, atol=1e-9)


def test_links_in_the_table_are_those_of_the_model():
    arm = dvrk.load_arm("psm")
    links, boxes = DynamicRegressor(arm).links, bounding_boxes(arm)
    table = link_table(links, links, boxes)
    for row, link in zip(table.rows, links, strict=True):
        least = np.linalg.eigvalsh(link.pseudo_inertia())[0]
        assert float(row[3].split(",")[0]) == pytest.approx(least, rel=0.06), "two digits"
        assert row[-1].word == "consistent"
    for trace in centres_of_mass(links, links, boxes).data:
        assert np.all(np.abs(trace.x) < 1)


@pytest.mark.parametrize("dynamics", [False, True])
def test_nominal_parameters_are_those_of_the_sdf(dynamics):
    model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtmr"), dynamics=dynamics)
    tables = [block for block in parameter_tables(model) if isinstance(block, Table) and "SDF" in block.header]
    assert tables
    for table in tables:
        estimate = 1 if table.header[1] == "mass [kg]" else table.header.index("estimate")
        for row in table.rows:
            nominal = float(row[table.header.index("SDF")])
            # The texts have at least three digits.
            assert float(row[estimate]) == pytest.approx(nominal, rel=1e-2, abs=1e-12), row


def test_interval_contains_the_estimate():
    for value, error in ((1.234, 0.05), (-2e-4, 3e-6), (1e3, 20.0), (5e-9, 1e-9)):
        lower, upper = (float(text) for text in interval(value, half_width(error, 7.0)).split("\N{NO-BREAK SPACE}.. "))
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
        assert _estimate(value, error, None)[0] == text


def test_table_of_verdicts_compares_with_the_effort_limit(poses, motion):
    for result in (poses, motion):
        table, arm = verdict_table(result), result.model.arm
        columns = (table.header.index(name) for name in ("effort limit", "error / limit", table.header[2]))
        limits, ratios, errors = ([row[k] for row in table.rows] for k in columns)
        assert [float(limit) for limit in limits] == pytest.approx(arm.effort_limits, rel=0.01)
        expected = [100 * float(e) / limit for e, limit in zip(errors, arm.effort_limits, strict=True)]
        assert [float(ratio.removesuffix(" %")) for ratio in ratios] == pytest.approx(expected, abs=0.06, rel=0.01)


@pytest.mark.parametrize(("arm", "units"), [("mtml", "[rad/s]"), ("psm", "[rad/s; m/s]")])
def test_speeds_have_the_units_of_the_arm(arm, units):
    model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm(arm))
    q = np.zeros((2, 7))
    header = coverage_table(SimpleNamespace(model=model), q, q).header
    assert header[-2:] == (f"RMS speed {units}", f"peak speed {units}")
    assert not any("speed" in name for name in coverage_table(SimpleNamespace(model=model), q, None).header)


@pytest.mark.parametrize(("arm", "explained"), [("mtml", True), ("psm", False)])
def test_bounding_box_of_a_rotor_is_explained(arm, explained):
    blocks = consistency_blocks(dvrk.IdentifiedModel.from_arm(dvrk.load_arm(arm)))
    assert (
        any(block.kind == "text" and "No shape in the SDF: motor_4_link." in block.text for block in blocks)
        == explained
    )


def test_axis_of_a_joint_at_rest_does_not_show_rounding_errors():
    lower, upper = axis_range(np.full(5, -0.0118) + 1e-12 * np.arange(5))["range"]
    assert lower < -0.0118 < upper
    assert upper - lower > 1e-3
    assert axis_range(np.array([0.0, 1.0])) == {}


def test_key_frames_are_limited():
    short, long = frame_times(1.0, 3.0), frame_times(0.0, 1e4)
    assert (short[0], short[-1]) == (1.0, 3.0) and np.diff(short).min() >= 1 / MAX_RATE - 1e-12
    assert len(long) <= MAX_FRAMES and long[-1] == 1e4


def test_verdicts_have_the_words_and_reasons_of_the_rule(motion):
    table = verdict_table(motion)
    words = {row[0]: row[-1] for row in table.rows}
    assert {name: label.word for name, label in words.items()} == motion.verdicts
    assert all(isinstance(label, Verdict) and label.reason.endswith(".") for label in words.values())
    judged = 1.0, 0.3, Tolerance(0.4, 0.6), 0.5
    text = reason(judge(*judged), *judged)
    assert text.startswith("The RMS error is 0.3 N m or 30 % of the measured effort. Dry friction: 0.4 N m.")
    assert text.endswith("at 15 mrad: 0.6 N m. Range covered (at most 180 deg count): 50 %.")
    assert "not separated from friction" in reason("off", *judged)


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
    assert main(words) == 2
    assert message in refusal(capsys.readouterr().err)
    assert (tmp_path / "old.html").read_text() == "old" and not (tmp_path / "new.yaml").exists()


def test_command_names_the_report_or_the_option(tmp_path, capsys):
    model = tmp_path / "model.yaml"
    dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtmr")).save(model)
    words = ["validate", f"{SAMPLES / 'mtm_other_poses.csv'}", "--model", f"{model}"]
    assert main(words) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("--report FILE.html")
    report = tmp_path / "report.html"
    assert main([*words, "--report", f"{report}"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"wrote {report}: report"
    assert "dvrk-drake validate" in report.read_text()


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
