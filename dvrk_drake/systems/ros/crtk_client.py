"""Client for the ROS 2 topics of one dVRK arm.

The topic names are those of CRTK (Collaborative Robotics Toolkit, https://crtk-robotics.readthedocs.io).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.errors import ControllerError, DvrkDrakeError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.ros_bag import choose_topic, fitting_topics
from dvrk_drake.systems.ros.domain import Publisher, RosDomain, Subscription
from dvrk_drake.systems.ros.messages import Bool, Empty, Header, JointState, OperatingState, StringStamped

#: Longest time to wait for the topics of an arm [s]. Time to wait for other topics of the domain after the first one
#: [s].
_DISCOVERY, _OTHERS = 10.0, 1.0
#: Longest time until the arm has sent its state and a measurement [s]. Longest time until DDS detects the end of a
#: killed process [s].
_FIRST, _ENDED = 5.0, 3.0
#: Topics with which a client moves an arm. A second publisher on one of them could move the arm at the same time.
MOTION_TOPICS = (
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
)
#: Topics with which a client moves the separate joint.
_SEPARATE_TOPICS = ("servo_jp", "servo_jf", "move_jp")
#: Time after which a measurement of the separate joint is out of date [s].
_JAW_AGE = 0.02
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
        self._jaw_arrival = 0

    def read(self, message: JointState, arrival: int) -> JointMeasurement:
        """Converts a message of the arm.

        Args:
            message: Message.
            arrival: Time of arrival on the monotonic clock [ns].
        """
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
        if not problem and not np.isfinite(blocks).all():
            problem = f"{self._topic}: a position, velocity or effort is not finite"
        if problem:
            blocks[:] = np.nan
        q, v, effort = blocks
        return JointMeasurement(q, v, effort, stamp, arrival, problem)

    def read_jaw(self, message: JointState, arrival: int) -> None:
        """Stores a message of the separate joint. It becomes part of the next measurement."""
        parts = (message.position, message.velocity, message.effort)
        usable = message.header.nanoseconds and all(len(part) == 1 for part in parts)
        self._jaw = (parts[0][0], parts[1][0], parts[2][0]) if usable else None
        self._jaw_arrival = arrival

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
        if self._jaw is None or arrival - self._jaw_arrival > 1e9 * _JAW_AGE:
            return f"no valid message on {self._topic.rpartition('/')[0]}/{name}/measured_js"
        blocks[:, self._arm.joint_names.index(name)] = self._jaw
        return ""


class CrtkClient:
    """Publishes commands to one arm, and receives its measurements and its operating state.

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

    def __init__(self, domain: RosDomain, arm: Arm, namespace: str) -> None:
        """Creates the publishers and subscriptions of an arm.

        Args:
            domain: ROS domain of the arm.
            arm: Arm with n joints.
            namespace: Namespace of the topics, e.g. "/MTML". `find_arm` returns it.
        """
        arm.refuse_locked_joints("a client of a dVRK")
        self.arm, self.namespace, self.domain = arm, namespace, domain
        self.measurement: JointMeasurement | None = None
        self.operating_state: OperatingState | None = None
        self.gravity_compensation: float | None = None
        self.num_received = 0
        self._separate = arm.joint_names.index(arm.separate_joint) if arm.separate_joint else None
        self._reader = JointStateReader(arm, self._topic("measured_js"))
        subscribe = domain.subscribe
        self._measured: Subscription[JointState] = subscribe(self._topic("measured_js"), JointState)
        self._state = subscribe(self._topic("operating_state"), OperatingState, depth=100, latched=True)
        self._gravity = subscribe(self._topic("gravity_compensation/setpoint_js"), JointState)
        self._other_hold = subscribe(self._topic("hold"), Empty, ignore_own=True)
        self._jaw = None if self._separate is None else subscribe(self._jaw_topic("measured_js"), JointState)
        self._servo_jp = self._advertise("servo_jp")
        self._servo_jf = self._advertise("servo_jf")
        self._move_jp = self._advertise("move_jp")
        if self._separate is not None:
            self._jaw_commands = {
                name: domain.advertise(self._jaw_topic(name), JointState) for name in _SEPARATE_TOPICS
            }
        self._hold = domain.advertise(self._topic("hold"), Empty)
        self._use_gravity_compensation = domain.advertise(self._topic("use_gravity_compensation"), Bool)
        self._state_command = domain.advertise(self._topic("state_command"), StringStamped)

    @property
    def state(self) -> str:
        """Operating state of the arm in one word, e.g. "ENABLED", or "unknown" before the first message."""
        state = self.operating_state
        return "unknown" if state is None else state.state

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

    def take_other_hold(self) -> bool:
        """Returns whether another process has published `hold` since the last call."""
        return bool(self._other_hold.take())

    def servo_jf(self, effort: ArrayLike) -> None:
        """Commands efforts (n,) [N m, N]. The separate joint is not included; see `servo_separate`."""
        self._servo_jf.publish(JointState(Header.now(), effort=self._main(self._checked("servo_jf", effort))))

    def servo_jp(self, q: ArrayLike, v: ArrayLike | None = None) -> None:
        """Commands positions q (n,) [rad, m] and feedforward velocities v (n,) [rad/s, m/s], without a trajectory."""
        self._servo_jp.publish(self._position_command("servo_jp", q, v))

    def move_jp(self, q: ArrayLike) -> None:
        """Commands a motion to q (n,) [rad, m]. The arm computes the trajectory."""
        self._move_jp.publish(self._position_command("move_jp", q, None))
        if self._separate is not None:
            self.servo_separate("move_jp", float(np.asarray(q)[self._separate]))

    def servo_separate(self, name: str, value: float) -> None:
        """Commands the separate joint, e.g. the jaw.

        Args:
            name: "servo_jf", "servo_jp" or "move_jp".
            value: Effort [N m, N] or position [rad, m].
        """
        if not np.isfinite(value):
            raise DvrkDrakeError(f"{self._jaw_topic(name)}: the command {value} is not finite")
        message = JointState(Header.now())
        setattr(message, "effort" if name == "servo_jf" else "position", [float(value)])
        self._jaw_commands[name].publish(message)

    def hold(self) -> None:
        """Commands the arm to hold its present pose. The set-point is the pose at which the message arrives."""
        self._hold.publish(Empty())

    def use_gravity_compensation(self, on: bool) -> None:
        """Switches the dVRK's own gravity compensation on or off."""
        self._use_gravity_compensation.publish(Bool(on))

    def state_command(self, command: str) -> None:
        """Sends a command such as "enable", "home" or "disable" to the state machine of the arm."""
        self._state_command.publish(StringStamped(Header.now(), command))

    def wait_until_received(self, seconds: float) -> bool:
        """Waits until the arm has confirmed the last `hold`, at most `seconds`. Returns whether it has."""
        return self._hold.wait_until_received(seconds)

    def unheard_commands(self, names: Sequence[str]) -> list[str]:
        """Returns the command topics to which no process subscribes.

        Args:
            names: Names of the commands to check: servo_jp, servo_jf, move_jp or hold.
        """
        publishers: dict[str, Publisher] = {
            "servo_jp": self._servo_jp,
            "servo_jf": self._servo_jf,
            "move_jp": self._move_jp,
            "hold": self._hold,
        }
        return [publishers[name].topic for name in names if not publishers[name].num_subscribers()]

    def other_publishers(self) -> list[str]:
        """Returns the topics on which another process of the domain could move the arm, see `other_publishers`."""
        return other_publishers(self.domain, self.arm, self.namespace)

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

    def _topic(self, name: str) -> str:
        return f"{self.namespace}/{name}"

    def _jaw_topic(self, name: str) -> str:
        return self._topic(f"{self.arm.separate_joint}/{name}")

    def _advertise(self, name: str) -> Publisher[JointState]:
        return self.domain.advertise(self._topic(name), JointState)


