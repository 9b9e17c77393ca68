"""Deadman process: commands a dVRK arm to hold its pose when the commands to the arm stop.

A dVRK has no time-out for commands. Without this process, the last effort acts until another command arrives. The
process needs neither the arm's model nor LCM, so that few faults can affect it.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from dvrk_drake.systems.ros.domain import RosDomain

#: Time between two attempts without confirmation [s].
_INTERVAL = 0.25
#: Time without a command after which the arm is commanded to hold its pose [s].
TIMEOUT = 0.05
#: Time between two checks for commands, and between two checks of the connection to the arm [s].
_POLL, _CONNECTION = 0.005, 0.05
#: Time without a confirmation of `hold` after which the process prints a warning [s]. It prints the next warnings after
#: 2, 4, 8, ... times this time.
_CONFIRMATION = 2.0
#: Longest time until a new deadman process is ready [s]. Longest time until it has ended [s].
_START, _END = 20.0, 4.0
#: Longest time between two reports of the deadman process [s]: 20 times the period, for a busy computer on which the
#: process has no real-time priority.
_SILENCE = 1.0
#: Lines with which the process reports whether it receives the commands of the bridge and can hold the arm.
_READY, _BLIND = "ready", "blind"
#: Real-time priority, above that of the other processes of this package.
_PRIORITY = 60


def repeat_until_confirmed(attempt: Callable[[float], bool], is_over: Callable[[], bool]) -> bool:
    """Repeats an attempt to send a message until two attempts in succession are confirmed. Returns whether they are.

    One confirmation is not sufficient. A subscription that DDS discovers again after a loss of the network does not
    receive the messages that were published before, but confirms them.

    Args:
        attempt: Function that publishes the message, and waits for its confirmation at most the given time [s]. It
            returns whether the arm is connected and has confirmed the message.
        is_over: Function that returns whether to stop. It is called after each attempt without confirmation.
    """
    missing = 2
    while missing:
        begin = time.monotonic()
        if attempt(_INTERVAL):
            missing -= 1
            continue
        missing = 2
        if is_over():
            return False
        time.sleep(max(0.0, begin + _INTERVAL - time.monotonic()))
    return True


class Deadman:
    """Publishes `hold` when an arm has received no command on servo_jf or servo_jp for 50 ms.

    The process that sends commands ends them with `hold`. Without further commands, the deadman then does nothing.

    The deadman repeats `hold` without a time limit until the arm has confirmed it, e.g. after a loss of the network.
    DDS confirms that the arm's process has received the message, not that the arm holds. If operating_state is not
    ENABLED, the deadman publishes `hold` without waiting for a confirmation, because this state may be that of another
    process.
    """

    def __init__(self, domain: RosDomain, namespace: str, report: Callable[[str], None]) -> None:
        """Subscribes to the commands of an arm.

        Args:
            domain: ROS domain of the arm.
            namespace: Namespace of the topics, e.g. "/MTML".
            report: Function that is called with one line when `hold` is published, and while it is not confirmed.
        """
        from dvrk_drake.systems.ros.messages import Empty, JointState, OperatingState

        self._namespace, self._report, self._empty = namespace, report, Empty()
        self._commands = [
            domain.subscribe(f"{namespace}/{name}", JointState, wakes=False) for name in ("servo_jf", "servo_jp")
        ]
        self._ends = domain.subscribe(f"{namespace}/hold", Empty, ignore_own=True, wakes=False)
        self._state = domain.subscribe(
            f"{namespace}/operating_state", OperatingState, depth=100, latched=True, wakes=False
        )
        self._hold = domain.advertise(f"{namespace}/hold", Empty)
        self._last_command: float | None = None
        self._last_published = 0
        self._is_enabled, self._is_confirmed = True, False

    def is_connected(self) -> bool:
        """Returns whether the arm receives `hold`, and a process publishes the commands."""
        return self._has_arm() and all(command.num_publishers() for command in self._commands)

    def run(
        self,
        stopped: Callable[[], bool],
        bridge: int | None = None,
        report_connected: Callable[[bool], None] = lambda connected: None,
    ) -> None:
        """Monitors the commands until `stopped` returns true, or until the bridge process has ended and the arm holds.

        Args:
            stopped: Function that returns whether to stop. With a bridge, it only ends the repetition of `hold`.
            bridge: File descriptor of a pipe from the bridge process. The end of this process closes the pipe. The
                bridge process writes to it before its end if the arm has confirmed the last `hold` of the bridge. None:
                there is no such pipe.
            report_connected: Function that is called with `is_connected` every 0.05 s, also as a sign of life.
        """
        pipes = [] if bridge is None else [bridge]
        next_check = 0.0

        def is_over() -> bool:
            nonlocal next_check
            if (now := time.monotonic()) >= next_check:
                next_check = now + _CONNECTION
                report_connected(self.is_connected())
            return stopped()

        while not is_over() or pipes:
            ended = bool(select.select(pipes, [], [], _POLL)[0])
            self._update(time.monotonic())
            silence = 0.0 if self._last_command is None else time.monotonic() - self._last_command
            if silence > TIMEOUT:
                self._hold_arm(f"no command for {1e3 * silence:.0f} ms", is_over)
            if ended:
                has_commanded = self._is_enabled or self._last_command is not None
                if not os.read(pipes[0], 1) and has_commanded and not self._is_confirmed:
                    self._hold_arm("the bridge has ended", is_over)
                return

    def _update(self, now: float) -> None:
        for subscription in self._commands:
            for _, published in subscription.take():
                self._last_command, self._last_published = now, max(published, self._last_published)
                self._is_confirmed = False
        holds = [published for _, published in self._ends.take()]
        self._update_state()
        if holds and max(holds) >= self._last_published:
            self._last_command = None

    def _update_state(self) -> None:
        for state, _ in self._state.take():
            self._is_enabled = state.state == "ENABLED"

    def _has_arm(self) -> bool:
        # The bridge also subscribes to `hold`.
        return bool(self._hold.subscriber_participants() & self._state.publisher_participants())

    def _hold_arm(self, reason: str, is_over: Callable[[], bool]) -> None:
        """Publishes `hold` until the arm has confirmed it."""
        self._last_command = None
        start, next_warning, report = time.monotonic(), _CONFIRMATION, self._report

        def attempt(longest: float) -> bool:
            nonlocal reason
            try:
                self._hold.publish(self._empty)
            except DvrkDrakeError:
                return False
            if reason:
                report(f"deadman: {self._namespace}: {reason}; published hold at {time.time():.3f} s")
                reason = ""
            return self._hold.wait_until_received(longest) and self._has_arm()

        def is_unnecessary() -> bool:
            nonlocal next_warning
            if (waited := time.monotonic() - start) >= next_warning:
                next_warning = 2 * waited
                report(
                    f"deadman: {self._namespace}: the arm has not confirmed hold for {waited:.0f} s. "
                    f"PRESS THE STOP BUTTON. Process {os.getpid()} continues to send hold"
                )
            self._update_state()
            return is_over() or not self._is_enabled

        self._is_confirmed = repeat_until_confirmed(attempt, is_unnecessary)
        if next_warning > _CONFIRMATION:
            result = "the arm has confirmed hold now" if self._is_confirmed else "stopped to send hold"
            report(f"deadman: {self._namespace}: {result}")


class DeadmanProcess:
    """Deadman process for one bridge. It continues after `kill -9` of the bridge, and ends after it has held the arm.

    Attributes:
        pid: Identifier of the process.
    """

    def __init__(self, namespace: str, domain: int | None, stopped: Callable[[], bool] = lambda: False) -> None:
        """Starts the process and waits until it receives commands; see `Deadman`.

        Args:
            namespace: Namespace of the topics, e.g. "/MTML".
            domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
            stopped: Function that returns whether to end the start, e.g. after Ctrl-C. It is called every 0.05 s.

        Raises:
            DvrkDrakeError: The process did not start, or its start was stopped. It has ended.
        """
        command = [sys.executable, "-m", __name__, namespace, "" if domain is None else str(domain)]
        # A session of its own, so that Ctrl-C in a terminal ends only the bridge.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True, bufsize=0
        )
        self.pid, self._is_blind, self._last_report = self._process.pid, False, time.monotonic()
        is_ready = False
        try:
            end = time.monotonic() + _START
            # The first reports may be from before the connection to the topics of the arm.
            while not is_ready and self._process.poll() is None and not stopped() and time.monotonic() < end:
                is_ready = self._has_line(_CONNECTION) and self._is_ready()
            is_ready = is_ready and not stopped()
        finally:
            if not is_ready:
                # The bridge has not commanded the arm. So the process must end without `hold`.
                self._process.kill()
                self.close()
        if stopped():
            raise DvrkDrakeError("the start of the deadman process was stopped; no command was sent to the arm")
        if not is_ready:
            raise DvrkDrakeError("the deadman process did not start. Without it, the bridge commands no arm")

    def problem(self) -> str:
        """Returns a text if the process has ended or receives no commands, or "" while it can hold the arm."""
        if self._process.poll() is not None:
            return "the deadman process has ended. Restart the bridge"
        if self._has_line(0.0):
            self._is_blind, self._last_report = not self._is_ready(), time.monotonic()
        elif time.monotonic() - self._last_report > _SILENCE:
            return f"the deadman process {self.pid} does not respond. Restart the bridge"
        return "the deadman process is not connected to the topics of the arm" if self._is_blind else ""

    def _has_line(self, seconds: float) -> bool:
        """Waits at most `seconds` [s] until the process has written a line or ended. Returns whether it has."""
        assert self._process.stdout is not None
        return bool(select.select([self._process.stdout], [], [], seconds)[0])

    def _is_ready(self) -> bool:
        """Returns whether the last line that the process has written is `_READY`."""
        assert self._process.stdout is not None
        return self._process.stdout.read(4096).split()[-1:] == [_READY.encode()]

    def close(self, *, is_confirmed: bool = True) -> None:
        """Ends the process.

        Args:
            is_confirmed: Whether the arm has confirmed `hold`. If not, the process sends `hold` until the arm confirms
                it, also after the end of the bridge.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError), self._process.stdin:  # the process may have ended
            if is_confirmed:
                self._process.stdin.write(b"\0")
        self._process.stdout.close()
        if not is_confirmed:
            return
        try:
            self._process.wait(_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def request_priority() -> str:
    """Requests real-time priority for this thread and those that it starts. Returns `describe_priority`."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    return describe_priority(0)


def describe_priority(pid: int) -> str:
    """Returns the real-time priority of a deadman process as a text. 0: this process."""
    if os.sched_getscheduler(pid) in (os.SCHED_FIFO, os.SCHED_RR):
        return f"real-time priority {os.sched_getparam(pid).sched_priority}"
    return (
        "no real-time priority, so a busy computer can delay it. Give the user an rtprio limit of "
        f"{_PRIORITY}, or CAP_SYS_NICE"
    )


def _report(line: str) -> None:
    # The terminal of the bridge may be closed. This must not end the process.
    with contextlib.suppress(OSError):
        print(line, file=sys.stderr, flush=True)


def _report_connected(connected: bool) -> None:
    # The bridge may have ended, or be suspended, so that the pipe is full. With PYTHONUNBUFFERED, `print` would write
    # the end of the line separately.
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), f"{_READY if connected else _BLIND}\n".encode())


def main(namespace: str, domain: str) -> None:
    """Runs the deadman of a bridge, whose end closes the standard input. Signals end it only after the bridge."""
    received: list[int] = []

    def stop(number: int, frame: object) -> None:
        if select.select([sys.stdin], [], [], 0.0)[0]:
            received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)
    request_priority()
    os.set_blocking(sys.stdout.fileno(), False)
    deadman = Deadman(open_ros_domain(int(domain) if domain else None), namespace, _report)
    deadman.run(lambda: bool(received), sys.stdin.fileno(), _report_connected)
    # Without the destructors of Cyclone DDS, which may wait for ever if another participant ends at the same time.
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
