"""Bridge between the ROS 2 topics of a dVRK arm and the LCM messages of this package, with a command guard."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.lcmtypes import lcmt_dvrk_command, lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import describe_state
from dvrk_drake.systems.driver import ArmDriver
from dvrk_drake.systems.guard.command_guard import CommandGuard
from dvrk_drake.systems.guard.limits import GuardOutput
from dvrk_drake.systems.lcm.messages import CommandInbox, draw_id, fill_in_guard
from dvrk_drake.systems.ros.crtk_client import ArrivalClock, CrtkClient, connect_client
from dvrk_drake.systems.ros.deadman import DeadmanProcess, describe_priority
from dvrk_drake.systems.ros.discovery import END_OTHER_PROCESS
from dvrk_drake.systems.ros.domain import Publisher
from dvrk_drake.systems.ros.messages import (
    Float64MultiArray,
    Header,
    MultiArrayDimension,
    MultiArrayLayout,
    Time,
    Vector3,
    Wrench,
    WrenchStamped,
)
from dvrk_drake.systems.ros.open_domain import open_ros_domain

#: Lowest rate of measured_js for POSITION and EFFORT [Hz].
MIN_RATE = 500.0
#: Accepted error of the measured rate, as a fraction.
RATE_TOLERANCE = 0.05
#: Number of measurements between two checks of their rate. Number of successful checks after an insufficient rate.
_RATE_INTERVAL, _GOOD_RATES = 20, 5
#: Time without a measurement after which the guard is stepped nevertheless [us].
_SILENCE = 5_000
#: Largest effort of a gravity compensation that is switched off [N m, N].
_NO_EFFORT = 1e-9
#: Change of a command to the separate joint that is sent, as a fraction of the effort limit or of the range of the
#: joint. Each command to this joint can change the control mode of the arm for a moment.
_JAW_CHANGE = 0.01
#: Longest time until the arm has confirmed `hold` [s].
_CONFIRMATION = 5.0
#: Time after which `hold` is repeated while no joint has a valid measurement, or `disable` in the state OFF [us].
_REPEAT = 100_000
#: Longest time from the reception of a measurement to the command that is published for it [us].
_LATE = 20_000
#: Shortest time between two reports of problems with measured_js [us].
_REPORT_PERIOD = 1_000_000
#: Topics of the estimated external force below the namespace of an arm. They differ from `body/measured_cf`, the wrench
#: that a dVRK computes from the measured efforts without friction and inertia.
_FORCE, _COVARIANCE = "external_force/body/estimated_cf", "external_force/body/covariance"
_LAYOUT = MultiArrayLayout([MultiArrayDimension("row", 3, 9), MultiArrayDimension("column", 3, 3)])


class CrtkBridge:
    """Guards the commands to one dVRK arm and publishes its status.

    Commands are LCM messages (lcmt_dvrk_command), which the caller passes to `put`. The bridge steps the guard once per
    measurement, and once more when a command that answers this measurement arrives. It publishes the output of the
    guard on the ROS topics of the arm: efforts on `servo_jf`, positions on `servo_jp`. While each measurement is
    answered, efforts are published only in the second step.

    The guard refuses POSITION and EFFORT, and ends them, in these cases:

    - measured_js arrives at less than 500 Hz.
    - The dVRK's own gravity compensation is on, or it cannot be verified that it is off.
    - The deadman process has ended, or another process publishes `hold`.

    The guard changes to FAULT if the arm is not enabled and homed, or if another process could move the arm.

    Attributes:
        guard: The command guard.
        status: Last status, which belongs to the last measurement.
    """

    def __init__(
        self,
        client: CrtkClient,
        driver: ArmDriver,
        send_status: Callable[[bytes], None],
        *,
        report: Callable[[str], None] = lambda line: None,
        deadman: DeadmanProcess | None = None,
    ) -> None:
        """Creates a bridge. The arm holds its pose from the first call of `update` on.

        Args:
            client: Client of the arm.
            driver: Configuration with the settings and the model of the guard, the accepted modes and the key.
            send_status: Function that sends an encoded status (lcmt_dvrk_status).
            report: Function that is called with one line for each change of the state.
            deadman: Deadman process, which this bridge ends. None: there is none, e.g. in a test.

        Raises:
            ModelError: The driver's model cannot be read, or is not valid for this arm.
            KeyFileError: The driver's key cannot be used.
        """
        arm = client.arm
        self._client, self._send, self._report, self._deadman = client, send_status, report, deadman
        self._key = driver.load_key()
        self._clock = ArrivalClock()
        checked = driver.load_model(arm) or IdentifiedModel.from_arm(arm)
        self.guard = CommandGuard(
            arm, draw_id(), ControlModel(checked), driver.guard, driver.accepted_modes(), self._clock.now
        )
        self._inbox = CommandInbox(self.guard, self._key)
        self._has_commands = self._awaits_answer = self._was_answered = False
        self.status = lcmt_dvrk_status()
        self.status.arm_name, self.status.num_joints = arm.name, arm.num_joints
        self._measured_utime, self._last_step = 0, 0
        self._nan = np.full(arm.num_joints, np.nan)
        self._measured = (self._nan, self._nan, self._nan)
        self._separate = arm.joint_names.index(arm.separate_joint) if arm.separate_joint else None
        range_ = arm.position_upper - arm.position_lower
        self._jaw_tolerance = {"servo_jf": _JAW_CHANGE * arm.effort_limits, "servo_jp": _JAW_CHANGE * range_}
        self._jaw_sent: tuple[str, float] = ("", 0.0)
        self._was_ready = False
        self._num_measured, self._good_rates, self._rate_problem = 0, 0, ""
        self._num_changes, self._other_publishers, self._was_pushed = -1, "", False
        self._problem = self._described = self._blocked = ""
        self._last_sent = self._last_report = 0
        self._rate_problem = self._check_rate()

    def put(self, data: bytes) -> None:
        """Stores an LCM message of the command channel for the next `update`."""
        self._inbox.put(data)
        self._has_commands = True

    @property
    def client(self) -> CrtkClient:
        """Client of the arm."""
        return self._client

    @property
    def is_commanded(self) -> bool:
        """True if a controller commands positions or efforts."""
        return self.guard.state in (lcmt_dvrk_status.STATE_POSITION, lcmt_dvrk_status.STATE_EFFORT)

    def update(self) -> bool:
        """Receives measurements, steps the guard if something has arrived, and publishes its output.

        Call this method when a message has arrived, and at least every 5 ms.

        Returns:
            Whether the guard was stepped with a command that answers the last measurement.

        Raises:
            DvrkDrakeError: DDS cannot send a command to the arm.
        """
        is_answer = self._has_commands and self._awaits_answer
        if is_answer:
            self._answer(self._clock.now())
        self._client.domain.clear()
        is_new = self._client.receive_measurement()
        now = self._clock.now()
        if is_new:
            self._measure(now)
        if is_new or (self._measured_utime and now >= self._last_step + _SILENCE):
            self._step(now)
        return is_answer

    def send_force(self, force: lcmt_dvrk_force) -> None:
        """Publishes an estimated external force with its covariance (3 x 3) on topics of this package.

        The force is a wrench at the origin of its frame, without torque.

        Raises:
            DvrkDrakeError: DDS cannot send a message.
        """
        wrench, matrix = self._force_topics
        header = Header(Time(*divmod(1000 * force.utime, 10**9)), f"{force.arm_name}/{force.frame_name}")
        wrench.publish(WrenchStamped(header, Wrench(Vector3(*force.force))))
        matrix.publish(Float64MultiArray(_LAYOUT, [float(x) for row in force.force_covariance for x in row]))

    @cached_property
    def _force_topics(self) -> tuple[Publisher[WrenchStamped], Publisher[Float64MultiArray]]:
        domain, namespace = self._client.domain, self._client.namespace
        return (
            domain.advertise(f"{namespace}/{_FORCE}", WrenchStamped),
            domain.advertise(f"{namespace}/{_COVARIANCE}", Float64MultiArray),
        )

    def close(self) -> bool:
        """Commands the arm to hold its present pose, and ends the deadman process.

        If the arm does not confirm the command, the deadman process continues to send it.

        Returns:
            Whether the arm has confirmed the command.

        Raises:
            DvrkDrakeError: DDS cannot send the command.
        """
        is_confirmed = False
        try:
            is_confirmed = self._client.hold_until_confirmed(_CONFIRMATION)
            if not is_confirmed:
                self._report(f"{self._client.namespace}: the arm did not confirm hold. PRESS THE STOP BUTTON")
        finally:
            if self._deadman is not None:
                self._deadman.close(is_confirmed=is_confirmed)
        return is_confirmed

    def fileno(self) -> int:
        """Returns a file descriptor that is readable after a message of the arm has arrived."""
        return self._client.domain.fileno()

    def _measure(self, now: int) -> None:
        """Checks the time stamp of the last measurement and stores the measurement for the guard."""
        measurement = self._client.measurement
        assert measurement is not None
        problem = measurement.problem
        self._num_measured += 1
        if self._num_measured % _RATE_INTERVAL == 0:
            self._rate_problem = self._check_rate()
        if measurement.stamp:
            self._measured_utime, jump = self._clock.convert(measurement.stamp, measurement.arrival)
            problem = problem or (jump and f"{self._client.namespace}/measured_js: {jump}")
        else:
            self._measured_utime = now
        if problem and problem != self._problem and now >= self._last_report + _REPORT_PERIOD:
            self._report(problem)
            self._problem, self._last_report = problem, now
        elif not problem:
            self._problem = ""
        is_valid = not problem
        self._measured = (measurement.q, measurement.v, measurement.effort) if is_valid else (self._nan,) * 3

    def _step(self, now: int) -> None:
        """Steps the guard after a measurement, or after a silence, and sends a status."""
        guard, client = self.guard, self._client
        acts = self.is_commanded
        if acts:
            # The controller computes its answer during this step. The status has the guard's state after the last step.
            self._send_status(guard.output)
        client.receive_state()
        not_ready = client.not_ready_reason
        if not_ready:
            guard.report_fault(f"{client.namespace}: {not_ready}", has_power=False)
            if self._was_ready:
                # The last effort would act on if the message is wrong, e.g. that of another process.
                self._hold()
        elif not self._was_ready:
            self._switch_gravity_compensation_off()
        self._was_ready = not not_ready
        if not self._was_answered:
            self._find_other_publishers()
        if self._other_publishers:
            guard.report_fault(f"another process publishes {self._other_publishers}. {END_OTHER_PROCESS}")
        elif guard.state != lcmt_dvrk_status.STATE_FAULT:
            self._was_pushed = False
        self._blocked = self._block_reason()
        guard.block(self._blocked)
        output = self._step_guard(now)
        if not acts:
            self._send_status(output)
        # If the last measurement was answered, the efforts are published with the answer to this measurement. Without
        # an answer, they are published in the next step.
        is_effort = output.control_mode == lcmt_dvrk_command.EFFORT
        if not (self._was_answered and is_effort and not self._blocked):
            self._publish(output, now)
        self._awaits_answer, self._was_answered = True, False
        self._describe()

    def _answer(self, now: int) -> None:
        """Steps the guard after the command that answers the last measurement."""
        self._publish(self._step_guard(now), now)
        self._awaits_answer, self._was_answered = False, True
        # This check needs more computing time than the others. After the answer, it does not delay it.
        self._find_other_publishers()

    def _step_guard(self, now: int) -> GuardOutput:
        """Passes the commands to the guard, and returns its output."""
        if self._has_commands:
            self._inbox.deliver(self.guard, now)
            self._has_commands = False
        self._last_step = now
        return self.guard.step(now, self._measured_utime, *self._measured)

    def _publish(self, output: GuardOutput, now: int) -> None:
        """Publishes the output of the guard on the topics of the arm, if the arm executes commands."""
        client = self._client
        # A process that was suspended during this step must not send an old command.
        if not self._was_ready or self._clock.now() >= now + _LATE:
            return
        is_effort = output.control_mode == lcmt_dvrk_command.EFFORT
        all_implausible = np.all(output.joint_flags & lcmt_dvrk_status.FLAG_IMPLAUSIBLE)
        is_released = self._was_pushed and not self._other_publishers
        if all_implausible or is_released or (is_effort and self._blocked):
            # The arm measures its joints itself, so it can still hold its pose. After a measurement fault, the guard
            # commands efforts, which are not safe for example with the gravity compensation of the dVRK. After the
            # end of another process, the target of the guard is the pose from which that process moved the arm.
            if now >= self._last_sent + _REPEAT:
                self._hold()
                self._last_sent = now
        elif is_effort:
            self._send_jaw("servo_jf", output.effort)
            client.servo_jf(output.effort)
            if (delay := self._clock.now() - now) >= _LATE:
                # The process was suspended after the check above, so this effort is old.
                self._hold()
                self.guard.block(f"the bridge was suspended for {1e-3 * delay:.0f} ms while it published an effort")
        elif output.control_mode != lcmt_dvrk_command.OFF:
            self._send_jaw("servo_jp", output.position)
            client.servo_jp(output.position, output.velocity)
        elif self.guard.state == lcmt_dvrk_status.STATE_OFF and now >= self._last_sent + _REPEAT:
            client.state_command("disable")
            self._last_sent = now

    def _hold(self) -> None:
        """Publishes `hold`, after which the separate joint needs a new command."""
        self._client.hold()
        self._jaw_sent = ("", 0.0)

    def _send_jaw(self, name: str, values: NDArray[np.float64]) -> None:
        """Commands the separate joint, if the command has changed. Call this method before the command to the arm."""
        if self._separate is None:
            return
        value = float(values[self._separate])
        if self._jaw_sent[0] == name and abs(value - self._jaw_sent[1]) <= self._jaw_tolerance[name][self._separate]:
            return
        self._client.servo_separate(name, value)
        self._jaw_sent = (name, value)

    def _send_status(self, output: GuardOutput) -> None:
        """Sends the status of the last measurement. Without new measurements, it is repeated with the same utime."""
        status = self.status
        q, v, effort = self._measured
        acts = output.control_mode == lcmt_dvrk_command.EFFORT and self._was_ready
        status.utime, status.sequence = self._measured_utime, status.sequence + 1
        status.position, status.velocity, status.effort_measured = q.tolist(), v.tolist(), effort.tolist()
        status.effort_commanded = (output.effort if acts else effort).tolist()
        status.gravity_compensation = (self._client.gravity_compensation or 0.0) > _NO_EFFORT
        fill_in_guard(status, self.guard)
        data = status.encode()
        self._send(data if self._key is None else self._key.sign(data))

    def _switch_gravity_compensation_off(self) -> None:
        self._client.gravity_compensation = None
        self._client.use_gravity_compensation(False)
        self._jaw_sent = ("", 0.0)
        self._report(f"{self._client.namespace}: switched off the dVRK's own gravity compensation")

    def _block_reason(self) -> str:
        """Returns the reason to refuse POSITION and EFFORT, or ""."""
        client = self._client
        if self._deadman is not None and (reason := self._deadman.problem()):
            return reason
        if client.take_other_hold():
            self._jaw_sent = ("", 0.0)  # `hold` also acts on the separate joint
            return "another process published hold, e.g. the deadman process"
        if self._rate_problem:
            return self._rate_problem
        if not client.arm.console_gravity_compensation:
            return ""
        topic = f"{client.namespace}/gravity_compensation/setpoint_js"
        if client.gravity_compensation is None:
            return f"no valid message on {topic}, so the dVRK's own gravity compensation may be on"
        if client.gravity_compensation > _NO_EFFORT:
            # The text must not change with every message.
            return f"the dVRK's own gravity compensation is on: {topic} is not zero. Switch it off at the console"
        return ""

    def _check_rate(self) -> str:
        """Returns the reason why the rate of the measurements is not sufficient, or "".

        After an insufficient rate, several checks must succeed, so that the state does not alternate.
        """
        rate, topic = self._clock.rate, f"{self._client.namespace}/measured_js"
        if rate is None:
            return f"the rate of {topic} is not known yet"
        if rate >= (1.0 - RATE_TOLERANCE) * MIN_RATE:
            self._good_rates += 1
            was_low = "arrives at" in self._rate_problem
            return self._rate_problem if was_low and self._good_rates < _GOOD_RATES else ""
        self._good_rates = 0
        if "arrives at" in self._rate_problem:  # the text does not change with every measurement
            return self._rate_problem
        return (
            f"{topic} arrives at {rate:.0f} Hz; commands need {MIN_RATE:.0f} Hz. Start the dVRK's console with a "
            "period of 1 ms: dvrk_system -j FILE.json -p 0.001"
        )

    def _find_other_publishers(self) -> None:
        """Finds the topics on which another process could move the arm, after publishers have appeared or ended."""
        if self._client.domain.num_changes != self._num_changes:
            self._num_changes = self._client.domain.num_changes
            others, self._other_publishers = self._other_publishers, ", ".join(self._client.other_publishers())
            self._was_pushed |= bool(self._other_publishers)
            if others and not self._other_publishers:
                self._last_sent = 0  # the next output is `hold`, without a pause
                self._client.read_state_again()

    def _describe(self) -> None:
        """Reports a change of the state of the guard."""
        guard = self.guard
        sender = f", sender {guard.sender_id}" if guard.sender_id else ""
        text = describe_state(guard.state, guard.fault_text or guard.blocked_reason) + sender
        if text != self._described:
            self._report(text)
            self._described = text


def connect_bridge(
    arm: Arm,
    driver: ArmDriver,
    send_status: Callable[[bytes], None],
    *,
    topic: str | None = None,
    domain: int | None = None,
    report: Callable[[str], None] = lambda line: None,
    stopped: Callable[[], bool] = lambda: False,
    polled: bool = False,
) -> CrtkBridge:
    """Finds an arm on ROS 2 and connects a bridge with its deadman process.

    Args:
        arm: Arm to connect.
        driver: Configuration, see `CrtkBridge`.
        send_status: Function that sends an encoded status (lcmt_dvrk_status).
        topic: Topic measured_js of the arm or its namespace; see `find_topic`.
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
        report: Function that is called with one line for each change of the state.
        stopped: Function that returns whether to end the connection, e.g. after Ctrl-C.
        polled: Whether the caller calls `CrtkBridge.update` all the time; see `CrtkClient`.

    Returns:
        Bridge. Call `CrtkBridge.close` at the end.

    Raises:
        DvrkDrakeError: The driver's model cannot be used, the arm is not found, its topics do not fit, or another
            process could move it.
    """
    driver.load_model(arm)  # a model that cannot be used is refused before an arm is searched
    ros = open_ros_domain(domain)
    commands = ("servo_jp", "servo_jf", "hold")
    try:
        client = connect_client(ros, arm, topic, commands, report=report, stopped=stopped, polled=polled)
        deadman = DeadmanProcess(client.namespace, domain, stopped)
    except BaseException:
        # A traceback may keep the publishers, which a second attempt would find.
        ros.close()
        raise
    report(
        f"deadman process {deadman.pid} publishes hold if this bridge is silent for 50 ms; it has "
        f"{describe_priority(deadman.pid)}"
    )
    try:
        return CrtkBridge(client, driver, send_status, report=report, deadman=deadman)
    except BaseException:
        deadman.close()
        raise