def shown(text: str) -> str:
    """Returns a received text for a message: on one line and with a limited length."""
    return text if text.isprintable() and len(text) <= _SHOWN else repr(text[:_SHOWN])


def other_publishers(domain: RosDomain, arm: Arm, namespace: str) -> list[str]:
    """Returns the topics on which another process of the domain could move an arm, without duplicates.

    Args:
        domain: ROS domain of the arm.
        arm: Arm.
        namespace: Namespace of the topics, e.g. "/MTML".
    """
    names = [*MOTION_TOPICS, *(f"{arm.separate_joint}/{name}" for name in _SEPARATE_TOPICS if arm.separate_joint)]
    motion = {f"{namespace}/{name}" for name in names}
    return sorted({e.topic for e in domain.publishers() if e.topic in motion and not e.is_own})


def find_arm(domain: RosDomain, arm: Arm, topic: str | None = None, seconds: float = _DISCOVERY) -> str:
    """Waits until the arm's topic measured_js is discovered, and returns the namespace of the arm, e.g. "/PSM1".

    Args:
        domain: ROS domain.
        arm: Arm to find.
        topic: Topic measured_js or its namespace. None: the only topic `/<ARM>/measured_js`, in any namespace, where
            ARM is the name of the arm, optionally followed by a number.
        seconds: Longest time to wait [s].

    Raises:
        RecordingError: No topic or several topics fit. The message lists the topics of the domain.
    """
    domain.wait_until(lambda: bool(fitting_topics(arm, topic, domain.joint_state_topics())), seconds)
    domain.wait_until(lambda: False, min(_OTHERS, seconds))
    topics = {name: name for name in domain.joint_state_topics()}
    return choose_topic(domain.name, arm, topic, topics).rpartition("/")[0]


