"""The public API: one import that loads nothing, documented names whose examples run, and README's example."""

import ast
import doctest
import re
import subprocess
import sys

import numpy as np
import pytest
from repository import ROOT

import dvrk_drake as dvrk

#: Packages that take long to import.
SLOW = {"pydrake", "numba", "numpy", "scipy", "sympy", "matplotlib", "rich", "yaml"}


def loaded_by(code: str) -> set[str]:
    """Names of all modules that a process of its own has loaded after `code`."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_the_import_loads_nothing_else():
    loaded = loaded_by("import dvrk_drake; assert 'identify' in dir(dvrk_drake)")
    assert "dvrk_drake" in loaded and not loaded & SLOW
    assert not {name for name in loaded if name.startswith("dvrk_drake.")}


def test_a_name_loads_only_what_it_needs():
    loaded = loaded_by("import dvrk_drake; dvrk_drake.Recording")
    assert "numba" not in loaded and "matplotlib" not in loaded


def test_names_are_the_same_for_type_checkers_and_at_run_time():
    tree = ast.parse((ROOT / "dvrk_drake/__init__.py").read_text())
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    modules = {alias.name: node.module for node in typed.body for alias in node.names}
    assert {name: f"dvrk_drake.{module}" for name, module in dvrk._MODULES.items()} == modules
    assert dvrk.__all__ == sorted(modules)
    packages = {path.stem for path in (ROOT / "dvrk_drake").iterdir()}
    assert not packages & set(modules), "a module would hide the function"


def test_an_unknown_name_is_named():
    with pytest.raises(AttributeError, match="'dvrk_drake' has no attribute 'identifi'"):
        dvrk.identifi  # noqa: B018


@pytest.mark.parametrize("name", dvrk.__all__)
def test_the_example_of_a_name_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    value = getattr(dvrk, name)
    tests = doctest.DocTestFinder(recurse=False).find(value, name, module=False)
    examples = [example for test in tests for example in test.examples]
    assert examples and examples[0].source.startswith("import dvrk_drake as dvrk")
    said = []
    for test in tests:
        doctest.DocTestRunner().run(test, out=said.append)
    assert not said, "".join(said)


def readme_example() -> str:
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    return example


def test_the_readme_example_is_short_and_has_one_import():
    statements = ast.parse(readme_example()).body
    assert len([node for node in ast.walk(ast.Module(statements, [])) if isinstance(node, ast.stmt)]) <= 12
    assert [ast.unparse(n) for n in statements if isinstance(n, ast.Import | ast.ImportFrom)] == [
        "import dvrk_drake as dvrk"
    ]


def test_the_readme_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arm, generator = dvrk.load_arm("mtmr"), np.random.default_rng(0)
    model = dvrk.IdentifiedModel.from_arm(arm)
    for name, count in (("poses.csv", 40), ("other_day.csv", 12)):
        q = arm.sample_poses(count, generator, margin=0.05)
        tau = model.holding_torque(q) + 0.003 * arm.effort_limits * generator.normal(size=q.shape)
        dvrk.write_recording(dvrk.Recording(q=q, tau=tau), name)
    exec(compile(readme_example(), "README.md", "exec"), {})
    assert (tmp_path / "model.yaml").is_file()
    assert "verdict" in capsys.readouterr().out
