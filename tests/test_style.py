"""Automatic style checks: banned words, docstrings, test names, length of the README, files of the wheel."""

import ast
import re
import subprocess
import tomllib
from pathlib import Path

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


# Tests compare computed numbers with a tolerance, because rounding in BLAS and numba depends on the CPU.


TESTS = Path(__file__).parent
#: Smallest absolute tolerance, 450 times the rounding error of numbers near 1.
MIN_VALUE = 1e-13
#: Functions that compute with BLAS or numba. Tests must not compare their results exactly.
COMPUTED = {"column", "effect_effort", "effort", "holding_torque", "mass_matrix", "predict", "predict_motion"} | {
    *("pull_back_effort", "regressor", "torque")
}


def calls(*names):
    """Yields the location and the syntax node of each call of the named functions in the tests."""
    for path in sorted(TESTS.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and called(node) in names:
                yield f"{path.relative_to(TESTS)}:{node.lineno}", node


def called(node):
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def argument(node, name):
    return next((keyword.value for keyword in node.keywords if keyword.arg == name), None)


def test_comparisons_have_an_absolute_tolerance():
    """A relative tolerance alone fails for numbers that can be zero. `atol=0` declares that they cannot be zero."""
    found = dict(calls("assert_allclose", "isclose", "allclose"))
    assert len(found) > 100
    assert not [place for place, node in found.items() if argument(node, "atol") is None]


def test_tolerances_exceed_rounding_errors():
    found = [(p, argument(n, "atol")) for p, n in calls("assert_allclose", "isclose", "allclose")]
    found += [(p, argument(n, "abs")) for p, n in calls("approx")]
    assert not [p for p, atol in found if isinstance(atol, ast.Constant) and 0 < atol.value < MIN_VALUE]


def test_computed_numbers_are_not_compared_exactly():
    found = list(calls("assert_array_equal", "array_equal"))
    assert found
    assert not [p for p, node in found if {called(n) for n in ast.walk(node) if isinstance(n, ast.Call)} & COMPUTED]


# Public methods of Systems have Drake-style names (`SetGains`), other classes Python-style names (`load_arm`).


SYSTEMS = {"LeafSystem", "Diagram"}
#: Methods that override those of Drake.
OF_DRAKE = {"Serialize", "Deserialize"}


def public_methods():
    """Returns (location, flag of a System, name) of each public method that is not a property."""
    for path in sorted((ROOT / "dvrk_drake").rglob("*.py")):
        if "lcmtypes" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                is_system = any(isinstance(base, ast.Name) and base.id in SYSTEMS for base in node.bases)
                for method in node.body:
                    if isinstance(method, ast.FunctionDef) and not method.name.startswith("_"):
                        names = {d.id for d in method.decorator_list if isinstance(d, ast.Name)}
                        if not names & {"property", "cached_property"}:
                            yield f"{path.name}: {node.name}.{method.name}", is_system, method.name


def test_method_names_follow_the_style():
    methods = list(public_methods())
    assert sum(is_system for _, is_system, _ in methods) > 10
    wrong = [where for where, is_system, name in methods if name[0].isupper() != is_system and name not in OF_DRAKE]
    assert not wrong, wrong


def test_the_wheel_contains_all_files_of_the_package():
    """A moved file would be missing only in an installed package."""
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["dvrk_drake"]
    packed = {path for pattern in patterns for path in (ROOT / "dvrk_drake").glob(pattern)}
    assert not [path for path in tracked("dvrk_drake") if path.suffix != ".py" and path not in packed]
