"""Observer and client for the ROS 2 topics of one dVRK arm.

The topic names are those of CRTK (Collaborative Robotics Toolkit, https://crtk-robotics.readthedocs.io).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.errors import ControllerError, DvrkDrakeError
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.ros.deadman import repeat_until_confirmed
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS, find_topic, shown, wait_unless_stopped
from dvrk_drake.systems.ros.domain import Publisher, RosDomain, Subscription
from dvrk_drake.systems.ros.messages import Bool, Empty, Header, JointState, OperatingState, StringStamped

#: Time [s] and number of measurements of the arm after which a measurement of the separate joint is out of date. It is
#: out of date if both are exceeded, because a dVRK publishes at 100 Hz by default, and not in real time.
_JAW_AGE, _JAW_COUNT = 0.02, 2


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


#: Longest time until the arm has sent its state and a measurement [s]. Longest time until DDS detects the end of a
#: killed process of this package [s].
_FIRST, _ENDED = 5.0, 3.0
#: Time after which an unanswered "disable" is repeated [s].
_REPEAT = 0.25
#: Topics with which a client moves an arm. A second publisher on one of them could move the arm at the same time.
_MOTION_TOPICS = (
    "servo_jp",
    "servo_jr",
    "servo_jv",
    "servo_jf",
    "servo_cp",
    "servo_cr",
    "servo_cv",
    "servo_cf",
    "servo_ci",
    "body/servo_cf",
    "spatial/servo_cf",
    "move_jp",
    "move_jr",
    "move_cp",
    "move_cr",
    "free",
)
#: Topics with which a client moves the separate joint.
_SEPARATE_TOPICS = ("servo_jp", "servo_jf", "move_jp")


class CrtkObserver:
    """Receives the measurements and the operating state of one arm, and can stop it. It commands no motion.

    Attributes:
        arm: Arm with n joints.
        namespace: Namespace of the topics, e.g. "/MTML".
        domain: ROS domain of the arm.
        measurement: Last measurement, or None before the first message.
        operating_state: Last operating state, or None before the first message.
        gravity_compensation: Largest absolute effort of the dVRK's own gravity compensation in the last message [N m,
            N]; None before the first valid message with a finite effort for each joint.
        num_received: Number of messages on measured_js.
    """

    def __init__(self, domain: RosDomain, arm: Arm, namespace: str, *, polled: bool = False) -> None:
        """Creates the subscriptions to an arm.

        Args:
            domain: ROS domain of the arm.
            arm: Arm with n joints.
            namespace: Namespace of the topics, e.g. "/MTML". It is that of the topic that `find_topic` returns.
            polled: Whether the caller calls `receive_measurement` all the time, without waiting for messages of the
                domain. Measurements then arrive earlier, because no thread wakes up for them.

        Raises:
            ArmError: The arm has locked joints.
        """
        arm.refuse_locked_joints("a dVRK on ROS 2")
        self.arm, self.namespace, self.domain = arm, namespace, domain
        self.measurement: JointMeasurement | None = None
        self.operating_state: OperatingState | None = None
        self.gravity_compensation: float | None = None
        self.num_received = 0
        self._reader = JointStateReader(arm, self._topic("measured_js"))
        subscribe = domain.subscribe
        self._measured: Subscription[JointState] = subscribe(self._topic("measured_js"), JointState, wakes=not polled)
        self._state = self._subscribe_to_state()
        self._gravity = subscribe(self._topic("gravity_compensation/setpoint_js"), JointState)
        self._jaw = subscribe(self._jaw_topic("measured_js"), JointState) if arm.separate_joint else None

    def close(self) -> None:
        """Leaves the ROS domain."""
        self.domain.close()

    @property
    def not_ready_reason(self) -> str:
        """Reason why the arm does not execute commands, or "" if it is enabled and homed."""
        state = self.operating_state
        if state is None:
            return f"no message on {self._topic('operating_state')}"
        if state.state != "ENABLED":
            return f"operating_state is {shown(state.state)}"
        return "" if state.is_homed else "operating_state is ENABLED, but the arm is not homed"

    def receive(self) -> bool:
        """Receives all messages that have arrived. Returns whether there is a new measurement."""
        is_new = self.receive_measurement()
        self.receive_state()
        return is_new

    def receive_measurement(self) -> bool:
        """Receives the measurements that have arrived. Returns whether there is a new one."""
        is_new = False
        if self._jaw is not None:
            for message, _ in self._jaw.take():
                self._reader.read_jaw(message, time.monotonic_ns())
        for message, _ in self._measured.take():
            # The time of arrival must not be earlier than the message, also if this process was suspended meanwhile.
            self.measurement, is_new = self._reader.read(message, time.monotonic_ns()), True
            self.num_received += 1
        return is_new

    def receive_state(self) -> None:
        """Receives the operating state and the efforts of the dVRK's own gravity compensation."""
        for state, _ in self._state.take():
            self.operating_state = state
        for message, _ in self._gravity.take():
            # A message without efforts does not show that the gravity compensation is off.
            is_complete = len(message.effort) == self.arm.num_joints and np.isfinite(message.effort).all()
            if message.header.nanoseconds and is_complete:
                self.gravity_compensation = float(np.max(np.abs(message.effort)))

    def read_state_again(self) -> None:
        """Forgets the operating state, and subscribes again to the last message of each of its publishers."""
        self._state.close()
        self.operating_state, self._state = None, self._subscribe_to_state()

    def other_publishers(self) -> list[str]:
        """Returns the topics on which another process of the domain could move the arm, see `other_publishers`."""
        return other_publishers(self.domain, self.arm, self.namespace)

    def switch_power_off(self, seconds: float) -> bool:
        """Sends "disable" until the motors have no power, at most `seconds` [s]. Returns whether they have none.

        An arm without brakes falls.

        Raises:
            DvrkDrakeError: DDS cannot send the message.
        """
        end = time.monotonic() + seconds

        def is_off() -> bool:
            self.receive_state()
            return self.operating_state is not None and self.operating_state.state in ("DISABLED", "FAULT")

        while not is_off() and time.monotonic() < end:
            self.state_command("disable")
            self.domain.wait_until(is_off, _REPEAT)
        return is_off()

    def hold(self) -> None:
        """Commands the arm to hold its present pose. The set-point is the pose at which the message arrives."""
        self._hold.publish(Empty())

    def state_command(self, command: str) -> None:
        """Sends a command such as "enable", "home" or "disable" to the state machine of the arm."""
        self._state_command.publish(StringStamped(Header.now(), command))

    def hold_until_confirmed(self, seconds: float) -> bool:
        """Publishes `hold` until the arm has confirmed it, at most `seconds` [s]. Returns whether it has.

        Raises:
            DvrkDrakeError: DDS cannot send the message.
        """
        end = time.monotonic() + seconds

        def attempt(longest: float) -> bool:
            self.hold()
            is_received = self._hold.wait_until_received(longest)
            return is_received and bool(self._state.publisher_participants() & self._hold.subscriber_participants())

        return repeat_until_confirmed(attempt, lambda: time.monotonic() >= end)

    @cached_property
    def _hold(self) -> Publisher[Empty]:
        """Publisher of `hold`, which an observer creates only if it stops the arm."""
        return self.domain.advertise(self._topic("hold"), Empty)

    @cached_property
    def _state_command(self) -> Publisher[StringStamped]:
        return self.domain.advertise(self._topic("state_command"), StringStamped)

    def _subscribe_to_state(self) -> Subscription[OperatingState]:
        return self.domain.subscribe(self._topic("operating_state"), OperatingState, depth=100, latched=True)

    def _topic(self, name: str) -> str:
        return f"{self.namespace}/{name}"

    def _jaw_topic(self, name: str) -> str:
        return self._topic(f"{self.arm.separate_joint}/{name}")


