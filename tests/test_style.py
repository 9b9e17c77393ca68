"""Automatic style checks: banned words, docstrings, test names, length of the README."""

import re
import subprocess

from repository import ROOT

#: Words that the style guide does not allow: metaphors, personification and non-standard terms.
BANNED = re.compile(
    r"\b(doubt(s|ed|ful)?|undoubted|trust(s|ed)?|untrusted|told|honest|vouch(es|ed)?|knows|hears|heard|wishes|remembers|"
    r"unrest|felt|feels|leans|leaning|rambling|somebody|whoever|laboratory|true arm|links that can exist|"
    r"one an? (joint|row|period|arm|actuator|pose)|the way there)\b",
    re.IGNORECASE,
)
#: Beginning of a docstring that is neither a verb nor a noun.
NO_VERB = re.compile(r'^ *"""(Of|What|Where|Which|How|Whether) .*', re.MULTILINE)
MAX_TEST_NAME = 60
MAX_README_LINES = 120


def tracked(*patterns):
    names = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in names.splitlines() if not name.endswith("test_style.py")]


PYTHON = tracked("*.py")
TEXTS = [path for path in tracked("*.py", "*.md", "*.yaml") if path.name != "CHANGELOG.md"]


def test_files_contain_no_banned_words():
    found = []
    for path in TEXTS:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if match := BANNED.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {match.group()}")
    assert not found, "words that the style guide does not allow"


def test_only_models_exports_and_recordings_name_frames():
    """All other packages work for any arm. Frames with a purpose are data, see `Arm.frames` and `base_body`."""
    general = [path for path in PYTHON if path.is_relative_to(ROOT / "dvrk_drake")]
    named = [
        str(path.relative_to(ROOT))
        for path in general
        if path.relative_to(ROOT).parts[1] not in ("models", "export", "recordings")
        and re.search(r"\b(dh_\d+|base_link)\b", path.read_text())
    ]
    assert not named


def test_docstrings_start_with_a_verb_or_a_noun():
    found = [
        f"{path.relative_to(ROOT)}: {match.group()}" for path in PYTHON for match in NO_VERB.finditer(path.read_text())
    ]
    assert not found


def test_test_names_are_short():
    text = "".join(path.read_text() for path in tracked("tests/*.py", "tests/**/*.py"))
    assert not [name for name in re.findall(r"def (test_\w+)", text) if len(name) > MAX_TEST_NAME]


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= MAX_README_LINES
