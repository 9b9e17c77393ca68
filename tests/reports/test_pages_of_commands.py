"""Reports of study, tune, transparency, payload, excite and compare-gc: content; layout of all pages in a browser."""

import hashlib
import tempfile
from dataclasses import replace
from functools import cache
from importlib import import_module
from importlib.resources import files
from pathlib import Path

import pytest
from figure_rules import checked_figures
from loaded_arm import two_days
from report_checks import ALL_VIEWS, VIEWS, check_report
from report_results import operator_forces, study_results, tuning_result

import dvrk_drake as dvrk
from dvrk_drake.cli import main
from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.export.dvrk_mtm_gravity_compensation import compare_compensation
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.models.files import Reportable
from dvrk_drake.reports.excitation import motion_page, poses_page
from dvrk_drake.reports.export import compensation_page
from dvrk_drake.reports.html_file import _MAKERS, render_html, write_html
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.page import Plot, Table
from dvrk_drake.reports.payload import payload_page
from dvrk_drake.reports.plot import Curve, Guide
from dvrk_drake.reports.study import study_page
from dvrk_drake.reports.transparency import transparency_page
from dvrk_drake.reports.tuning import tuning_page


@cache
def comparison():
    """Comparison of the nominal model of an MTML with its own file, with a changed torque limit."""
    model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtml"))
    with tempfile.TemporaryDirectory() as folder:
        dvrk.export_model(model, f"{folder}/gc.json", "dvrk-gc", tolerance=1.0)
        file = GravityCompensationFile.load(f"{folder}/gc.json")
    file.torque_upper[1] = 0.3
    return compare_compensation(file, model)


@cache
def payload():
    """Payload of 0.2 kg on a PSM."""
    _, reference, loaded = two_days("psm", "end_link", 0.2, [0.02, 0.02, 0.39], 0)
    return dvrk.payload(reference, loaded, dvrk.identify(reference, dvrk.load_arm("psm")).model)


@cache
def motion_design():
    return dvrk.design_excitation(dvrk.load_arm("psm"), duration=4.0, period=4.0, harmonics=2, starts=1)


PAGES = {
    "excite": lambda: motion_page(motion_design()),
    "excite-poses": lambda: poses_page(dvrk.design_poses(dvrk.load_arm("mtml"), 8)),
    "study": lambda: study_page(*study_results(), study_path="study.yaml"),
    "tune": lambda: tuning_page(tuning_result()),
    "transparency": lambda: transparency_page(*operator_forces(), command="dvrk-drake simulate transparency"),
    "compare-gc": lambda: compensation_page(comparison(), file_name="gc.json", model_name="model.yaml"),
    "payload": lambda: payload_page(payload()),
}
SLOW = {"payload", "excite", "excite-poses"}
#: Commands whose pages are checked at all widths, in light and dark. Calibrate writes pages of identify and validate.
COMMANDS = {
    "identify_poses": ["identify {samples}/mtm_poses.csv --arm mtmr --output model.yaml --report page.html"],
    "identify_motion": ["identify {samples}/psm_motion.csv --arm psm --output model.yaml --report page.html"],
    "validate": [
        "identify {samples}/mtm_poses.csv --arm mtmr --output model.yaml",
        "validate {samples}/mtm_other_poses.csv --model model.yaml --report page.html",
    ],
    "demo": ["demo --folder demo_output"],
    "reproduce": ["reproduce table1 --folder reproduction"],
}


def blocks(page, kind):
    return [block for block in page.blocks if isinstance(block, kind)]


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in PAGES])
def test_page_has_answer_tables_plots_and_next_step(name, tmp_path, monkeypatch):
    page = PAGES[name]()
    assert page.answer and page.level in ("good", "warning")
    assert blocks(page, Table) and page.next_step.startswith("dvrk-drake ")
    assert "--verbose" not in render_html(page)
    with checked_figures(monkeypatch):
        assert [path.stem for path in write_images(page, tmp_path)] == [plot.name for plot in blocks(page, Plot)] != []


