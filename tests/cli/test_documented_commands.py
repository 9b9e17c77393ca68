"""The commands in the documentation are valid: lines can be parsed, all options exist, and the samples work."""

import re
import shlex

import pytest
from cyclopts import CycloptsError
from repository import ROOT
from robot_file import write_robot

from dvrk_drake.cli import main
from dvrk_drake.cli.program import app
from dvrk_drake.models.arm_files import load_arm


def commands(group):
    """Returns the commands of an app, also subcommands, e.g. "collect poses"."""
    found = []
    for name in [name for name in group if not name.startswith("-")]:
        found += [name] * (group[name].default_command is not None)
        found += [f"{name} {sub}" for sub in commands(group[name])]
    return found


NAMES = commands(app)
#: Notebooks. The build of the documentation executes them, so the tests only check their commands.
TUTORIALS = [*(ROOT / "docs/tutorials").glob("*.md")]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(ROOT / "docs").glob("*.md"),
    *TUTORIALS,
    *(ROOT / "examples").glob("*.*"),
]
#: Pattern for a command in a line of a code block, of a cell of a notebook (!), or of a comment in an example.
LINE = re.compile(r"^[ #$!]*(?:[A-Z_]+=\S+ )*dvrk-drake (?P<words>[a-z].*)$", re.MULTILINE)
#: Words that end a command in a shell.
SHELL = ("|", "&", "&&", ";")
#: Pattern for a command with an option in running text. The command may be incomplete.
INLINE = re.compile(rf"`(?:dvrk-drake )?(?P<words>(?:{'|'.join(NAMES)}) [^`]*--[^`]*)`")


def text_of(page):
    """Returns the text of a page in which each command is one line."""
    return re.sub(r"\\\n\s*", "", page.read_text())


def options_of(command):
    found = app
    for name in command.split():
        found = found[name]
    return {name for argument in found.assemble_argument_collection() for name in argument.names}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_documented_commands_are_valid(page):
    text = text_of(page)
    for found in LINE.finditer(text):
        words = shlex.split(found["words"], comments=True)
        end = next((i for i, word in enumerate(words) if word in SHELL or word.startswith(("2>", ">"))), len(words))
        words = words[:end]
        if "..." in words or any(word.startswith("[") for word in words):
            continue  # the options of a pattern are checked below
        try:
            app.parse_args(words, print_error=False, exit_on_error=False)
        except CycloptsError as error:
            pytest.fail(f"dvrk-drake {found['words']}: {error}")
    for found in [*LINE.finditer(text), *INLINE.finditer(text)]:
        words = " ".join(found["words"].partition("#")[0].split())
        command = max((name for name in NAMES if f"{words} ".startswith(f"{name} ")), key=len, default="")
        unknown = set(re.findall(r"(?<!\S)\[?(--[a-z][a-z-]*)", words)) - options_of(command)
        assert not unknown, f"dvrk-drake {found['words']}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page not in TUTORIALS and "dvrk-drake samples" in page.read_text()],
    ids=lambda p: p.name,
)
def test_commands_with_samples_run(page, tmp_path, monkeypatch):
    """The commands of a page run in their order, as a new user enters them."""
    monkeypatch.chdir(tmp_path)
    for found in LINE.finditer(text_of(page)):
        words = shlex.split(found["words"], comments=True)
        if any(word.startswith("samples") for word in words):
            assert main(words) == 0, f"dvrk-drake {found['words']}"


def test_printed_commands_have_valid_options():
    """Checks commands in messages, docstrings and suggested next steps."""
    for path in (ROOT / "dvrk_drake").rglob("*.py"):
        for found in re.finditer(
            rf"dvrk-drake ({'|'.join(sorted(NAMES, key=len, reverse=True))})\b([^\"`;,\n]*)", path.read_text()
        ):
            unknown = set(re.findall(r"(?<!\S)(--[a-z][a-z-]*)", found[2])) - options_of(found[1])
            assert not unknown, f"{path.name}: {found[0]}"


def test_documentation_contains_all_commands():
    lines = [" ".join(found["words"].split()) for page in PAGES for found in LINE.finditer(text_of(page))]
    assert not [name for name in NAMES if name != "demo" and not any(line.startswith(name) for line in lines)]


def test_files_and_commands_for_a_new_arm_work(tmp_path, monkeypatch):
    """The files in docs/your_robot.md and in examples/ describe arms that the commands of the page accept."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    for name in ("my_robot.urdf", "identified.urdf"):  # `export`, which needs a recording, writes the second file
        write_robot(tmp_path, name=name)
    page = (ROOT / "docs/your_robot.md").read_text()
    (block,) = re.findall(r"```yaml\n# my_mtml.yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "my_mtml.yaml").write_text(block)
    commands = [shlex.split(found["words"], comments=True) for found in LINE.finditer(page)]
    arms = {"my_mtml.yaml": "MTML", "examples/probe/psm_with_probe.yaml": "PSM"}
    assert {arm: load_arm(arm).name for arm in arms} == arms
    assert set(arms) <= {word for words in commands for word in words}
    for words in commands:
        if words[0] in ("arm-file", "simulate"):
            assert main(words) == 0, f"dvrk-drake {' '.join(words)}"
