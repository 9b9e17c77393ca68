"""Ctrl-C during a command gives one line and exit code 130, and leaves no empty files or folders."""

import importlib

import pytest
from command_output import messages

from dvrk_drake.cli import main
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
        "experiments.study.study.run_study_locally",
    ),
    "simulate tune": (
        ["--arm", "mtml", "--output", "o.yaml", "--plots", "new/p"],
        "experiments.tuning.tuning.tune_arm",
    ),
    "reproduce": (["fig7", "--folder", "new/p"], "reports.reproduction.page.reproduce"),
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