@pytest.mark.slow
@pytest.mark.all_widths
@pytest.mark.parametrize("name", COMMANDS)
def test_pages_at_all_widths(name, open_page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in COMMANDS[name]:
        assert main(command.format(samples=files("dvrk_drake") / "samples").split()) == 0
    (path,) = [*tmp_path.glob("page.html"), *tmp_path.glob("*/report.html"), *tmp_path.glob("*/index.html")]
    check_report(open_page, path, ALL_VIEWS)


@pytest.mark.parametrize("name", PAGES)
def test_layout_in_a_browser(name, open_page, tmp_path):
    write_html(PAGES[name](), tmp_path / "report.html")
    check_report(open_page, tmp_path / "report.html", ALL_VIEWS if name in SLOW else VIEWS)


def test_study_plots_show_all_runs_and_name_infinite_values():
    study, rows = study_results()
    (plot,) = blocks(study_page(study, rows), Plot)
    drift, _ = plot.panels
    assert sum(len(mark.x) for mark in drift.marks) == len(rows) - 1
    assert "1 of 24 are infinite" in drift.title


def test_tuning_plot_shows_each_response_and_the_goal():
    tuning = tuning_result()
    steps, _ = blocks(tuning_page(tuning), Plot)
    for panel in steps.panels:
        curves = [mark for mark in panel.marks if isinstance(mark, Curve)]
        assert len(curves) == len(tuning.comparison.responses)
        # All responses start at 0. The slowest, exp(-3 t), ends inside the band of 2 % around the goal after 2 s.
        assert all(curve.y[0] == pytest.approx(0.0, abs=1e-9) for curve in curves)
        band, goal = (mark for mark in panel.marks if isinstance(mark, Guide))
        assert band.low < curves[0].y[-1] < band.high and band.low < goal.low < band.high


def test_write_report_selects_the_page_by_type(tmp_path):
    dvrk.write_report(tuning_result(), tmp_path / "report.html", command=["tune", "--arm", "psm"])
    html = (tmp_path / "report.html").read_text()
    assert "Controller gains of PSM" in html and "dvrk-drake simulate tune --arm psm" in html
    with pytest.raises(DvrkDrakeError, match=r"there is no report for int; allowed: .*Tuning"):
        dvrk.write_report(1, tmp_path / "other.html")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_all_results_with_a_page_have_the_method():
    def names(kind):
        return {kind.__name__}.union(*map(names, kind.__subclasses__()))

    for module, _ in _MAKERS.values():
        import_module(f"dvrk_drake.reports.{module}")
    assert names(Reportable) >= _MAKERS.keys()


@pytest.mark.slow
def test_payload_report_shows_the_interval_of_the_mass():
    result = payload()
    mass = next(row for row in blocks(payload_page(result), Table)[0].rows if row[0] == "mass [kg]")
    assert float(mass[1]) == pytest.approx(result.payload.body.mass, abs=1e-4)
    other = next(one for one in result.estimates if one.link == "insertion_link")
    page = payload_page(replace(result, payload=other, link=other.link))
    assert page.level == "warning" and page.answer.startswith("No payload found on insertion_link")


@pytest.fixture
def gc_file(tmp_path, monkeypatch):
    """Name of a gravity-compensation file in the working directory."""
    monkeypatch.chdir(tmp_path)
    model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtml"))
    dvrk.export_model(model, "gc-MTML.json", "dvrk-gc", tolerance=1.0)
    return "gc-MTML.json"


def test_command_writes_report_with_provenance(gc_file, capsys):
    words = ["export", "compare", gc_file, "--arm", "mtml", "--report", "report.html"]
    assert main(words) == 0
    assert "wrote report.html: report\n" in capsys.readouterr().out
    html = Path("report.html").read_text()
    assert f"dvrk-drake {' '.join(words)}" in html
    assert hashlib.sha256(Path(gc_file).read_bytes()).hexdigest() in html
