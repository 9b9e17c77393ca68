"""Tests of the command-line arguments: help, errors, renamed options, shell completion."""

import subprocess
import sys

import pytest
from command_output import refusal

from dvrk_drake.cli import main
from dvrk_drake.cli.app import app
from dvrk_drake.cli.program import RENAMED

COMMANDS = [name for name in app if not name.startswith("-")]

#: Arguments that a command requires.
REQUIRED = {
    "model": ["--arm", "mtml"],
    "view": ["--arm", "mtml"],
    "validate": ["r.csv", "--model", "m.yaml"],
    "predict": ["r.csv", "--model", "m.yaml", "--output", "o.csv"],
    "recalibrate": ["r.csv", "--model", "m.yaml", "--output", "o.yaml"],
    "convert": ["r.csv", "--output", "o.csv"],
    "record": ["o.csv", "--arm", "mtml"],
    "key": ["--output", "o.key"],
    "identify": ["r.csv", "--arm", "mtml", "--output", "o.yaml"],
    "compare-gc": ["gc.json", "--arm", "mtml"],
    "demo": [],
    "reproduce": [],
    "teleop": [],
    "run": ["--arm", "mtml"],
    "transparency": ["--arm", "mtml"],
}


def refused(capsys, *arguments):
    """Runs a command that must fail without output, and returns its error line."""
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert captured.err.count("\n") == 1
    return refusal(captured.err).removeprefix("dvrk-drake: error: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["modl"], 'Unknown command "modl". Did you mean "model"? See dvrk-drake --help'),
        (["--overwrite"], 'Unknown command "--overwrite"; see dvrk-drake --help'),
        (["predict", "r.csv", "--mdel", "m.yaml"], "--model is required. Did you mean --model instead of --mdel? See"),
        (["check", "r.csv", "--arm", "psm", "--arm", "psm"], "Parameter --arm specified multiple times; see"),
        (["arm", "--arm", "psm", "--pose", "-0.1", "-2e-1"], "a pose of PSM is 7 finite numbers"),
        (["identify", "--nonsense"], "Unknown option: --nonsense; see dvrk-drake identify --help"),
        (["check", "a.csv"], "--arm is required: mtml, mtmr, psm, or the path of an arm file; see dvrk-drake check"),
        (["validate", "a.csv"], "--model is required: the model file that identify wrote (a positional argument"),
        (["model", "--arm", __file__], f"{__file__} is not an arm file: its name does not end in .yaml; known arms"),
        (["identify", "a.csv", "--arm", "psm"], "--output is required; see dvrk-drake identify --help"),
        (["validate", "a.csv", "b.csv", "--model", "m.yaml"], "Unexpected argument: b.csv; see"),
        (["tune", "--arm", "psm", "--method", "guess"], 'Invalid value "guess" for --method. Choose from: "paper"'),
        (["demo", "--seed", "-1"], 'Invalid value "-1" for --seed: must be a whole number, 0 or larger; see'),
        (["demo", "--seed", "1.5"], 'Invalid value for --seed: must be a whole number, not "1.5"; see'),
        (["view", "--arm", "psm", "--port", "web"], '--port: must be a whole number, not "web"; see'),
        (["study", "s.yaml", "--output", "r.csv", "--workers", "0"], "--workers: must be a number of processes"),
        (
            ["record", "r.csv", "--arm", "psm", "--duration", "nan"],
            "must be a number of seconds greater than 0",
        ),
        (["export", "--sdf", "out.sdf"], "give exactly one of --model, --arm; see dvrk-drake export --help"),
        (["export", "--arm", "psm", "--model", "m.yaml", "--sdf", "o"], "give exactly one of --model, --arm; see"),
        (
            ["collect", "--arm", "psm", "--poses", "p.yaml"],
            "give exactly one of --output, --teach, --random, --rehearse; see",
        ),
        (["study", "s.yaml", "--output", "r.csv", "--workers", "1", "--scheduler", "x"], "give at most one of"),
        (["simulate", "psm"], "psm is an arm, not a scenario; use --arm psm"),
        (["export", "--model", "psm", "--sdf", "o"], "psm is an arm, not a model; use --arm psm"),
        (["arm", "--arm", "psm", "--rate", "abc"], 'Invalid value for --rate: must be a number, not "abc"; see'),
        (["arm", "--arm", "psm", "--rate", "100"], "--rate requires --ros"),
        (["arm", "--arm", "psm", "--enabled", "--topic", "/P"], "--topic and --enabled require --ros"),
        (["arm", "--arm", "psm", "--ros", "--lcm-url", "memq://"], "--lcm-url cannot be used with --ros"),
        (["record", "r.csv", "--arm", "psm", "--domain", "0"], "--domain requires --ros"),
        (
            ["collect", "--arm", "psm", "--poses", "p", "--output", "o", "--yes", "--topic", "/P", "--max-effort", "0"],
            "--topic, --max-effort and --yes require --ros",
        ),
        (["model", "--arm", "mtmrr"], 'unknown arm "mtmrr"; did you mean "mtmr"'),
        (["model", "--arm", "mtmx"], 'unknown arm "mtmx"; known arms'),
    ],
)
def test_invalid_arguments_give_one_line(arguments, message, capsys):
    assert message in refused(capsys, *arguments)


