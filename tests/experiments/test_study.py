"""Studies: the table does not depend on the executor or on interruptions. A formula replaces the simulation."""

import csv
import math
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
from figure_rules import checked_figures
from report_pages import printed

import dvrk_drake.experiments.study_run as study_module
from dvrk_drake.errors import SimulationError, StudyError
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.experiments.study import RandomPoses, Study, Variation
from dvrk_drake.experiments.study_measures import Measure
from dvrk_drake.experiments.study_run import StudyTable, run_study, wilson_interval
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.page import Table
from dvrk_drake.reports.study import study_page

MTM = load_arm("mtml")


def make_study(**changes):
    study = Study(
        scenario="mtml",
        set=["duration=2", "sample_period=0.1", "controller.mode=gravity"],
        random_poses=RandomPoses(6, seed=3),
        seeds=[1, 2],
        variations=[Variation("exact"), Variation("wrong, a lot", ["controller.parameter_error=0.2"])],
        measures=[Measure("held", time=2.0), Measure("drift", time=1.0), Measure("effort_share")],
    )
    for name, value in changes.items():
        setattr(study, name, value)
    return study


@pytest.fixture(autouse=True)
def formula(monkeypatch):
    """Computes a drift from seed and parameter error; every seventh seed diverges, every eleventh gives NaN."""

    def simulate(scenario):
        if scenario.seed % 7 == 0:
            raise SimulationError("the simulation failed at 0.3 s: no convergence")
        t = np.arange(21) * 0.1
        rate = (1 + scenario.controller.parameter_error) * (scenario.seed % 1000) / 5e4
        q = np.array(scenario.start) + rate * t[:, None]
        if scenario.seed % 11 == 0:
            q[9:] = np.nan
        return Simulation(Recording(q=q, qd=0 * q, tau=q / 10, t=t), np.hstack([q, 0 * q]), None, None)

    monkeypatch.setattr(study_module, "simulate", simulate)


class ReverseOrderExecutor(ThreadPoolExecutor):
    """Executor that runs all cases in reverse order after the last one is submitted."""

    def __init__(self):
        super().__init__(1)
        self._calls = []

    def submit(self, fn, *arguments):
        future = Future()
        self._calls.append((future, fn, arguments))
        if len(self._calls) == 24:
            for pending, function, values in reversed(self._calls):
                pending.set_result(function(*values))
        return future


class WorkerLossExecutor(ThreadPoolExecutor):
    """Executor whose workers are killed after a given number of cases."""

    def __init__(self, cases):
        super().__init__(1)
        self._left = cases

    def submit(self, fn, *arguments):
        self._left -= 1
        if self._left >= 0:
            return super().submit(fn, *arguments)
        future = Future()
        future.set_exception(BrokenProcessPool("killed"))
        return future


def test_programming_error_is_no_failed_run(tmp_path, monkeypatch):
    def simulate(scenario):
        raise ValueError("operands could not be broadcast")

    monkeypatch.setattr(study_module, "simulate", simulate)
    message = r"24 of 24 cases are missing \(case 0: ValueError: operands could not be broadcast\)"
    with ThreadPoolExecutor(1) as executor, pytest.raises(StudyError, match=message):
        run_study(make_study(), executor, tmp_path / "results.csv")


@pytest.fixture
def reference(tmp_path):
    path = tmp_path / "reference.csv"
    with ThreadPoolExecutor(1) as executor:
        run_study(make_study(), executor, path)
    return path.read_bytes()


