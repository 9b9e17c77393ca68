"""Links to a dVRK arm on ROS 2: through a bridge in this process, or to the arm's own controller (`move_jp`)."""

from __future__ import annotations

import atexit
import logging
import select
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import ControlModel
from dvrk_drake.errors import CollectionError, StationError
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.driver import CrtkDriver
from dvrk_drake.systems.lcm.arm_link import ArmLink, MessageLink
from dvrk_drake.systems.ros.crtk_bridge import CrtkBridge, connect_bridge
from dvrk_drake.systems.ros.crtk_client import ArrivalClock, CrtkClient, connect_client
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS, wait_unless_stopped
from dvrk_drake.systems.ros.domain import RosDomain
from dvrk_drake.systems.ros.open_domain import domain_number

#: Longest wait for a message between two updates of the bridge [s].
_POLL = 0.002

#: Bridges of this process, each with the number of its ROS domain.
_BRIDGES: list[tuple[int, CrtkBridge]] = []


@atexit.register
def _close_bridges() -> None:
    for _, bridge in _BRIDGES:
        bridge.close()


def _close_earlier(arm: Arm, driver: CrtkDriver) -> None:
    """Ends the bridge of an earlier link to the same arm, which may still exist, e.g. in a notebook."""
    number = domain_number(driver.domain)
    wanted = f"/{driver.namespace.strip('/')}".removesuffix("/measured_js")
    for entry in list(_BRIDGES):
        client = entry[1].client
        if entry[0] == number and client.arm.name == arm.name and wanted in ("/", client.namespace):
            _BRIDGES.remove(entry)
            entry[1].close()
            client.domain.close()


