"""Network namespace for tests over real UDP multicast.

A test file starts pytest again for itself inside a network namespace. The actual tests run there:

    @outside
    def test_runs_in_a_separate_network(request):
        run_inside(request)

    @inside
    def test_...

Tests wait for conditions, so they also pass on a busy computer. Two kinds of failed tests run again in a new process:

- Tests of a watchdog that uses the wall clock, marked `@watchdog`. If the computer is busy for 10 ms, the watchdog acts
  late, and the test fails without a defect.
- Tests that failed while the computer was stalled, so that a sleeping thread was delayed by `STALL_TIME`. Then time
  limits of the processes under test expire, e.g. no status for 1 s.

The last line of a run states the number of retries. A run with more than `MAX_RETRIES` fails.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest
from waiting import within_time_limit

INSIDE = "DVRK_DRAKE_OWN_NETWORK"
PROCESSES = ("--pid", "--mount-proc", "--kill-child")
NETWORK = "ip link set lo up && ip link set lo multicast on && ip route add 239.255.0.0/16 dev lo"
#: Maximum number of retries in one run of pytest, over all files and tests.
MAX_RETRIES = 4
#: Delay of a sleeping thread that occurs only if the computer is stalled [s].
STALL_TIME = 0.4
#: Time limit of a run inside the namespace [s].
MAX_RUN = 1800

inside = pytest.mark.skipif(INSIDE not in os.environ, reason="runs in a network namespace, started by the test below")
outside = pytest.mark.skipif(INSIDE in os.environ, reason="already inside the network namespace")
watchdog = pytest.mark.watchdog

_RETRIES = pytest.StashKey[list]()


def unshare():
    """Returns the command that creates a network namespace. It keeps the permission for real-time scheduling.

    If permitted, the command also creates a process namespace, which ends all its processes with the command. A deadman
    process whose arm has ended would otherwise remain.
    """
    for command in (
        ["unshare", "-n", *PROCESSES],
        ["unshare", "-rn", *PROCESSES],
        ["unshare", "-n"],
        ["unshare", "-rn"],
    ):
        try:
            done = subprocess.run([*command, "sh", "-c", NETWORK], capture_output=True, timeout=60, check=False)
        except OSError:
            continue
        if done.returncode == 0:
            return command
    pytest.skip("network namespaces are not permitted here (unshare -rn, ip)")


def run_inside(request):
    """Runs the test file of `request` in a network namespace. Some failed tests run again, see the module."""
    marks = {name: getattr(test, "pytestmark", []) for name, test in vars(request.module).items()}
    watchdogs = {name for name, own_marks in marks.items() if watchdog.mark in own_marks}
    retries = request.config.stash.setdefault(_RETRIES, [])
    with tempfile.TemporaryDirectory() as cache_folder:
        while True:
            with _LongestDelay() as delay:
                failed = _run(request.path, cache_folder)
            if not failed:
                break
            steady = {name.partition("[")[0] for name in failed} - watchdogs
            if steady and delay.seconds < STALL_TIME:
                raise AssertionError(f"failed: {', '.join(failed)}")
            if len(retries) + len(failed) > MAX_RETRIES:
                raise AssertionError(f"failed: {', '.join(failed)}, after {len(retries)} retries")
            retries += failed


class _LongestDelay:
    """Context that measures the longest delay of a sleeping thread, `seconds`."""

    def __enter__(self):
        self.seconds, self._ended = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self):
        before = time.monotonic()
        while not self._ended.wait(0.01):
            now = time.monotonic()
            self.seconds, before = max(self.seconds, now - before - 0.01), now

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()


def pytest_terminal_summary(terminalreporter, config):
    """Prints the number of retries if tests over UDP ran."""
    retries = config.stash.get(_RETRIES, None)
    if retries is not None:
        names = f": {', '.join(retries)}" if retries else ""
        count = f"{len(retries)} {'retry' if len(retries) == 1 else 'retries'}"
        terminalreporter.write_line(f"UDP tests: {count} of at most {MAX_RETRIES}{names}")


def _run(test_file, cache_folder):
    """Runs the tests that failed last (at first: all) and returns the names of the tests that failed now."""
    # The shell remains, because it must wait for the orphans of the process namespace.
    command = [*unshare(), "sh", "-c", f'{NETWORK} && "$@"; exit $?', "sh"]
    pytest_run = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:xdist",
        "-rsfE",
        "-s",
        "-o",
        f"cache_dir={cache_folder}",
        "--lf",
    ]
    environment = {**os.environ, INSIDE: "1", "OMP_NUM_THREADS": "1"}
    # The fork server imports the modules to compile from this path.
    paths = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    environment.pop("LCM_DEFAULT_URL", None)
    done = subprocess.run(
        [*command, *pytest_run, test_file],
        env=environment,
        capture_output=True,
        text=True,
        timeout=MAX_RUN,
        check=False,
    )
    print(done.stdout[-6000:], done.stderr[-3000:])
    if not done.returncode:
        return []
    failed = re.findall(r"^(?:FAILED|ERROR) \S*::(\S+)", done.stdout, re.MULTILINE)
    return failed or [f"exit code {done.returncode}"]


def start(*arguments):
    """Starts a process whose output can be read after it has ended."""
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end(process, number=signal.SIGKILL):
    """Ends a process and returns its output."""
    process.send_signal(number)
    process.wait(60)
    return within_time_limit(process.stdout.read, "end of the output")