def test_table_has_one_reproducible_row_per_case(reference):
    rows = list(csv.DictReader(reference.decode().splitlines()))
    assert [int(row["case"]) for row in rows] == list(range(24))
    assert {(row["pose"], row["variation"], row["seed"]) for row in rows} == {
        (row["pose"], v, row["seed"]) for row in rows for v in ("exact", "wrong, a lot")
    }
    assert len({row["seed"] for row in rows}) == 12  # one for each pose and seed, shared by the variations
    starts = np.array([[float(row[f"q{j}"]) for j in range(1, 8)] for row in rows])
    np.testing.assert_array_equal(starts[::4], MTM.sample_poses(6, np.random.default_rng(3)))
    for row in rows:
        if int(row["seed"]) % 7 == 0:
            assert row["error"] == "the simulation failed at 0.3 s: no convergence"
            assert row["held"] == row["drift"] == ""
        elif int(row["seed"]) % 11 == 0:
            assert row["error"] == "diverged: not finite from 0.9 s on"
        else:
            rate = (1.2 if row["variation"] != "exact" else 1.0) * (int(row["seed"]) % 1000) / 5e4
            assert float(row["drift"]) == pytest.approx(rate)
            assert row["held"] == str(2 * rate <= 0.015).lower()
    assert any(row["error"] for row in rows)


@pytest.mark.parametrize(
    "executor", [lambda: ThreadPoolExecutor(2), lambda: ThreadPoolExecutor(7), ReverseOrderExecutor]
)
def test_table_does_not_depend_on_workers_or_order(executor, reference, tmp_path):
    with executor() as workers:
        run_study(make_study(), workers, tmp_path / "other.csv")
    assert (tmp_path / "other.csv").read_bytes() == reference


@pytest.mark.parametrize("cases", [0, 1, 23])
def test_lost_workers_do_not_lose_rows(cases, reference, tmp_path):
    path = tmp_path / "killed.csv"
    message = rf"^{24 - cases} of 24 cases are missing \(case"
    with WorkerLossExecutor(cases) as executor, pytest.raises(StudyError, match=message) as loss:
        run_study(make_study(), executor, path)
    assert isinstance(loss.value.__cause__, BrokenProcessPool)
    counts = []
    with WorkerLossExecutor(24 - cases) as executor:  # exactly the number of missing cases
        rows = run_study(make_study(), executor, path, lambda done, all_cases: counts.append((done, all_cases)))
    assert counts == [(done, 24) for done in range(cases, 25)]
    assert sorted(rows) == list(range(24))
    assert path.read_bytes() == reference


def test_truncated_table_is_completed_identically(reference, tmp_path):
    path = tmp_path / "cut.csv"
    for cut in [0, 3, reference.index(b"\n"), *np.random.default_rng(0).integers(0, len(reference), 20)]:
        path.write_bytes(reference[:cut])
        with ThreadPoolExecutor(2) as executor:
            run_study(make_study(), executor, path)
        assert path.read_bytes() == reference


@pytest.mark.parametrize(
    "change",
    [
        {"set": ["duration=2.5", "sample_period=0.1", "controller.mode=gravity"]},
        {"set": ["duration=2", "sample_period=0.1", "controller.mode=gravity", "gravity=[0,0,-9.80]"]},
        {"random_poses": RandomPoses(6, seed=4)},
        {"random_poses": RandomPoses(7, seed=3)},
        {"seeds": [1, 3]},
        {"variations": [Variation("exact"), Variation("wrong, a lot", ["controller.parameter_error=0.3"])]},
        {"measures": [Measure("held", time=1.0), Measure("drift", time=1.0), Measure("effort_share")]},
        {"measures": [Measure("held", time=2.0)]},
    ],
)
def test_rejects_table_of_another_study_unchanged(change, reference, tmp_path):
    path = tmp_path / "partial_table.csv"
    partial_table = reference[: len(reference) // 2]
    path.write_bytes(partial_table)
    with ThreadPoolExecutor(1) as executor, pytest.raises(StudyError, match="is not a result of this study"):
        run_study(make_study(**change), executor, path)
    assert path.read_bytes() == partial_table


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: b"hello", ", line 1: the file exists"),
        (lambda text: b"t,q1,q2\n1,2,3\n", ", line 1: the file exists"),
        (lambda text: b"\xff\xfe\n", ", line 1: the file exists"),
        (lambda text: text + text.splitlines(keepends=True)[5], ", line 26: the file exists"),
        (lambda text: text.replace(b',3,"wrong', b',300,"wrong'), ", line 5: the file exists"),
        (lambda text: text.replace(b",false,", b",nearly,", 1), "is not a result of this study"),
    ],
)
def test_rejects_other_files_and_leaves_them_unchanged(change, message, reference, tmp_path):
    path = tmp_path / "foreign.csv"
    path.write_bytes(change(reference))
    with ThreadPoolExecutor(1) as executor, pytest.raises(StudyError, match=message):
        run_study(make_study(), executor, path)
    assert path.read_bytes() == change(reference)