class CrtkArmLink(MessageLink):
    """Link to an arm on ROS 2. It runs a `CrtkBridge`, whose guard checks the commands, each time it is polled.

    If the link is not polled for 50 ms while efforts or positions act, the deadman process publishes `hold`.

    A later link to the same arm in this process ends the bridge of this link.
    """

    def __init__(
        self,
        arm: Arm,
        driver: CrtkDriver,
        *,
        report: Callable[[str], None] | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Connects to an arm.

        Args:
            arm: Arm on ROS 2.
            driver: Configuration of the driver.
            report: Function that is called with one line for each change of the guard's state. None: the lines are
                logged as warnings.
            stopped: Function that returns whether to end the connection, e.g. after Ctrl-C.

        Raises:
            DvrkDrakeError: The arm is not found, its topics do not fit, or another process could move it.
        """
        super().__init__(arm)
        _close_earlier(arm, driver)
        self._bridge: CrtkBridge = connect_bridge(
            arm,
            driver,
            self._receive,
            topic=driver.namespace or None,
            domain=driver.domain,
            report=report or logging.getLogger(__name__).warning,
            stopped=stopped,
        )
        self.where = f"{self._bridge.client.namespace}/measured_js"
        _BRIDGES.append((domain_number(driver.domain), self._bridge))

    def send_force(self, force: lcmt_dvrk_force) -> None:
        """Publishes an estimated external force on topics of this package, see `CrtkBridge.send_force`."""
        self._bridge.send_force(force)

    def close(self) -> None:
        """Commands the arm to hold its present pose, and ends the bridge and the deadman process."""
        if self._is_open():
            _BRIDGES[:] = [entry for entry in _BRIDGES if entry[1] is not self._bridge]
            self._bridge.close()
            self._bridge.client.domain.close()

    def _is_open(self) -> bool:
        return any(bridge is self._bridge for _, bridge in _BRIDGES)

    def _handle(self, seconds: float) -> bool:
        if not self._is_open():
            raise StationError(
                f"{self._bridge.client.namespace}: this station has ended, because a later station of this process "
                "connected to the arm. Use the later station"
            )
        if seconds > 0:
            select.select([self._bridge.fileno()], [], [], min(seconds, _POLL))
        self._bridge.update()
        # The bridge has handled all messages.
        return False

    def _publish(self, channel: str, data: bytes) -> None:
        self._bridge.put(data)
        self._bridge.update()


#: Shortest time between two goals of a motion [s].
GOAL_PERIOD = 0.1
#: Time without a message on measured_js after which the motion must stop [s]. The arm has then stopped already, because
#: goals wait for new measurements.
SILENCE = 1.0
#: Largest plausible change of a position between two messages: a fraction of the range of the joint, and ranges per
#: second of the time between the messages.
_JUMP, _JUMP_SPEED = 0.02, 2.0
#: Time for which the effort may exceed its limit [s]. A shorter peak is friction or noise.
_OVERLOAD = 0.05
#: Longest wait for a message between two checks of the arm [s].
_MOVE_POLL = 0.01
#: Longest time until the latest operating state arrives after an older one, until the first valid measurement of a
#: homed arm, and until the arm confirms `hold` [s].
_STATES, _FIRST, _CONFIRMATION = 2.0, 5.0, 4.0
_COMMANDS = ("move_jp", "hold")


class CrtkMoveLink(ArmLink):
    """Link that publishes POSITION commands as goals on `move_jp`, and HOLD on `hold`. There is no command guard.

    The goals of a motion follow a straight line in joint space, which is inside all limits if both ends are. Each goal
    is at most a tenth of a joint's range ahead of the measured pose. If this program or its network connection ends,
    the arm therefore stops after this distance and holds its pose. So no deadman process is needed: only efforts act
    until another command arrives. The dVRK's own gravity compensation does not act in position mode, so the measured
    efforts are those that hold the arm.

    Each measurement is checked. `next_status` raises an error, after which the caller must release the arm, if

    - the measured effort differs too much from the gravity effort of the model, except after HOLD,
    - measured_js stops, or a position or a time stamp jumps, or a value is not finite,
    - the arm is not enabled and homed any more, or does not subscribe to `move_jp` any more,
    - another process could move the arm.

    A status has the state POSITION or HOLD after a command, and the sender of the last command.
    """

    def __init__(
        self,
        client: CrtkClient,
        model: ControlModel,
        max_effort: float,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Creates a link.

        Args:
            client: Client of the arm.
            model: Model of the arm.
            max_effort: Largest absolute difference between the measured effort and the gravity effort of the model, as
                a fraction of the effort limit of the joint. A larger difference for 50 ms is an error.
            report: Function that is called with one line if the arm does not confirm the last `hold`.
        """
        super().__init__(client.arm)
        self.where = f"{client.namespace}/measured_js"
        self._client, self._model, self._max_effort, self._report = client, model, max_effort, report
        self._span = self.arm.position_upper - self.arm.position_lower
        # The first message may be late, if this computer is busy.
        self._clock = ArrivalClock(SILENCE)
        self._stamp, self._q = 0, np.zeros(self.arm.num_joints)
        self._overload_since: float | None = None
        self._num_changes = -1
        self._sender, self._state = 0, lcmt_dvrk_status.STATE_HOLD
        self._goal: NDArray[np.float64] | None = None
        self._has_held, self._next_goal = False, 0.0

    @property
    def is_busy(self) -> bool:
        """True if the arm states that it moves to a goal."""
        state = self._client.operating_state
        return state is None or state.is_busy

    def close(self) -> None:
        """Leaves the ROS domain."""
        self._client.domain.close()

    def next_status(self, seconds: float) -> lcmt_dvrk_status:
        """Returns the next measurement. It waits until a measurement arrives or the silence is an error.

        Raises:
            CollectionError: The motion must stop.
        """
        while (status := self.poll()) is None:
            self._client.domain.wait(_MOVE_POLL)
        return status

    def poll(self) -> lcmt_dvrk_status | None:
        """Receives messages and checks the arm. Returns a new measurement, or None.

        Raises:
            CollectionError: The motion must stop.
        """
        try:
            return self._measure(self.now())
        except CollectionError as error:
            raise CollectionError(f"{self.arm.name} stopped: {error}") from None

    def send(self, command: lcmt_dvrk_command) -> None:
        """Publishes a goal at most every 0.1 s, and the last goal of a motion at once, or `hold` once."""
        self._sender = command.sender_id
        if command.control_mode != lcmt_dvrk_command.POSITION:
            if not self._has_held:
                self._client.hold()
            self._has_held, self._goal, self._state = True, None, lcmt_dvrk_status.STATE_HOLD
            return
        goal, stamp = np.array(command.position), 1e-6 * command.status_utime
        self._has_held, self._state = False, lcmt_dvrk_status.STATE_POSITION
        if self._goal is not None and (goal == self._goal).all():
            return
        if stamp >= self._next_goal or not any(command.velocity):
            self._client.move_jp(goal)
            self._goal, self._next_goal = goal, stamp + GOAL_PERIOD

    def release(self) -> bool:
        """Publishes `hold` until the arm confirms it. Reports if it does not. Returns True."""
        if not self._client.hold_until_confirmed(_CONFIRMATION):
            self._report(f"{self._client.namespace}: the arm did not confirm hold. PRESS THE STOP BUTTON")
        return True

    def _measure(self, now: float) -> lcmt_dvrk_status | None:
        client = self._client
        is_new = client.receive()
        if reason := client.not_ready_reason:
            raise CollectionError(reason)
        if client.domain.num_changes != self._num_changes:
            self._num_changes = client.domain.num_changes
            if others := ", ".join(client.other_publishers()):
                raise CollectionError(f"another process publishes {others}. {END_OTHER_PROCESS}")
        measurement = client.measurement
        if measurement is None or now - 1e-9 * measurement.arrival > SILENCE:
            raise CollectionError(f"no message on {self.where} for {SILENCE:g} s")
        if not is_new:
            return None
        if measurement.problem:
            raise CollectionError(measurement.problem)
        utime, jump = self._clock.convert(measurement.stamp, measurement.arrival)
        if jump:
            raise CollectionError(f"{self.where}: {jump}")
        if unheard := client.unheard_commands(_COMMANDS):
            raise CollectionError(f"no process subscribes to {', '.join(unheard)}")
        if self._stamp:
            self._check_jump(measurement.q - self._q, 1e-9 * (measurement.stamp - self._stamp))
        self._q, self._stamp = measurement.q, measurement.stamp
        if not self._has_held:
            self._check_effort(measurement.q, measurement.effort, now)
        status = lcmt_dvrk_status()
        status.utime, status.sequence = utime, client.num_received
        status.arm_name, status.num_joints = self.arm.name, self.arm.num_joints
        status.position, status.velocity = measurement.q.tolist(), measurement.v.tolist()
        status.effort_measured = measurement.effort.tolist()
        status.guard_state, status.command_sender_id = self._state, self._sender
        return status

    def _check_jump(self, change: NDArray[np.float64], interval: float) -> None:
        ratio = np.abs(change) / (self._span * (_JUMP + _JUMP_SPEED * interval))
        j = int(np.argmax(ratio))
        if ratio[j] > 1:
            unit = "m" if self.arm.prismatic[j] else "rad"
            raise CollectionError(
                f"{self.arm.joint_names[j]} jumped by {change[j]:.3g} {unit} between two messages. Check the encoder "
                "of the joint"
            )

    def _check_effort(self, q: NDArray[np.float64], effort: NDArray[np.float64], now: float) -> None:
        excess = np.abs(effort - self._model.gravity_effort(q)) / self.arm.effort_limits
        j = int(np.argmax(excess))
        if excess[j] <= self._max_effort:
            self._overload_since = None
            return
        if self._overload_since is None:
            self._overload_since = now
        if now - self._overload_since >= _OVERLOAD:
            newton = "N" if self.arm.prismatic[j] else "N m"
            raise CollectionError(
                f"the effort {effort[j]:.3g} {newton} of {self.arm.joint_names[j]} differs from the gravity effort of "
                f"the model by {excess[j]:.2f} of the effort limit; allowed: {self._max_effort:g} (--max-effort). "
                "Check for an obstacle"
            )


def connect_move_link(
    ros: RosDomain,
    arm: Arm,
    model: ControlModel,
    topic: str | None,
    max_effort: float,
    *,
    report: Callable[[str], None] = lambda line: None,
    stopped: Callable[[], bool] = lambda: False,
) -> CrtkMoveLink:
    """Finds an arm on ROS 2 that is enabled and homed, and returns a link to it.

    Args:
        ros: ROS domain, which the link closes.
        arm: Arm on ROS 2.
        model: Model of the arm.
        topic: Topic measured_js of the arm or its namespace; see `find_topic`.
        max_effort: See `CrtkMoveLink`.
        report: Function that is called with lines about the search and the end of the connection.
        stopped: Function that returns whether to end the connection, e.g. after Ctrl-C.

    Raises:
        DvrkDrakeError: The arm is not found or not ready, another process could move it, or `stopped` returns true.
    """
    client = connect_client(ros, arm, topic, _COMMANDS, report=report, stopped=stopped)

    def is_ready() -> bool:
        client.receive()
        return not client.not_ready_reason

    def is_measured() -> bool:
        client.receive()
        return client.measurement is not None and not client.measurement.problem

    # The first state that arrives may be an older one, because the topic is latched.
    what = f"the connection to {client.namespace}"
    if not wait_unless_stopped(ros, is_ready, _STATES, stopped, what):
        raise CollectionError(f"{client.namespace}: {client.not_ready_reason}. Enable and home the arm at its console")
    if not wait_unless_stopped(ros, is_measured, _FIRST, stopped, what):
        assert client.measurement is not None
        raise CollectionError(client.measurement.problem)
    return CrtkMoveLink(client, model, max_effort, report)
