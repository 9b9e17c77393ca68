"""Automatic style checks: banned words, docstrings, test names, length of the README."""

import ast
import re
import subprocess
from functools import cache

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


@cache
def definitions(path):
    """Returns the module, and its functions and classes."""
    tree = ast.parse(path.read_text())
    return [tree, *(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef))]


PYTHON = tracked("*.py")
TEXTS = [path for path in tracked("*.py", "*.md", "*.yaml") if path.name != "CHANGELOG.md"]


def test_files_contain_no_banned_words():
    found = []
    for path in TEXTS:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            # Lines that read or test old keys of files contain banned words.
            if "formerly(" not in line and "earlier key" not in line and (match := BANNED.search(line)):
                found.append(f"{path.relative_to(ROOT)}:{number}: {match.group()}")
    assert not found, "words that the style guide does not allow"


def test_docstrings_start_with_a_verb_or_a_noun():
    found = []
    for path in PYTHON:
        for node in definitions(path):
            first = (ast.get_docstring(node) or "").partition(" ")[0]
            if first in ("Of", "What", "Where", "Which", "How", "Whether"):
                found.append(f"{path.relative_to(ROOT)}: {getattr(node, 'name', 'module')}: {first}")
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
