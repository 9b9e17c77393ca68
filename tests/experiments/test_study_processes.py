"""Studies in processes: interruptions lose no rows and do not change the results."""

import os
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import formula_study
import pytest
from command_output import messages
from waiting import TIMEOUT, wait_until

import dvrk_drake.experiments.study_run as study_module
from dvrk_drake.experiments.study import load_study
from dvrk_drake.experiments.study_run import run_study

pytestmark = pytest.mark.slow

STUDY = """
scenario: mtml
set: [duration=1, controller.mode=gravity, "simulated_effects=[all]"]
random_poses: {count: 5, seed: 1, margin: 0.1}
variations: [{name: nominal}, {name: wrong, set: [controller.parameter_error=0.2]}]
measures: [{kind: held, time: 1}, {kind: drift, time: 0.5}, {kind: effort_share}]
"""
#: Program of `dvrk-drake` with a formula instead of the simulation, so that the workers compile nothing.
FORMULA = Path(formula_study.__file__)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "study.yaml"
    path.write_text(STUDY)
    return path


def reference_table(study):
    """Returns the table computed by one thread of this process."""
    path = study.parent / "reference_table.csv"
    path.unlink(missing_ok=True)
    with ThreadPoolExecutor(1) as executor:
        rows = run_study(load_study(study), executor, path)
    assert len(rows) == 10
    assert not any(row.error for row in rows.values())
    return path.read_bytes()


@pytest.fixture
def started():
    """Starts processes and ends them after the test."""
    processes = []

    def start(*arguments):
        command = [sys.executable, *map(str, arguments)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture
def release_simulations(tmp_path, monkeypatch):
    """Returns a function that lets a number of simulations run. Without this fixture, simulations do not wait."""
    folder = tmp_path / "tickets"
    folder.mkdir()
    monkeypatch.setenv(formula_study.TICKETS, str(folder))

    def release_simulations(count):
        for _ in range(count):
            tempfile.mkstemp(dir=folder)

    return release_simulations


def rows_in(path):
    return len(path.read_bytes().splitlines()) - 1 if path.exists() else 0


def children_of(process):
    """Returns the process ids of the workers, without multiprocessing's resource tracker."""
    ids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(i) for i in ids if "spawn_main" in Path(f"/proc/{i}/cmdline").read_text()]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds workers in /proc")
def test_study_survives_killed_process_and_worker(study, started, release_simulations, tmp_path, monkeypatch):
    monkeypatch.setattr(study_module, "simulate", formula_study.simulate)
    path = tmp_path / "killed.csv"
    command = [FORMULA, "simulate", "study", study, "--output", path, "--workers", 2]
    release_simulations(3)
    first = started(*command)
    wait_until(lambda: rows_in(path) == 3, "three rows", first)
    workers = children_of(first)
    first.kill()
    first.wait()
    wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), "end of the workers")
    assert rows_in(path) == 3

    release_simulations(1)
    second = started(*command)
    wait_until(lambda: rows_in(path) == 4, "a fourth row", second)
    os.kill(children_of(second)[0], signal.SIGKILL)
    release_simulations(20)
    output, error = second.communicate(timeout=TIMEOUT)
    assert (second.returncode, messages(error)) == (0, [])
    assert "nominal: 2 of 5 runs" in output
    monkeypatch.delenv(formula_study.TICKETS)
    assert path.read_bytes() == reference_table(study)


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds workers in /proc")
def test_ctrl_c_prints_one_line_and_ends_workers(study, started, release_simulations, tmp_path):
    path = tmp_path / "interrupted.csv"
    release_simulations(1)
    run = started(FORMULA, "simulate", "study", study, "--output", path, "--workers", 2)
    wait_until(lambda: rows_in(path) == 1, "a row", run)
    workers = children_of(run)
    run.send_signal(signal.SIGINT)
    _, error = run.communicate(timeout=TIMEOUT)
    assert (run.returncode, messages(error)) == (130, ["dvrk-drake: interrupted"])
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)
    assert rows_in(path) == 1
