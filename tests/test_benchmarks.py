"""Tests of the benchmarks: imports, reading of public recordings, timing and tables."""

import ast
import importlib
import importlib.util

import pytest
from repository import ROOT

from dvrk_drake.models.arm_files import load_arm


def load_script(name):
    specification = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def benchmark():
    return load_script("dynamic_recordings")


@pytest.mark.parametrize("path", [*ROOT.glob("benchmarks/*.py"), *ROOT.glob("tools/*.py")], ids=lambda path: path.name)
def test_scripts_import_existing_names(path):
    """Detects a script that nobody adapted to a change of the package, without running it for minutes."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dvrk_drake"):
            module = importlib.import_module(node.module)
            missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
            assert not [name for name in missing if importlib.util.find_spec(f"{node.module}.{name}") is None]


def test_functions_are_timed_alternately_after_a_warm_up():
    timing = load_script("timing")
    calls, clock = [], iter(range(100))
    functions = {name: lambda name=name: calls.append(name) for name in ("a", "b")}
    times = timing.measured_times(
        functions, 2, prepare=lambda name: calls.append(f"before {name}"), clock=lambda: next(clock)
    )
    assert calls == ["before a", "a", "before b", "b"] * 3
    assert {name: len(values) for name, values in times.items()} == {"a": 2, "b": 2}


def test_missing_recording_gives_one_line(benchmark, tmp_path):
    with pytest.raises(SystemExit, match=r"none\.csv: no such file"):
        benchmark.read_public(tmp_path / "none.csv", load_arm("mtmr"))


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "file"), [("mtmr", "mtm_one"), ("psm", "psm_one"), ("psm", "psm_one_no_weight")])
def test_public_recordings_are_read_without_options(benchmark, shared_data, arm, file):
    path = shared_data / "trajectories" / f"{file}.csv"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    assert benchmark.read_public(path, load_arm(arm)).coordinates == "joint"
