"""Tests compare computed numbers with a tolerance, because rounding in BLAS and numba depends on the CPU."""

import ast
from pathlib import Path

TESTS = Path(__file__).parent
#: Smallest absolute tolerance, 450 times the rounding error of numbers near 1.
MIN_VALUE = 1e-13
#: Functions that compute with BLAS or numba. Tests must not compare their results exactly.
COMPUTED = {"column", "effect_effort", "effort", "holding_torque", "mass_matrix", "predict", "predict_motion"} | {
    *("pull_back_effort", "regressor", "torque"),
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