def test_rejects_too_few_numbers(capsys):
    assert "--gravity needs 3 values, got 2" in refused(capsys, "model", "--arm", "psm", "--gravity", "1", "2")


@pytest.mark.parametrize(("command", "old"), [(command, old) for command in RENAMED for old in RENAMED[command]])
def test_error_for_a_renamed_option_has_the_new_name(command, old, capsys):
    """The key "" stands for a positional argument that became an option."""
    new = RENAMED[command][old]
    options = {name for argument in app[command].assemble_argument_collection() for name in argument.names}
    assert new.split()[0].strip(",") in options and old not in options
    if old:
        for given in ([old], [old, "value"], [f"{old}=value"]):
            error = refused(capsys, command, *REQUIRED[command], *given)
            assert error == f"{old} is now {new}; see dvrk-drake {command} --help"
    else:
        required = REQUIRED[command]
        at = required.index(new)
        error = refused(capsys, command, *required[:at], *required[at + 2 :])
        assert error.startswith(f"{new} is required")
        assert error.endswith(f" (a positional argument before version 0.2); see dvrk-drake {command} --help")


IMPORTS = """
import sys
from dvrk_drake.cli import main
code = main(sys.argv[1:])
slow = {"pydrake", "numpy", "numba", "scipy", "sympy", "matplotlib", "lcm", "pandas"} & sys.modules.keys()
sys.exit(f"imported: {slow}" if slow else code)
"""


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_imports_no_slow_modules_and_fits_80_columns(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    arguments = [sys.executable, "-c", IMPORTS, *command.split(), "--help"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"Usage: dvrk-drake {command}".rstrip() in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert "…" not in done.stdout


def test_commands_are_in_groups(capsys):
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    headings = [line.strip("╭╮─ ") for line in printed.splitlines() if line.startswith("╭")]
    assert headings == ["Model", "Identify", "Simulate", "Hardware", "Paper", "Options"]
    assert all(f"│ {command} " in printed for command in COMMANDS)
    assert main([]) == 0
    assert capsys.readouterr().out == printed


def test_shared_options_have_one_name():
    """Options with the same meaning have the same name in all commands."""
    names = {
        command: {name for argument in app[command].assemble_argument_collection() for name in argument.names}
        for command in COMMANDS
    }
    for command, options in names.items():
        assert not options & {"--plot", "--tables", "--html", "--out", "--save-to", "--force", "--quiet"}, command
        if options & {"--plots", "--json", "--folder"}:
            assert "--overwrite" in options, command


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_installed(shell, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", f"/bin/{shell}")
    for variable in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "ZDOTDIR"):
        monkeypatch.delenv(variable, raising=False)
    assert main(["--install-completion", "--shell", shell]) == 0
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    text = "".join(path.read_text() for path in files)
    assert "dvrk" in text and "recalibrate" in text
    capsys.readouterr()


def test_transparency_rejects_a_folder_as_output(capsys):
    assert "figures are written to --plots" in refused(capsys, "transparency", "--arm", "mtml", "--output", "folder")
