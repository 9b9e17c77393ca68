"""Ctrl-C during a command gives one line and exit code 130, and leaves no empty files or folders."""

import importlib
import io

import pytest
from command_output import messages
from rich.console import Console

from dvrk_drake.cli import main, support
from dvrk_drake.cli.support import Steps
from dvrk_drake.errors import DvrkDrakeError

STUDY = "scenario: psm\nset: [duration=1]\nmeasures: [{kind: drift, time: 1, joints: [yaw]}]\n"
#: Mapping from a command to its options and to the function that does the work.
COMMANDS = {
    "simulate": (["--arm", "psm", "--output", "o.csv", "--plots", "new/p"], "experiments.simulation.simulate"),
    "simulate transparency": (
        ["--arm", "mtml", "--output", "o.csv", "--plots", "new/p"],
        "experiments.transparency.simulate_operator",
    ),
    "simulate study": (
        ["study.yaml", "--output", "o.csv", "--plots", "new/p"],
        "experiments.study_run.run_study_locally",
    ),
    "simulate tune": (
        ["--arm", "mtml", "--output", "o.yaml", "--plots", "new/p"],
        "experiments.tuning.tune_arm",
    ),
    "reproduce": (["fig7", "--folder", "new/p"], "reports.reproduction.reproduce"),
}


@pytest.fixture
def interrupted(monkeypatch, tmp_path):
    """Returns a function that runs a command whose work raises `error`, and returns the exit code."""
    monkeypatch.chdir(tmp_path)

    def run(command, error, before=lambda: None):
        (tmp_path / "study.yaml").write_text(STUDY)
        arguments, path = COMMANDS[command]
        module, _, function = f"dvrk_drake.{path}".rpartition(".")

        def work(*_, **__):
            before()
            raise error

        monkeypatch.setattr(importlib.import_module(module), function, work)
        return main([*command.split(), *arguments])

    return run


@pytest.mark.parametrize("command", COMMANDS)
def test_interrupted_command_leaves_no_files(command, interrupted, tmp_path, capsys):
    assert interrupted(command, KeyboardInterrupt(), lambda: (tmp_path / "new/p").is_dir() or pytest.fail("made later"))
    assert messages(capsys.readouterr().err) == ["dvrk-drake: interrupted"]
    assert interrupted(command, KeyboardInterrupt()) == 130
    assert [p.name for p in tmp_path.iterdir()] == ["study.yaml"]
    assert interrupted(command, DvrkDrakeError("no")) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["study.yaml"]


def test_existing_folders_and_results_are_kept(interrupted, tmp_path):
    (tmp_path / "new").mkdir()
    assert interrupted("reproduce", KeyboardInterrupt()) == 130
    assert [p.name for p in tmp_path.iterdir() if p.is_dir()] == ["new"]
    assert not list((tmp_path / "new").iterdir())
    (tmp_path / "new").rmdir()
    assert interrupted("reproduce", KeyboardInterrupt(), lambda: (tmp_path / "new/p/table.csv").write_text("1")) == 130
    assert (tmp_path / "new/p/table.csv").read_text() == "1"


# Tests of the progress display: bars on a terminal, otherwise one line per step.


def test_each_step_is_one_line_without_a_terminal(capsys):
    with Steps("reading", "identifying", "validating") as steps:
        for share in (0.0, 0.5, 1.0):
            steps("reading", share)
        steps("identifying", 0.0)
        steps("validating", 1.0)
    captured = capsys.readouterr()
    assert captured.err == "1 of 3: reading\n2 of 3: identifying\n3 of 3: validating\n"
    assert not captured.out and not messages(captured.err)


def test_a_part_of_a_step_has_the_number_of_the_step(capsys):
    with Steps("fig4", "fig5") as steps:
        steps("fig4", 0.0)
        steps("fig5: releasing", 0.3)
        steps("fig5: drawing", 0.0)
    assert capsys.readouterr().err == "1 of 2: fig4\n2 of 2: fig5: releasing\n2 of 2: fig5: drawing\n"


@pytest.fixture
def terminal(monkeypatch):
    """Returns the output of `Steps` on a terminal."""
    screen = io.StringIO()
    monkeypatch.setattr(support, "Console", lambda **_: Console(file=screen, force_terminal=True, width=100))
    return screen


def test_each_step_has_a_numbered_bar_on_a_terminal(terminal, capsys):
    with Steps("reading", "identifying") as steps:
        steps("reading", 0.5)
        steps("identifying", 0.25)
        steps._progress.refresh()
        drawn = terminal.getvalue()
    for part in ("1 of 2: reading", "100%", "2 of 2: identifying", "25%", "elapsed", "left"):
        assert part in drawn
    captured = capsys.readouterr()
    assert not captured.err and not captured.out