class CrtkClient(CrtkObserver):
    """Observer of one arm that also publishes commands to it."""

    def __init__(self, domain: RosDomain, arm: Arm, namespace: str, *, polled: bool = False) -> None:
        """Creates the subscriptions and publishers of an arm; see `CrtkObserver`."""
        super().__init__(domain, arm, namespace, polled=polled)
        self._separate = arm.joint_names.index(arm.separate_joint) if arm.separate_joint else None
        self._other_hold = domain.subscribe(self._topic("hold"), Empty, ignore_own=True, wakes=False)
        # DDS needs time to connect a new publisher to the arm, so all are created now.
        self._commands: dict[str, Publisher] = {
            name: domain.advertise(self._topic(name), JointState) for name in ("servo_jp", "servo_jf", "move_jp")
        }
        self._commands |= {"hold": self._hold, "state_command": self._state_command}
        if self._separate is not None:
            self._jaw_commands = {
                name: domain.advertise(self._jaw_topic(name), JointState) for name in _SEPARATE_TOPICS
            }
        self._use_gravity_compensation = domain.advertise(self._topic("use_gravity_compensation"), Bool)

    def take_other_hold(self) -> bool:
        """Returns whether another process has published `hold` since the last call."""
        return bool(self._other_hold.take())

    def servo_jf(self, effort: ArrayLike) -> None:
        """Commands efforts (n,) [N m, N]. The separate joint is not included; see `servo_separate`.

        Raises:
            DvrkDrakeError: There are not n finite efforts, or DDS cannot send the message.
        """
        message = JointState(Header.now(), effort=self._main(self._checked("servo_jf", effort)))
        self._commands["servo_jf"].publish(message)

    def servo_jp(self, q: ArrayLike, v: ArrayLike | None = None) -> None:
        """Commands positions q (n,) [rad, m] and feedforward velocities v (n,) [rad/s, m/s], without a trajectory.

        The separate joint is not included; see `servo_separate`.

        Raises:
            DvrkDrakeError: There are not n finite numbers each, or DDS cannot send the message.
        """
        self._commands["servo_jp"].publish(self._position_command("servo_jp", q, v))

    def move_jp(self, q: ArrayLike) -> None:
        """Commands a motion to q (n,) [rad, m], with the separate joint. The arm computes the trajectory.

        Raises:
            DvrkDrakeError: There are not n finite positions, or DDS cannot send a message.
        """
        self._commands["move_jp"].publish(self._position_command("move_jp", q, None))
        if self._separate is not None:
            self.servo_separate("move_jp", float(np.asarray(q)[self._separate]))

    def servo_separate(self, name: str, value: float) -> None:
        """Commands the separate joint, e.g. the jaw.

        Args:
            name: "servo_jf", "servo_jp" or "move_jp".
            value: Effort [N m, N] or position [rad, m].

        Raises:
            DvrkDrakeError: The value is not finite, or DDS cannot send the message.
        """
        if not np.isfinite(value):
            raise DvrkDrakeError(f"{self._jaw_topic(name)}: the command {value} is not finite")
        message = JointState(Header.now())
        setattr(message, "effort" if name == "servo_jf" else "position", [float(value)])
        self._jaw_commands[name].publish(message)

    def use_gravity_compensation(self, on: bool) -> None:
        """Switches the dVRK's own gravity compensation on or off."""
        self._use_gravity_compensation.publish(Bool(on))

    def unheard_commands(self, names: Sequence[str]) -> list[str]:
        """Returns the command topics to which the DDS participant that publishes operating_state does not subscribe.

        Args:
            names: Names of the commands to check: servo_jp, servo_jf, move_jp or hold.
        """
        arm, publishers = self._state.publisher_participants(), [self._commands[name] for name in names]
        return [publisher.topic for publisher in publishers if not arm & publisher.subscriber_participants()]

    def _position_command(self, name: str, q: ArrayLike, v: ArrayLike | None) -> JointState:
        message = JointState(Header.now(), position=self._main(self._checked(name, q)))
        if v is not None:
            message.velocity = self._main(self._checked(name, v))
        return message

    def _checked(self, name: str, values: ArrayLike) -> NDArray[np.float64]:
        """Returns the values (n,). A dVRK changes its control mode also for a command that it cannot execute.

        Raises:
            DvrkDrakeError: There are not n finite numbers.
        """
        array = np.asarray(values, float)
        n = self.arm.num_joints
        if array.shape != (n,) or not np.isfinite(array).all():
            raise DvrkDrakeError(f"{self._topic(name)}: a command is {n} finite numbers; got {array.tolist()}")
        return array

    def _main(self, values: NDArray[np.float64]) -> list[float]:
        numbers: list[float] = values.tolist()
        if self._separate is not None:
            del numbers[self._separate]
        return numbers


