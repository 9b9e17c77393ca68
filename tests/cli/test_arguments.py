"""Tests of the command-line arguments: help, errors, shell completion."""

import itertools
import json
import subprocess
import sys

import numpy as np
import pytest
from command_output import refusal

from dvrk_drake.cli import main
from dvrk_drake.cli.options import FileOptions, app
from dvrk_drake.errors import RecordingError

COMMANDS = [name for name in app if not name.startswith("-")]


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
        ("equation", 'Unknown command "equation". Did you mean "equations"? See dvrk-drake --help'),
        ("predict r.csv --mdel m.yaml", "--model is required. Did you mean --model instead of --mdel? See"),
        ("check r.csv --arm psm --arm psm", "Parameter --arm specified multiple times; see"),
        ("sim-arm --arm psm --pose -0.1 -2e-1", "a pose of PSM is 7 finite numbers"),
        ("identify --nonsense", "Unknown option: --nonsense; see dvrk-drake identify --help"),
        ("identify a.csv --output b.yaml", "--arm is required: ecm, ecm_si, mtml, mtmr, psm, psm_si, or the path of"),
        ("validate a.csv", "--model is required: Model file, written by identify; see"),
        (f"equations --arm {__file__}", f"{__file__} is not the file of an arm; known arms"),
        ("demo --seed -1", 'Invalid value "-1" for --seed: must be >= 0; see'),
        ("simulate study s.yaml --output r.csv --workers 0", "--workers: must be >= 1"),
        ("record r.csv --arm psm --duration nan", "must be a number of seconds greater than 0"),
        ("predict r.csv --model m.yaml --output p.yaml", "p.yaml: the name of the file must end in .csv"),
        ("export --arm psm --urdf psm.xml", "psm.xml: the name of the file must end in .urdf"),
        ("export --sdf out.sdf", "give exactly one of --model, --arm; see dvrk-drake export --help"),
        ("export --arm psm --model m.yaml --sdf o", "give exactly one of --model, --arm; see"),
        ("simulate psm", "psm is an arm, not a scenario; use --arm psm"),
        ("export --model psm --sdf o", "psm is an arm, not a model; use --arm psm"),
        ("sim-arm --arm psm --rate 100", "--rate: only with --transport ros"),
        ("sim-arm --arm psm --transport=ros --lcm-url=memq://", "--lcm-url: only with --transport lcm"),
        (
            "collect poses p --arm psm --output o --yes --topic /P --max-effort 0",
            "--topic and --max-effort and --yes: only with --transport ros",
        ),
        ("simulate x.csv", "x.csv is not a scenario: its name does not end in .yaml. Give a scenario file, or an arm"),
        ("equations --arm mtmx", 'unknown arm "mtmx"; known arms'),
    ],
)
def test_invalid_arguments_give_one_line(arguments, message, capsys):
    assert message in refused(capsys, *arguments.split())


HELP = """
import contextlib, io, json, sys
from dvrk_drake.cli import main
found = {}
for command in sys.argv[1:]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([*command.split(), "--help"])
    slow = {"pydrake", "numpy", "numba", "scipy", "sympy", "matplotlib", "lcm", "pandas"} & sys.modules.keys()
    found[command] = (code, err.getvalue(), sorted(slow), out.getvalue())
print(json.dumps(found))
"""


def all_commands(each, path=()):
    """Returns the words of all commands and subcommands, "" for the program itself."""
    found = [" ".join(path)]
    for name in each:
        if not name.startswith("-"):
            found += all_commands(each[name], (*path, name))
    return found


def short_lines(printed):
    """Returns lines of a help text that could have held the first word of the next line."""
    lines, found = printed.splitlines(), []
    for line, following in itertools.pairwise(lines):
        text, rest = line.strip("│").rstrip(), following.strip("│").rstrip()
        column, is_row = len(rest) - len(rest.lstrip()), line.startswith("│")
        starts_here = text[column : column + 1].strip() and (not column or text[column - 1] == " ")
        # In a table, the rest of a text begins at its column, behind the name of the option.
        is_same_text = following.startswith("│") and column > 8 if is_row else column == 0
        if rest and starts_here and is_same_text and len(text) + 1 + len(rest.split()[0]) <= (77 if is_row else 79):
            found.append(line)
    return found


