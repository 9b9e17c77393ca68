"""Automatic style checks: banned words, docstrings, test names, length of the README."""

import ast
import re
import subprocess

import pytest
from repository import ROOT

#: Words that the style guide does not allow: metaphors, personification and non-standard terms.
BANNED = re.compile(
    r"\b(doubt(s|ed|ful)?|undoubted|trust(s|ed)?|untrusted|told|honest|vouch(es|ed)?|knows|hears|heard|wishes|remembers|"
    r"unrest|felt|feels|leans|leaning|rambling|somebody|whoever|laboratory|true arm|links that can exist|"
    r"one an? (joint|row|period|arm|actuator|pose)|the way there)\b",
    re.IGNORECASE,
)
MAX_TEST_NAME = 60
MAX_README_LINES = 120


def tracked(*patterns):
    names = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in names.splitlines() if not name.endswith("test_style.py")]


def definitions(path):
    tree = ast.parse(path.read_text())
    yield tree
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node


PYTHON = tracked("*.py")
TEXTS = [path for path in tracked("*.py", "*.md", "*.yaml") if path.name != "CHANGELOG.md"]


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_contain_no_banned_words(path):
    # Lines that read or test old keys of files contain banned words.
    lines = ["" if "formerly(" in line or "earlier key" in line else line for line in path.read_text().splitlines()]
    found = [f"line {i}: {match.group()}" for i, line in enumerate(lines, 1) if (match := BANNED.search(line))]
    assert not found, "words that the style guide does not allow"


@pytest.mark.parametrize("path", PYTHON, ids=lambda path: str(path.relative_to(ROOT)))
def test_docstrings_start_with_a_verb_or_a_noun(path):
    first = [(node, (ast.get_docstring(node) or "").partition(" ")[0]) for node in definitions(path)]
    found = [
        f"{getattr(node, 'name', 'module')}: {word}"
        for node, word in first
        if word in ("Of", "What", "Where", "Which", "How", "Whether")
    ]
    assert not found


def test_test_names_are_short():
    names = {
        node.name
        for path in tracked("tests/*.py", "tests/**/*.py")
        for node in definitions(path)
        if hasattr(node, "name")
    }
    assert not sorted(name for name in names if name.startswith("test_") and len(name) > MAX_TEST_NAME)


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= MAX_README_LINES
