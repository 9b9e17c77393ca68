"""Network namespaces for tests over UDP and DDS, and repetition of tests that a stalled computer breaks.

A module whose tests use UDP or DDS begins with

    pytestmark = pytest.mark.network

The tests of each such module run in a forked process of pytest with a network namespace of its own. So they cannot
exchange messages with other modules or with the network of the computer, and no DDS thread remains. Processes that the
tests start share the namespace, except those of a fork server, which call `join_network`. The tests are skipped where
namespaces are not permitted.

Tests wait for conditions, so they also pass on a busy computer. Two kinds of failed tests run again in a new process:

- Tests of a watchdog that uses the wall clock, marked `watchdog`. If the computer is busy for 10 ms, the watchdog acts
  late, and the test fails without a defect.
- Tests that failed while the computer was stalled, so that a sleeping thread was delayed by `STALL_TIME`. Then time
  limits of the processes under test expire, e.g. no status for 1 s.

The last line of a run states the number of repetitions. A run repeats at most `MAX_RETRIES` tests.
"""

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from multiprocessing import forkserver
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol
from waiting import within_time_limit

#: Configures the loopback interface of a new namespace for multicast.
NETWORK = "ip link set lo up && ip link set lo multicast on && ip route add 239.255.0.0/16 dev lo"
#: Maximum number of repetitions in one run of pytest, over all files and tests.
MAX_RETRIES = 4
#: Delay of a sleeping thread that occurs only if the computer is stalled [s].
STALL_TIME = 0.4
#: Flags of the system calls, see unshare(2) and prctl(2).
_NEW_USER, _NEW_NETWORK, _SET_CHILD_SUBREAPER = 0x10000000, 0x40000000, 36

_LIBC = ctypes.CDLL(None, use_errno=True)
_RETRIES = pytest.StashKey[list]()
_PROCESS = pytest.StashKey["_Process"]()
#: Name of the list of repetitions that a worker of pytest-xdist returns.
_OF_WORKER = "dvrk_drake_retries"