def test_two_studies_cannot_write_the_same_file(tmp_path):
    path = tmp_path / "both.csv"
    with (
        StudyTable(path, make_study()),
        ThreadPoolExecutor(1) as executor,
        pytest.raises(StudyError, match="another process is writing this file"),
    ):
        run_study(make_study(), executor, path)


def test_interrupted_study_keeps_rows_and_cancels_rest(reference, tmp_path):
    path = tmp_path / "interrupted.csv"

    def interrupt(done, all_cases):
        if done == 5:
            raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyboardInterrupt):
        run_study(make_study(), executor, path, interrupt)
    assert len(path.read_bytes().splitlines()) == 6
    with ThreadPoolExecutor(1) as executor:
        run_study(make_study(), executor, path)
    assert path.read_bytes() == reference


def test_page_counts_failed_runs_as_worst(tmp_path):
    study = make_study(random_poses=RandomPoses(60, seed=1))
    with ThreadPoolExecutor(1) as executor:
        rows = run_study(study, executor, tmp_path / "r.csv")
    exact = [rows[c.index] for c in study.cases if c.variation == "exact"]
    assert any(row.error for row in exact)
    held = sum(row.values.get("held", False) for row in exact)
    drifts = sorted(row.values.get("drift", math.inf) for row in exact)
    table = next(block for block in study_page(study, rows).blocks if isinstance(block, Table))
    share, low_and_high, _ = table.rows[0][2:]
    low, high = wilson_interval(held, 120)
    assert (share, low_and_high) == (f"{held / 1.2:.1f} %", f"{100 * low:.1f}..{100 * high:.1f} %")
    assert list(table.rows[2][2:]) == [f"{drifts[59]:.4g} rad", f"{drifts[113]:.4g} rad", "inf rad"]


def test_report_lists_all_measures_and_errors(tmp_path, monkeypatch):
    study = make_study()
    with ThreadPoolExecutor(1) as executor:
        rows = run_study(study, executor, tmp_path / "r.csv")
    page = study_page(study, rows)
    text = " ".join(printed(page).split())
    for word in ("held exact: ", "; wrong, a lot: ", " of 12 runs", "24 of 24 runs"):
        assert word in text
    assert "drift" in text and "the simulation failed at 0.3 s" in text
    with checked_figures(monkeypatch):
        write_images(page, tmp_path)
    assert (tmp_path / "study.png").stat().st_size > 10_000


def test_case_can_be_repeated_as_scenario():
    study = make_study()
    for case in study.cases:
        scenario = study.scenario_of(case)
        scenario.check()
        assert tuple(scenario.start) == case.start
        assert not MTM.limit_violations(case.start)
    assert [c.index for c in study.cases] == list(range(24))
    assert make_study().fingerprint == study.fingerprint


def test_parameter_error_depends_on_seed_within_bounds():
    study = make_study()
    exact, wrong, _, other = (study.scenario_of(case).model for case in study.cases[:4])
    some = exact.theta != 0
    ratios = [m.theta[some] / exact.theta[some] for m in (wrong, other)]
    assert all(np.all((r >= 0.8) & (r <= 1.2)) for r in ratios)
    assert np.ptp(ratios[0]) > 0.1
    assert not np.any(ratios[0] == ratios[1])
    np.testing.assert_array_equal(study.scenario_of(study.cases[1]).model.theta, wrong.theta)
