"""Conversion of the JointState messages of a dVRK arm to measurements, and of their time stamps to one clock."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.ros.messages import JointState

#: Time [s] and number of measurements of the arm after which a measurement of the separate joint is out of date. It is
#: out of date if both are exceeded, because a dVRK publishes at 100 Hz by default, and not in real time.
_JAW_AGE, _JAW_COUNT = 0.02, 2
#: Largest number of characters of a received text that is shown.
_SHOWN = 40


@dataclass(frozen=True)
class JointMeasurement:
    """Measured joint state of an arm with n joints, or the reason why a message cannot be used.

    Attributes:
        q: Positions (n,) [rad, m]. NaN if the message cannot be used.
        v: Velocities (n,) [rad/s, m/s].
        effort: Efforts of the motors (n,) [N m, N].
        stamp: Time of the measurement on the clock of the dVRK's computer [ns since 1970]; 0 for invalid data.
        arrival: Time of arrival on the monotonic clock of this computer [ns].
        problem: Reason why the message cannot be used, or "".
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]
    effort: NDArray[np.float64]
    stamp: int
    arrival: int
    problem: str = ""


class JointStateReader:
    """Converts JointState messages to measurements of an arm. Joints may be in any order.

    The joint `Arm.separate_joint`, e.g. the jaw, has messages of its own.
    """

    def __init__(self, arm: Arm, topic: str) -> None:
        """Creates a reader.

        Args:
            arm: Arm with n joints.
            topic: Topic of the messages, for texts.
        """
        self._arm, self._topic, self._names = arm, topic, list(arm.joint_names)
        self._main = [joint for joint in arm.joint_names if joint != arm.separate_joint]
        self._columns = np.array([arm.joint_names.index(joint) for joint in self._main])
        self._order: tuple[list[str] | None, list[int]] = (None, [])
        self._jaw: tuple[float, float, float] | None = None
        self._jaw_arrival = self._num_since_jaw = 0

    def read(self, message: JointState, arrival: int) -> JointMeasurement:
        """Converts a message of the arm.

        Args:
            message: Message.
            arrival: Time of arrival on the monotonic clock [ns].
        """
        self._num_since_jaw += 1
        blocks = np.full((3, self._arm.num_joints), np.nan)
        problem, stamp = self._problem(message), message.header.nanoseconds
        if not problem:
            values = np.array([message.position, message.velocity, message.effort])
            if message.name == self._names:
                blocks = values
            else:
                blocks[:, self._columns] = values[:, self._order[1]]
                if len(self._main) < self._arm.num_joints:
                    problem = self._add_jaw(blocks, arrival)
        # An effort that is not finite is passed to the guard. The regulation of the arm does not need efforts.
        if not problem and not np.isfinite(blocks[:2]).all():
            problem = f"{self._topic}: a position or velocity is not finite"
        if problem:
            blocks[:] = np.nan
        q, v, effort = blocks
        return JointMeasurement(q, v, effort, stamp, arrival, problem)

    def read_jaw(self, message: JointState, arrival: int) -> None:
        """Stores a message of the separate joint. It becomes part of the next measurements, at least for 20 ms.

        Args:
            message: Message.
            arrival: Time of arrival on the monotonic clock [ns].
        """
        parts = (message.position, message.velocity, message.effort)
        usable = message.header.nanoseconds and all(len(part) == 1 for part in parts)
        self._jaw = (parts[0][0], parts[1][0], parts[2][0]) if usable else None
        self._jaw_arrival, self._num_since_jaw = arrival, 0

    def _problem(self, message: JointState) -> str:
        """Returns the reason why a message cannot be used, or ""."""
        if message.header.nanoseconds == 0:
            return f"{self._topic}: header stamp 0 marks invalid data. Home the arm"
        if message.name != self._order[0]:
            if missing := [joint for joint in self._main if joint not in message.name]:
                found = ", ".join(shown(name) for name in message.name[: 2 * self._arm.num_joints]) or "none"
                return f"{self._topic} has the joints {found}; {self._arm.name} also needs {', '.join(missing)}"
            self._order = (list(message.name), [message.name.index(joint) for joint in self._main])
        sizes = [len(part) for part in (message.position, message.velocity, message.effort)]
        if sizes != [len(message.name)] * 3:
            return (
                f"{self._topic} has {sizes[0]} positions, {sizes[1]} velocities and {sizes[2]} efforts; "
                f"required: {len(message.name)} each"
            )
        return ""

    def _add_jaw(self, blocks: NDArray[np.float64], arrival: int) -> str:
        """Adds the separate joint to `blocks` (3, n). Returns a problem or ""."""
        name = self._arm.separate_joint
        is_old = arrival - self._jaw_arrival > 1e9 * _JAW_AGE and self._num_since_jaw > _JAW_COUNT
        if self._jaw is None or is_old:
            return f"no valid message on {self._topic.rpartition('/')[0]}/{name}/measured_js"
        blocks[:, self._arm.joint_names.index(name)] = self._jaw
        return ""