def test_help_imports_no_slow_modules_and_fits_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    commands = all_commands(app)
    assert len(short_lines("a text that ends\ntoo early")) == 1 and not short_lines(f"{'a' * 76}\nword")
    done = subprocess.run([sys.executable, "-c", HELP, *commands], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert list(found) == commands
    for command, (code, error, slow, printed) in found.items():
        assert (code, error, slow) == (0, "", []), command
        assert f"Usage: dvrk-drake {command}".rstrip() in printed
        assert max(map(len, printed.splitlines())) <= 80, command
        assert "…" not in printed and not short_lines(printed), command


def test_commands_are_in_groups(capsys):
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    headings = [line.strip("╭╮─ ") for line in printed.splitlines() if line.startswith("╭")]
    assert headings == ["Model", "Identify", "Simulate", "Hardware", "Options"]
    assert all(f"│ {command} " in printed for command in COMMANDS)
    assert len(COMMANDS) <= 25 and len(printed.splitlines()) <= 50  # one page
    assert max(map(len, printed.splitlines())) <= 80
    assert main([]) == 0
    assert capsys.readouterr().out == printed


def test_shared_options_have_one_name():
    """Options with the same meaning have the same name in all commands."""
    names = {
        command: {name for argument in app[command].assemble_argument_collection() for name in argument.names}
        for command in COMMANDS
        if app[command].default_command
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
    assert "figures are written to --plots" in refused(
        capsys, "simulate", "transparency", "--arm", "mtml", "--output", "folder"
    )


def test_effort_scale_is_one_number_or_some_of_joints():
    for texts, scale in ((["-2.5"], -2.5), (["yaw=2", "jaw=3"], {"yaw": 2.0, "jaw": 3.0}), (None, None)):
        assert FileOptions(effort_scale=texts).as_arguments()["effort_scale"] == scale
    for texts in (["x"], ["yaw=x"], ["yaw="], ["2", "3"]):
        with pytest.raises(RecordingError, match=r"^--effort-scale .*: allowed: .*, e\.g\. elbow=11\.8$"):
            FileOptions(effort_scale=texts).as_arguments()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--gravity", "0", "-9.81", "0"], [0, -9.81, 0]),
        (["--mount", "-1.22173"], [0.0, 9.21846, -3.35520]),
        (["--mount", "0", "-0.5", "2"], [-4.70314, 0.0, -8.60909]),
        (["--mount", "arm.json"], [0.0, 9.81, 0.0]),
    ],
)
def test_mounting_is_a_gravity_vector(words, expected, tmp_path, monkeypatch):
    from dvrk_drake.cli.program import app as program

    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.json").write_text('{"mounting_pitch": -1.5707963267948966} // a configuration of the dVRK')
    for command in (["equations", "--arm", "psm"], ["identify", "r.csv", "--arm", "psm", "--output", "m.yaml"]):
        _, bound, _ = program.parse_args([*command, *words], print_error=False, exit_on_error=False)
        np.testing.assert_allclose(bound.kwargs["gravity"], expected, atol=1e-4)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--mount", "45"], "--mount needs roll, pitch and yaw, or mounting_pitch, up to 6.28 rad"),
        (["--mount", "1", "2"], "--mount needs roll, pitch and yaw"),
        (["--mount", "gone.json"], "gone.json"),
        (["--gravity", "0", "1"], "--gravity needs three numbers"),
        (["--gravity", "0", "1", "x"], "'0 1 x' are not numbers"),
        (["--gravity", "0", "0", "-9.81", "--mount", "1"], "exclude each other"),
    ],
)
def test_unusable_mountings_are_refused(words, message, capsys):
    assert message in refused(capsys, "equations", "--arm", "psm", *words)
