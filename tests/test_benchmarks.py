"""What benchmarks read: the public recordings in their own coordinates, and nothing else."""

import importlib.util

import pytest
from repository import ROOT

from dvrk_drake.models.arm import load_arm


@pytest.fixture(scope="module")
def benchmark():
    specification = importlib.util.spec_from_file_location("dynamic", ROOT / "benchmarks" / "dynamic_recordings.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_a_recording_that_is_not_there_is_one_line(benchmark, tmp_path):
    with pytest.raises(SystemExit, match=r"none\.csv: no such file"):
        benchmark.read_public(tmp_path / "none.csv", load_arm("mtmr"))


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "file"), [("mtmr", "mtm_one"), ("psm", "psm_one"), ("psm", "psm_one_no_weight")])
def test_public_recordings_are_read_without_options(benchmark, shared_data, arm, file):
    path = shared_data / "trajectories" / f"{file}.csv"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    assert benchmark.read_public(path, load_arm(arm)).coordinates == "actuator"