def connect_client(domain: RosDomain, arm: Arm, topic: str | None, commands: Sequence[str]) -> CrtkClient:
    """Finds an arm, and creates a client when the arm is present and no other process could move it.

    Args:
        domain: ROS domain of the arm.
        arm: Arm.
        topic: Topic measured_js of the arm or its namespace; see `find_arm`.
        commands: Names of the commands to which the arm must subscribe, see `CrtkClient.unheard_commands`.

    Raises:
        RecordingError: No topic or several topics fit.
        ControllerError: Another process could move the arm, no operating state or measurement arrives, the joints do
            not fit, or no process receives the commands.
    """
    namespace = find_arm(domain, arm, topic)
    # The publishers of a new client would stop a bridge that already runs. So their check comes first. DDS considers a
    # killed process as present for about a second.
    if not domain.wait_until(lambda: not other_publishers(domain, arm, namespace), _ENDED):
        raise ControllerError(
            f"another process publishes {', '.join(other_publishers(domain, arm, namespace))}. Only one process may "
            "command an arm: end the other one, e.g. another bridge, teleoperation or a script"
        )
    client = CrtkClient(domain, arm, namespace)

    def problem() -> str:
        """Returns the problem of a valid message. The first message of the arm may precede that of its jaw."""
        measurement = client.measurement
        return measurement.problem if measurement is not None and measurement.stamp else ""

    def is_complete() -> bool:
        client.receive()
        has_messages = client.operating_state is not None and client.measurement is not None
        return has_messages and not problem() and not client.unheard_commands(commands)

    if not domain.wait_until(is_complete, _FIRST):
        messages = {"measured_js": client.measurement, "operating_state": client.operating_state}
        if missing := [name for name, message in messages.items() if message is None]:
            raise ControllerError(f"no message on {namespace}/{missing[0]} within {_FIRST:g} s. Is it a dVRK?")
        if unheard := ", ".join(client.unheard_commands(commands)):
            raise ControllerError(f"no process subscribes to {unheard}. Is it a dVRK?")
        if text := problem():
            raise ControllerError(text)
    return client