def other_publishers(domain: RosDomain, arm: Arm, namespace: str) -> list[str]:
    """Returns the topics on which another process of the domain could move an arm, without duplicates.

    Topics of the arm with two publishers, e.g. an arm and a simulated arm, are included too. A wrong operating_state
    would end the commands.

    Args:
        domain: ROS domain of the arm.
        arm: Arm.
        namespace: Namespace of the topics, e.g. "/MTML".
    """
    names = [*_MOTION_TOPICS, *(f"{arm.separate_joint}/{name}" for name in _SEPARATE_TOPICS if arm.separate_joint)]
    motion = {f"{namespace}/{name}" for name in names}
    topics = [endpoint.topic for endpoint in domain.publishers() if not endpoint.is_own]
    of_arm = (f"{namespace}/{name}" for name in ("measured_js", "operating_state"))
    return sorted(motion.intersection(topics)) + [topic for topic in of_arm if topics.count(topic) > 1]


def connect_client(
    domain: RosDomain,
    arm: Arm,
    topic: str | None,
    commands: Sequence[str],
    *,
    report: Callable[[str], None] = lambda line: None,
    stopped: Callable[[], bool] = lambda: False,
    polled: bool = False,
) -> CrtkClient:
    """Finds an arm, and creates a client when the arm is present and no other process could move it.

    Args:
        domain: ROS domain of the arm.
        arm: Arm.
        topic: Topic measured_js of the arm or its namespace; see `find_topic`.
        commands: Names of the commands to which the arm must subscribe, see `CrtkClient.unheard_commands`.
        report: Function that is called with one line if the search for the arm takes longer than a second.
        stopped: Function that returns whether to end the search and the connection, e.g. after Ctrl-C.
        polled: See `CrtkClient`.

    Raises:
        RecordingError: See `find_topic`.
        ControllerError: Another process could move the arm, no operating state or measurement arrives, the joints do
            not fit, no process receives the commands, or the connection was stopped.
    """
    namespace = find_topic(domain, arm, topic, report=report, stopped=stopped).rpartition("/")[0]
    what = f"the connection to {namespace}"
    # The publishers of a new client would stop a bridge that already runs, so this check comes first. DDS lists a
    # killed process of this package for about a second, and others for 10 s.
    if not wait_unless_stopped(domain, lambda: not other_publishers(domain, arm, namespace), _ENDED, stopped, what):
        raise ControllerError(
            f"another process publishes {', '.join(other_publishers(domain, arm, namespace))}, e.g. another bridge, "
            f"teleoperation or a script. Only one process may command an arm. {END_OTHER_PROCESS}"
        )
    client = CrtkClient(domain, arm, namespace, polled=polled)

    def problem() -> str:
        """Returns the problem of a valid message. The first message of the arm may precede that of its jaw."""
        measurement = client.measurement
        return measurement.problem if measurement is not None and measurement.stamp else ""

    def is_complete() -> bool:
        client.receive()
        has_messages = client.operating_state is not None and client.measurement is not None
        return has_messages and not problem() and not client.unheard_commands(commands)

    if not wait_unless_stopped(domain, is_complete, _FIRST, stopped, what):
        messages = {"measured_js": client.measurement, "operating_state": client.operating_state}
        if missing := [name for name, message in messages.items() if message is None]:
            raise ControllerError(f"no message on {namespace}/{missing[0]} within {_FIRST:g} s. Is it a dVRK?")
        if unheard := ", ".join(client.unheard_commands(commands)):
            raise ControllerError(f"no process subscribes to {unheard}. Is it a dVRK?")
        if text := problem():
            raise ControllerError(text)
    return client
