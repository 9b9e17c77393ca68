"""Failed UDP tests are repeated and counted: watchdog tests, and all tests during a standstill of the computer."""

import os
import re
import subprocess
import sys

import pytest
from own_network import INSIDE, MAX_RETRIES
from repository import ROOT
from waiting import TIMEOUT

FILE = '''
from pathlib import Path

import own_network
from own_network import inside, outside, run_inside, watchdog

own_network.unshare, own_network.NETWORK = lambda: ["env"], "true"
own_network.STALL_TIME = {standstill}


@outside
def test_outside(request):
    run_inside(request)


def fail(times, name):
    """Fails `times` times, then passes."""
    path = Path(__file__).with_name(name)
    runs = len(path.read_text()) if path.exists() else 0
    path.write_text((runs + 1) * ".")
    assert runs >= times


@inside
def test_steady():
    fail({steady}, "steady")


@inside
@watchdog
def test_watchdog():
    fail({late}, "late")
'''


@pytest.mark.parametrize(
    ("steady", "late", "standstill", "passes", "retries", "runs"),
    [
        (0, 1, 1e9, True, "1 retry", (1, 2)),
        (0, 100, 1e9, False, f"{MAX_RETRIES} retries", (1, 1 + MAX_RETRIES)),
        (1, 1, 1e9, False, "0 retries", (1, 1)),
        (1, 1, 0.0, True, "2 retries", (2, 2)),
        (100, 0, 0.0, False, f"{MAX_RETRIES} retries", (1 + MAX_RETRIES, 1)),
    ],
)
def test_failed_tests_are_repeated_and_counted(tmp_path, steady, late, standstill, passes, retries, runs):
    path = tmp_path / "test_some_udp.py"
    text = FILE
    for name, value in (("steady", steady), ("late", late), ("standstill", standstill)):
        text = text.replace("{" + name + "}", str(value))
    path.write_text(text)
    command = [sys.executable, "-m", "pytest", "-c", ROOT / "pyproject.toml", "-p", "own_network"]
    environment = {name: value for name, value in os.environ.items() if name != INSIDE}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # pytest starts faster
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "tests/support"), *sys.path])
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", path],
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert done.returncode == (0 if passes else 1), done.stdout
    summary = re.search(r"^UDP tests: (.*) of at most (\d+)(: .*)?$", done.stdout, re.MULTILINE)
    assert summary[1] == retries and summary[2] == str(MAX_RETRIES)
    assert [len((tmp_path / name).read_text()) for name in ("steady", "late")] == list(runs)
    if not passes:
        assert f"failed: test_{'steady' if steady else 'watchdog'}" in done.stdout
