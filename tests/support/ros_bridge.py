"""Bridge process and monitor of its ROS topics, for tests and benchmarks in a network namespace."""

import subprocess
import sys
import threading
from pathlib import Path

from effort_controller import LENIENT_DRIVER
from waiting import TIMEOUT, wait_until


class LoggedProcess:
    """Process whose output lines are stored while it runs.

    Attributes:
        lines: Lines of its output so far.
    """

    def __init__(self, *arguments):
        command = [sys.executable, "-u", *map(str, arguments)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.lines = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))

    @property
    def pid(self):
        return self.process.pid

    def poll(self):
        return self.process.poll()

    def wait_for(self, text, after=0):
        """Waits until a line after the first `after` lines contains a text. Returns this line."""

        def find():
            return next((line for line in self.lines[after:] if text in line), None)

        try:
            wait_until(find, text, self.process)
        except AssertionError as error:
            raise AssertionError(f"{error}; output: {self.lines}") from error
        return find()

    def wait(self):
        """Waits until the process ends. Returns its exit code, after its last output is stored."""
        code = self.process.wait(TIMEOUT)
        # A deadman process of a killed bridge may still write.
        self._thread.join(5.0)
        return code

    def end(self, number):
        """Sends a signal and waits until the process ends. Returns its exit code."""
        if self.poll() is None:
            self.process.send_signal(number)
        return self.wait()


def start_bridge(arm, folder, *options):
    """Starts `dvrk-drake bridge` with a lenient guard; see `LENIENT_DRIVER`."""
    driver = Path(folder) / "lenient.yaml"
    driver.write_text(LENIENT_DRIVER)
    return LoggedProcess("-m", "dvrk_drake.cli", "bridge", "--arm", arm, "--driver", driver, *options)


class CommandMonitor:
    """Subscriptions of the topics with which a bridge commands an arm.

    Attributes:
        messages: Received messages so far, each (name of the topic, time of publication [ns since 1970], message).
    """

    def __init__(self, domain, namespace, *more):
        from dvrk_drake.systems.ros.messages import Empty, JointState

        kinds = {"hold": Empty, "servo_jp": JointState, "servo_jf": JointState, **dict.fromkeys(more, JointState)}
        self.messages = []
        self._subscriptions = {
            name: domain.subscribe(f"{namespace}/{name}", kind, depth=10_000) for name, kind in kinds.items()
        }

    def receive(self):
        """Stores the messages that have arrived. Returns all messages so far."""
        for name, subscription in self._subscriptions.items():
            self.messages += [(name, sent, message) for message, sent in subscription.take()]
        return self.messages

    def first(self, names, after):
        """Returns the time of the first message of the given topics after a time [ns since 1970], or None."""
        times = [sent for name, sent, _ in self.receive() if name in names and sent >= after]
        return min(times, default=None)

    def acts_until(self, time):
        """Returns whether the last command before a time [ns since 1970] is an effort that is at most 20 ms old."""
        before = [(sent, name) for name, sent, _ in self.receive() if sent < time]
        return bool(before) and max(before)[1] == "servo_jf" and time - max(before)[0] < 20_000_000

    def forget(self):
        """Deletes all messages so far."""
        self.receive()
        self.messages.clear()