def shown(text: str) -> str:
    """Returns a received text for a message: on one line and with a limited length."""
    return text if text.isprintable() and len(text) <= _SHOWN else repr(text[:_SHOWN])


#: Number of measurements whose rate is determined.
_WINDOW = 100
#: Largest drift of the clocks, as a fraction of the time: each clock is corrected by at most 500 ppm, the limit of NTP.
_DRIFT = 1e-3


class ArrivalClock:
    """Clock of an arm [us]. It converts time stamps of another computer, and determines the rate of measurements.

    The clock is the time of day at its creation plus the monotonic time since then. It also advances while this process
    is suspended, and it does not jump.

    The shortest observed time from a stamp to its arrival is the difference of the two clocks plus the shortest delay
    of the network. The age of a measurement is its time from stamp to arrival minus this reference. The reference
    increases by at most 1 ms per second, because the clocks drift. So a delay that is constant from the first
    measurement on, or that increases more slowly, is not detected.
    """

    def __init__(self, largest_change: float = 0.1) -> None:
        """Starts the clock.

        Args:
            largest_change: Largest change of the difference of the clocks [s] that is not a jump of a clock.
        """
        self._largest_change = round(1e6 * largest_change)
        self._start = time.time_ns() - time.monotonic_ns()
        self._stamps: deque[int] = deque(maxlen=_WINDOW)
        self._offset, self._offset_time = 0.0, 0
        self._last = 0

    def now(self) -> int:
        """Returns the present time [us]."""
        return (self._start + time.monotonic_ns()) // 1000

    def convert(self, stamp: int, arrival: int) -> tuple[int, str]:
        """Returns the time of a measurement [us] on this clock, and a description of a jump or "".

        The times of different measurements increase.

        Args:
            stamp: Time stamp of the measurement [ns].
            arrival: Time of arrival on the monotonic clock [ns].
        """
        stamp, arrival = stamp // 1000, (self._start + arrival) // 1000
        difference, jump = arrival - stamp, ""
        reference = self._offset + _DRIFT * (arrival - self._offset_time)
        if not self._stamps:
            reference = difference
        elif stamp == self._stamps[-1]:
            return self._last, ""
        elif stamp < self._stamps[-1] or difference < self._offset - self._largest_change:
            change = 1e-6 * (stamp - self._stamps[-1])
            jump = f"the time stamp changed by {change:.3f} s since the previous message"
            self._stamps.clear()
            reference = difference
        self._stamps.append(stamp)
        self._offset, self._offset_time = min(reference, difference), arrival
        self._last = max(stamp + round(self._offset), self._last + 1)
        return self._last, jump

    @property
    def rate(self) -> float | None:
        """Inverse of the median interval of the last 100 measurements [Hz], or None before 100 measurements."""
        if len(self._stamps) < _WINDOW:
            return None
        return 1e6 / float(np.median(np.diff(self._stamps)))