def enter_network():
    """Moves this thread, and the threads and processes that it starts, into a new network namespace.

    Raises:
        OSError: Namespaces are not permitted, or the loopback interface cannot be configured.
    """
    if _LIBC.unshare(_NEW_NETWORK):
        # A user without permission may create namespaces inside a user namespace, while the process has one thread.
        user, group = os.getuid(), os.getgid()
        if _LIBC.unshare(_NEW_USER | _NEW_NETWORK):
            raise OSError(ctypes.get_errno(), "network namespaces are not permitted")
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    try:
        subprocess.run(["sh", "-c", NETWORK], check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        raise OSError(error.stderr) from None


def join_network(pid):
    """Moves this thread into the network namespace of another process."""
    with open(f"/proc/{pid}/ns/net") as namespace:
        if _LIBC.setns(namespace.fileno(), _NEW_NETWORK):
            raise OSError(ctypes.get_errno(), "setns failed")


def _children():
    """Returns the processes whose parent is this process."""
    return [int(pid) for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item):
    """Runs the tests with the marker `network` of a module in a process of its own when it runs the first of them."""
    if not item.get_closest_marker("network"):
        return None
    stash, module = item.config.stash, item.getparent(pytest.Module)
    retries = stash.setdefault(_RETRIES, [])
    process = stash.get(_PROCESS, None)
    if process is None or item not in process.pending:
        tests = [item]
        if not hasattr(item.config, "workerinput"):  # a worker of pytest-xdist does not run all tests of a module
            after = item.session.items[item.session.items.index(item) + 1 :]
            tests += [other for other in after if other.getparent(pytest.Module) is module]
        process = stash[_PROCESS] = _Process(tests)
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports, delay = process.results(item)
    while any(report.failed for report in reports) and len(retries) < MAX_RETRIES:
        if not item.get_closest_marker("watchdog") and delay < STALL_TIME:
            break
        retries.append(item.name)
        following = process.pending
        process.stop()
        process = stash[_PROCESS] = _Process([item, *following])
        reports, delay = process.results(item)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


class _Process:
    """Forked process that runs tests of one module in a network namespace.

    Attributes:
        pending: Tests whose results were not received yet, in order.
    """

    def __init__(self, items):
        self.pending = list(items)
        if "arm_processes" in sys.modules:
            forkserver.ensure_running()  # one fork server for the processes of all modules
        # The parent of a deadman process is a bridge, which a test may kill. Then this process becomes its parent.
        _LIBC.prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._others = set(_children())
        self._connection, other_end = multiprocessing.Pipe()
        self._pid = os.fork()
        if self._pid == 0:
            self._connection.close()
            try:
                self._run(items, other_end)
            finally:
                os._exit(0)
        other_end.close()

    def results(self, item):
        """Runs the next test. Returns its reports, and the longest delay of a sleeping thread meanwhile [s].

        No test begins before, so none runs beside the repetition of another one.
        """
        assert item is self.pending.pop(0)
        try:
            self._connection.send(True)
            data, delay = self._connection.recv()
            reports = [item.config.hook.pytest_report_from_serializable(config=item.config, data=each) for each in data]
        except (EOFError, OSError):
            self.pending = []
            problem = f"the process of the test ended: {self._end()}"
            return [pytest.TestReport(item.nodeid, item.location, {}, "failed", problem, "call")], 0.0
        if not self.pending:
            self._end()
        return reports, delay

    def stop(self):
        """Ends the process without its pending tests."""
        if self.pending:
            self.pending = []
            self._connection.send(False)
            self._end()

    def _end(self):
        """Waits for the end of the process, ends processes that remain, and returns the exit code."""
        status = os.waitpid(self._pid, 0)[1]
        for pid in set(_children()) - self._others:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        return os.waitstatus_to_exitcode(status)

    @staticmethod
    def _run(items, connection):
        try:
            enter_network()
        except OSError as error:
            mark = pytest.mark.skip(reason=f"needs a network namespace (unshare, ip): {error}")
            for item in items:
                item.add_marker(mark)
        # The fork server is a child of the parent, so this process cannot wait for it.
        forkserver._forkserver.ensure_running = lambda: None
        for item, following in zip(items, [*items[1:], items[0].session], strict=True):
            try:
                may_start = connection.recv()
            except EOFError:  # pytest ends at a failure
                may_start = False
            if not may_start:
                with suppress(Exception):  # a fixture of the failed test may be damaged
                    item.session._setupstate.teardown_exact(item.session)
                return
            with _LongestDelay() as delay:
                reports = runtestprotocol(item, log=False, nextitem=following)
            hook = item.config.hook
            data = [hook.pytest_report_to_serializable(config=item.config, report=report) for report in reports]
            connection.send((data, delay.seconds))


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


def pytest_sessionfinish(session):
    """Returns the repetitions of a worker to the process that started it."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput[_OF_WORKER] = session.config.stash.get(_RETRIES, [])


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """Receives the repetitions of a worker."""
    node.config.stash.setdefault(_RETRIES, []).extend(getattr(node, "workeroutput", {}).get(_OF_WORKER, []))


def pytest_terminal_summary(terminalreporter, config):
    """Prints the number of repetitions if tests with the marker `network` ran."""
    retries = config.stash.get(_RETRIES, None)
    if retries is not None:
        names = f": {', '.join(retries)}" if retries else ""
        count = f"{len(retries)} {'retry' if len(retries) == 1 else 'retries'}"
        terminalreporter.write_line(f"Network tests: {count} of at most {MAX_RETRIES}{names}")


def start(*arguments):
    """Starts a process whose output can be read after it has ended."""
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end(process, number=signal.SIGKILL):
    """Ends a process and returns its output."""
    process.send_signal(number)
    process.wait(60)
    return within_time_limit(process.stdout.read, "end of the output")
