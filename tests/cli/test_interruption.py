"""Ctrl-C while a command works: one line, exit code 130, and no folder or file that was made for nothing."""

import importlib

import pytest
from command_output import messages

from dvrk_drake.cli import main
from dvrk_drake.errors import DvrkDrakeError

STUDY = "scenario: psm\nset: [duration=1]\nmeasures: [{kind: drift, time: 1}]\n"
#: Command with its options, and the function that does its work.
COMMANDS = {
    "simulate": (["--arm", "psm", "--output", "o.csv", "--plots", "new/p"], "experiments.simulation.simulate"),
    "transparency": (
        ["--arm", "mtml", "--output", "o.csv", "--plots", "new/p"],
        "experiments.transparency.simulate_operator",
    ),
    "study": (["study.yaml", "--output", "o.csv", "--plots", "new/p"], "experiments.study.study.run_study_locally"),
    "tune": (["--arm", "mtml", "--output", "o.yaml", "--plots", "new/p"], "experiments.tuning.tuning.tune_arm"),
    "reproduce": (["fig7", "--folder", "new/p"], "reports.reproduction.run.reproduce"),
}


@pytest.fixture
def interrupted(monkeypatch, tmp_path):
    """Runs a command in an empty folder whose work ends with `error`; returns the exit code."""
    monkeypatch.chdir(tmp_path)

    def run(command, error, before=lambda: None):
        (tmp_path / "study.yaml").write_text(STUDY)
        arguments, path = COMMANDS[command]
        module, _, function = f"dvrk_drake.{path}".rpartition(".")

        def work(*_, **__):
            before()
            raise error

        monkeypatch.setattr(importlib.import_module(module), function, work)
        return main([command, *arguments])

    return run


@pytest.mark.parametrize("command", COMMANDS)
def test_nothing_is_left(command, interrupted, tmp_path, capsys):
    assert interrupted(command, KeyboardInterrupt(), lambda: (tmp_path / "new/p").is_dir() or pytest.fail("made later"))
    assert messages(capsys.readouterr().err) == ["dvrk-drake: interrupted"]
    assert interrupted(command, KeyboardInterrupt()) == 130
    assert [p.name for p in tmp_path.iterdir()] == ["study.yaml"]
    assert interrupted(command, DvrkDrakeError("no")) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["study.yaml"]


def test_what_was_there_or_holds_a_result_stays(interrupted, tmp_path):
    (tmp_path / "new").mkdir()
    assert interrupted("reproduce", KeyboardInterrupt()) == 130
    assert [p.name for p in tmp_path.iterdir() if p.is_dir()] == ["new"]
    assert not list((tmp_path / "new").iterdir())
    (tmp_path / "new").rmdir()
    assert interrupted("reproduce", KeyboardInterrupt(), lambda: (tmp_path / "new/p/table.csv").write_text("1")) == 130
    assert (tmp_path / "new/p/table.csv").read_text() == "1"
