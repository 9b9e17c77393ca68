"""A network of their own for tests over real UDP multicast.

A test file starts itself again inside a network namespace; the tests of that run are the real ones:

    @outside
    def test_in_a_network_of_its_own():
        run_inside(__file__)

    @inside
    def test_...
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import pytest

INSIDE = "DVRK_DRAKE_OWN_NETWORK"
NETWORK = "ip link set lo up && ip link set lo multicast on && ip route add 239.255.0.0/16 dev lo"

inside = pytest.mark.skipif(INSIDE not in os.environ, reason="runs in a network of its own, started by the test below")
outside = pytest.mark.skipif(INSIDE in os.environ, reason="is inside already")


def unshare():
    """How to get a network of one's own; real root keeps its right to real-time scheduling that way."""
    for command in (["unshare", "-n"], ["unshare", "-rn"]):
        try:
            done = subprocess.run([*command, "sh", "-c", NETWORK], capture_output=True, timeout=20, check=False)
        except OSError:
            continue
        if done.returncode == 0:
            return command
    pytest.skip("a network of its own is not permitted here (unshare -rn, ip)")


def run_inside(test_file, seconds=200, attempts=3):
    """Runs a test file in a network of its own; what failed is run again in a new process, and that is said.

    The processes want to run every millisecond: a machine that is busy with something else for 50 ms makes a watchdog
    do what it is for, and a test fail that is right. A defect fails every time.
    """
    with tempfile.TemporaryDirectory() as memory:
        for attempt in range(1, attempts + 1):
            failed = _run(test_file, seconds, memory)
            if not failed:
                return
            warnings.warn(f"{Path(test_file).name}, attempt {attempt}: {failed}", stacklevel=1)
    raise AssertionError(f"{attempts} attempts failed: {failed}")


def _run(test_file, seconds, memory):
    """Runs what failed last (at first: everything) and gives the names of the tests that failed now."""
    command = [*unshare(), "sh", "-c", f'{NETWORK} && exec "$@"', "sh"]
    pytest_run = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-rsfE", "-s", "-o", f"cache_dir={memory}", "--lf"]
    environment = {**os.environ, INSIDE: "1", "OMP_NUM_THREADS": "1"}
    # Where a process that others are forked from finds what it compiles.
    paths = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    environment.pop("LCM_DEFAULT_URL", None)
    done = subprocess.run(
        [*command, *pytest_run, test_file],
        env=environment,
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    print(done.stdout[-6000:], done.stderr[-3000:])
    failed = re.findall(r"^(?:FAILED|ERROR) \S*::(\S+)", done.stdout, re.MULTILINE)
    return (
        ", ".join(failed) if done.returncode and failed else f"exit code {done.returncode}" if done.returncode else ""
    )


def start(*arguments):
    """A process whose output can be read when it has ended."""
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end(process, number=signal.SIGKILL):
    """Ends it and gives what it said."""
    process.send_signal(number)
    process.wait(20)
    return process.stdout.read()
