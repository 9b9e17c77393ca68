"""Reports of study, tune, transparency, payload and compare-gc: content, and layout in a browser."""

import hashlib
import re
import tempfile
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from command_output import refusal
from loaded_arm import two_days
from report_checks import check_report
from report_results import operator_forces, study_results, tuning_result

import dvrk_drake as dvrk
from dvrk_drake.cli import main
from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import compare_compensation
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.models.files import Reportable
from dvrk_drake.reports.html.compensation import compensation_page
from dvrk_drake.reports.html.page import Command, Plot, Provenance, Table
from dvrk_drake.reports.html.payload import payload_page
from dvrk_drake.reports.html.study import study_page
from dvrk_drake.reports.html.transparency import transparency_page
from dvrk_drake.reports.html.tuning import tuning_page
from dvrk_drake.reports.html.write import _MAKERS

ORIGIN = Provenance.of()


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


PAGES = {
    "study": lambda: study_page(*study_results(), ORIGIN),
    "tune": lambda: tuning_page(tuning_result(), ORIGIN),
    "transparency": lambda: transparency_page(*operator_forces(), ORIGIN),
    "compare-gc": lambda: compensation_page(comparison(), ORIGIN, "gc.json", "model.yaml"),
    "payload": lambda: payload_page(payload(), ORIGIN),
}
SLOW = {"payload"}


def blocks(page, kind):
    return [block for section in (*page.sections, *page.closing) for block in section.blocks if isinstance(block, kind)]


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in PAGES])
def test_report_has_answer_tables_plots_and_next_step(name):
    page = PAGES[name]()
    assert page.subtitle and page.level in ("good", "warning")
    assert blocks(page, Table) and blocks(page, Plot)
    assert [command.command.split()[:1] for command in blocks(page, Command)] == [["dvrk-drake"]]
    assert "--verbose" not in page.html()


@pytest.mark.parametrize("name", PAGES)
def test_layout_in_a_browser(name, open_page, tmp_path):
    PAGES[name]().write(tmp_path / "report.html")
    check_report(open_page, tmp_path / "report.html")


def test_study_plots_show_all_runs_and_name_infinite_values():
    study, rows = study_results()
    share, drift, _ = blocks(study_page(study, rows, ORIGIN), Plot)
    cases = [[c.index for c in study.cases if c.variation == v.name] for v in study.variations]
    held = [np.mean([rows[k].values.get("held", False) for k in indices]) for indices in cases]
    assert [trace.x[0] for trace in share.figure.data] == pytest.approx([100 * x for x in held], abs=1e-9)
    assert sum(len(trace.x) for trace in drift.figure.data) == len(rows) - 1
    assert "1 of 24 are infinite" in drift.caption


def test_tuning_plot_shows_each_response_and_the_goal():
    tuning = tuning_result()
    steps, _ = blocks(tuning_page(tuning, ORIGIN), Plot)
    n = tuning.arm.num_joints
    assert len(steps.figure.data) == n * len(tuning.comparison.responses)
    # All responses start at 0 and approach the goal, which the band surrounds.
    for trace in steps.figure.data:
        assert trace.y[0] == pytest.approx(0.0, abs=1e-9)
    # The slowest response, exp(-3 t), ends inside the band of 2 % around the goal after 2 s.
    bands = [(shape.y0, shape.y1) for shape in steps.figure.layout.shapes]
    final = [trace.y[-1] for trace in steps.figure.data[:: len(tuning.comparison.responses)]]
    assert all(low < y < high for (low, high), y in zip(bands, final, strict=True))


def test_write_report_selects_the_page_by_type(tmp_path):
    dvrk.write_report(tuning_result(), tmp_path / "report.html", command=["tune", "--arm", "psm"])
    html = (tmp_path / "report.html").read_text()
    assert "Controller gains of PSM" in html and "dvrk-drake tune --arm psm" in html
    with pytest.raises(DvrkDrakeError, match=r"there is no report for int; allowed: .*Tuning"):
        dvrk.write_report(1, tmp_path / "other.html")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_result_writes_its_report(tmp_path):
    recording = tmp_path / "recording.csv"
    recording.write_text("q1\n0\n")
    tuning = tuning_result()
    tuning.report(tmp_path / "method.html", inputs=[recording])
    dvrk.write_report(tuning, tmp_path / "function.html", inputs=[recording])
    # Each page states the minute in which it was written.
    pages = [re.sub(r"[\d: -]+ UTC", "", (tmp_path / f"{name}.html").read_text()) for name in ("method", "function")]
    assert pages[0] == pages[1] and "recording.csv" in pages[0]


def test_all_results_with_a_page_have_the_method():
    def names(kind):
        return {kind.__name__}.union(*map(names, kind.__subclasses__()))

    for module, _ in _MAKERS.values():
        import_module(f"dvrk_drake.reports.html.{module}")
    assert names(Reportable) >= _MAKERS.keys()


@pytest.mark.slow
def test_payload_report_shows_the_interval_of_the_mass():
    result = payload()
    mass = next(row for row in blocks(payload_page(result, ORIGIN), Table)[0].rows if row[0] == "mass [kg]")
    assert float(mass[1]) == pytest.approx(result.payload.body.mass, abs=1e-4)
    other = next(one for one in result.estimates if one.link == "insertion_link")
    page = payload_page(replace(result, payload=other, link=other.link), ORIGIN)
    assert page.level == "warning" and page.subtitle.startswith("No payload found on insertion_link")


@pytest.fixture
def gc_file(tmp_path, monkeypatch):
    """Name of a gravity-compensation file in the working directory."""
    monkeypatch.chdir(tmp_path)
    model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("mtml"))
    dvrk.export_model(model, "gc-MTML.json", "dvrk-gc", tolerance=1.0)
    return "gc-MTML.json"


def test_command_writes_report_with_provenance(gc_file, capsys):
    words = ["compare-gc", gc_file, "--arm", "mtml", "--report", "report.html"]
    assert main(words) == 0
    assert capsys.readouterr().out.endswith("wrote report.html: report\n")
    html = Path("report.html").read_text()
    assert f"dvrk-drake {' '.join(words)}" in html
    assert hashlib.sha256(Path(gc_file).read_bytes()).hexdigest() in html


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("report.pdf", "--report writes HTML; the name of the file must end in .html"),
        ("old.html", "already exists. Choose another file, or replace it with --overwrite."),
        ("missing/report.html", "cannot be written: its folder does not exist"),
    ],
)
def test_report_path_is_checked_before_the_work(gc_file, path, message, capsys):
    Path("old.html").write_text("old")
    assert main(["compare-gc", gc_file, "--arm", "mtml", "--report", path]) == 2
    output = capsys.readouterr()
    assert not output.out and message in refusal(output.err)
    assert sorted(file.name for file in Path().iterdir()) == [gc_file, "old.html"]
    assert Path("old.html").read_text() == "old"
