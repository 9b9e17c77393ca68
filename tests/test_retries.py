"""Failed network tests are repeated and counted: watchdog tests, and all tests during a standstill of the computer."""

import os
import re
import subprocess
import sys

import pytest
from own_network import MAX_RETRIES
from repository import ROOT
from waiting import TIMEOUT

FILE = '''
from pathlib import Path

import own_network
import pytest

own_network.enter_network = lambda: None
own_network.STALL_TIME = {standstill}
pytestmark = pytest.mark.network


@pytest.fixture(scope="module")
def setups():
    """Counts how often fixtures of the module were created."""
    fail(0, "setups")


def fail(times, name):
    """Fails `times` times, then passes."""
    path = Path(__file__).with_name(name)
    runs = len(path.read_text()) if path.exists() else 0
    path.write_text((runs + 1) * ".")
    assert runs >= times


def test_steady(setups):
    fail({steady}, "steady")


@pytest.mark.watchdog
def test_watchdog(setups):
    fail({late}, "late")
'''


def run(path, *options):
    """Runs pytest with the plugin of network tests for one file. Returns the ended process."""
    command = [sys.executable, "-m", "pytest", "-c", ROOT / "pyproject.toml", "-p", "own_network", *options]
    environment = dict(os.environ)
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # pytest starts faster
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "tests/support"), *sys.path])
    return subprocess.run(
        [*command, "-p", "no:cacheprovider", path],
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )


@pytest.mark.parametrize(
    ("steady", "late", "standstill", "failed", "retries", "runs", "workers"),
    [
        (0, 1, 1e9, 0, "1 retry", (1, 2, 2), 0),
        (0, 1, 1e9, 0, "1 retry", (1, 2, 3), 1),
        (0, 100, 1e9, 1, f"{MAX_RETRIES} retries", (1, 1 + MAX_RETRIES, 1 + MAX_RETRIES), 0),
        (1, 1, 1e9, 1, "1 retry", (1, 2, 2), 0),
        (1, 1, 0.0, 0, "2 retries", (2, 2, 3), 0),
        (100, 0, 0.0, 1, f"{MAX_RETRIES} retries", (1 + MAX_RETRIES, 1, 1 + MAX_RETRIES), 0),
    ],
)
def test_failed_tests_are_repeated_and_counted(tmp_path, steady, late, standstill, failed, retries, runs, workers):
    path = tmp_path / "test_some_network.py"
    text = FILE
    for name, value in (("steady", steady), ("late", late), ("standstill", standstill)):
        text = text.replace("{" + name + "}", str(value))
    path.write_text(text)
    done = run(path, *(["-p", "xdist", "-n", str(workers)] if workers else []))
    assert done.returncode == (1 if failed else 0), done.stdout
    summary = re.search(r"^Network tests: (.*) of at most (\d+)(: .*)?$", done.stdout, re.MULTILINE)
    assert summary[1] == retries and summary[2] == str(MAX_RETRIES)
    assert [len((tmp_path / name).read_text()) for name in ("steady", "late", "setups")] == list(runs)
    assert f"{2 - failed} passed" in done.stdout
    if failed:
        assert f"::test_{'steady' if steady else 'watchdog'} - " in done.stdout


def test_end_of_the_process_fails_the_test(tmp_path):
    path = tmp_path / "test_some_network.py"
    path.write_text(
        "import os, own_network, pytest\n"
        "own_network.enter_network = lambda: None\n"
        "pytestmark = pytest.mark.network\n"
        "def test_end(): os.abort()\n"
        "def test_next(): pass\n"
    )
    done = run(path)
    assert done.returncode == 1
    assert "the process of the test ended: -6" in done.stdout and "1 failed, 1 passed" in done.stdout
