"""Tests over UDP that fail: watchdogs run again and are counted, all others do not."""

import os
import re
import subprocess
import sys

import pytest
from own_network import INSIDE, MOST_RETRIES
from patience import PATIENCE
from repository import ROOT

FILE = '''
from pathlib import Path

import own_network
from own_network import inside, outside, run_inside, watchdog

own_network.unshare, own_network.NETWORK = lambda: ["env"], "true"


@outside
def test_outside(request):
    run_inside(request)


def fail(times, name):
    """Fails so often, then passes."""
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
    ("steady", "late", "passes", "retries", "runs"),
    [
        (0, 1, True, "1 retry", (1, 2)),
        (0, 100, False, f"{MOST_RETRIES} retries", (1, 1 + MOST_RETRIES)),
        (1, 1, False, "0 retries", (1, 1)),
    ],
)
def test_only_watchdogs_run_again_and_are_counted(tmp_path, steady, late, passes, retries, runs):
    path = tmp_path / "test_some_udp.py"
    path.write_text(FILE.replace("{steady}", str(steady)).replace("{late}", str(late)))
    command = [sys.executable, "-m", "pytest", "-c", ROOT / "pyproject.toml", "-p", "own_network"]
    environment = {name: value for name, value in os.environ.items() if name != INSIDE}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # half of the time that pytest takes to start
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "tests/support"), *sys.path])
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", path],
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == (0 if passes else 1), done.stdout
    said = re.search(r"^UDP tests: (.*) of at most (\d+)(: .*)?$", done.stdout, re.MULTILINE)
    assert said[1] == retries and said[2] == str(MOST_RETRIES)
    assert [len((tmp_path / name).read_text()) for name in ("steady", "late")] == list(runs)
    if not passes:
        assert f"failed: test_{'steady' if steady else 'watchdog'}" in done.stdout
