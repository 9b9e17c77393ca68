"""Connection to an arm over LCM or ROS 2: measures it, moves it, and controls it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.motion_limits import execution_limits, motion_violations, path_obstacle
from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.analysis.excitation.pose_file import CollectionFile, load_poses, load_poses_if_any, pose_environment
from dvrk_drake.analysis.verdict import cross_validated_verdicts, unfit
from dvrk_drake.dynamics.identified_model import ControlModel, IdentifiedModel
from dvrk_drake.errors import CollectionError, ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.lcm_messages import MessageKey
from dvrk_drake.processes import motion_parts
from dvrk_drake.processes.arm_controller import ArmController, GoalController
from dvrk_drake.processes.arm_operator import reset_fault, stop_arm
from dvrk_drake.processes.collector import CollectionSettings, Collector, approaches, summary
from dvrk_drake.processes.control import FIRST_WAIT, SILENCE, StatusHandler, control, first_status
from dvrk_drake.processes.live_status import LiveStatus
from dvrk_drake.processes.motion_player import REHEARSAL_SPEED, MotionPlayer
from dvrk_drake.processes.recorder import ArmRecorder, LcmRecorder
from dvrk_drake.processes.ros_recorder import RosRecorder, bag_path
from dvrk_drake.processes.teacher import Teacher
from dvrk_drake.recordings.writer_stream import check_stream_output
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import Mode
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.lcm.arm_link import ArmLink, LcmArmLink
from dvrk_drake.systems.lcm.lcm_network import open_lcm
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver
from dvrk_drake.systems.ros.open_domain import open_ros_domain, require_cyclonedds

if TYPE_CHECKING:
    from pydrake.systems.framework import System


#: Longest time until the rate of the measurements over ROS 2 is known [s].
_RATE_WAIT = 5.0


@dataclass(frozen=True)
class Dialog:
    """Functions for the communication with the operator during a motion.

    Attributes:
        stopped: Function that returns whether to stop, e.g. after Ctrl-C. It is called once per measurement.
        confirm: Function that returns after the operator has confirmed the first motion, or after `stopped` returns
            true.
        enter: Function that returns whether the Enter key was pressed since the last call. None: there is no such key.
        report: Function that is called with each line of text.
        show: Function that is called with a function that returns the text of the status line.

    Example:
        >>> import dvrk_drake as dvrk
        >>> end = 0.0
        >>> dialog = dvrk.Dialog(stopped=lambda: end > 60.0, report=print)
        >>> dialog.stopped()
        False
    """

    stopped: Callable[[], bool] = lambda: False
    confirm: Callable[[], None] = lambda: None
    enter: Callable[[], bool] | None = None
    report: Callable[[str], None] = lambda line: None
    show: Callable[[Callable[[], str]], None] = lambda text: None


@dataclass(frozen=True)
class Measured:
    """Mean measurement of an arm with n joints over a short time.

    Attributes:
        q: Positions (n,) [rad, m].
        v: Velocities (n,) [rad/s, m/s].
        effort: Efforts of the motors (n,) [N m, N].
        count: Number of averaged measurements.
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]
    effort: NDArray[np.float64]
    count: int


@dataclass(frozen=True)
class PlayedMotion:
    """Result of a motion.

    Attributes:
        begin, end: Time of the motion at which it began and ended [s].
        duration: Duration of the motion [s].
        path: File with the measurements, or with the rehearsal. None: nothing was written.
        tracking_error: Largest tracking error as a fraction of the range of a joint.
        is_complete: Whether the motion ended at its end.
    """

    begin: float
    end: float
    duration: float
    path: Path | None
    tracking_error: float
    is_complete: bool


@dataclass
class ArmConnection:
    """Connection to one arm; see `connect`.

    Each method opens its channels, and closes them at its end. The arm then holds its pose.

    Attributes:
        arm: Arm with n joints.
        model: Model for the control of the arm.
        transport: "lcm" or "ros".
        dialog: Functions for the communication with the operator.

    Example:
        >>> import dvrk_drake as dvrk
        >>> connection = dvrk.connect(dvrk.load_arm("mtml"), lcm_url="memq://")
        >>> connection.collect_poses("missing.yaml", "poses.csv")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        dvrk_drake.errors.CollectionError: missing.yaml: the pose file does not exist. ...
    """

    arm: Arm
    model: IdentifiedModel
    transport: Literal["lcm", "ros"]
    dialog: Dialog
    lcm_url: str = ""
    key: MessageKey | None = None
    topic: str | None = None
    domain: int | None = None
    reset: bool = False
    guard: GuardSettings = field(default_factory=GuardSettings)
    ready: Callable[[], None] = field(default=lambda: None)

    def measure(self, seconds: float = 0.25) -> Measured:
        """Returns the mean measurement over a time [s]. The arm gets no command.

        Raises:
            ControllerError: No measurement arrives.
            DvrkDrakeError: The arm is not found on ROS 2.
        """
        with self._observer() as next_status:
            statuses = [next_status(FIRST_WAIT)]
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                statuses.append(next_status(SILENCE))
        blocks = np.array([[s.position, s.velocity, s.effort_measured] for s in statuses])
        q, v, effort = blocks.mean(axis=0)
        return Measured(q, v, effort, len(blocks))

    def hold(self) -> None:
        """Commands the arm to hold its pose, also while another process controls it.

        Over LCM, an operator must then resume; see `stop_arm`. Over ROS 2, the arm receives `hold`. It does not end
        another process that publishes commands.

        Raises:
            ControllerError: No status arrives, the arm does not stop, or it does not confirm `hold`.
            DvrkDrakeError: The arm is not found on ROS 2.
        """
        if self.transport == "lcm":
            with closing(self._lcm_link()) as link:
                stop_arm(link)
            return
        with closing(open_ros_domain(self.domain)) as ros:
            from dvrk_drake.systems.ros.crtk_client import find_arm, publish_hold

            namespace = find_arm(ros, self.arm, self.topic, report=self.dialog.report, stopped=self.dialog.stopped)
            if not publish_hold(ros, namespace, FIRST_WAIT):
                raise ControllerError(f"{namespace}: the arm did not confirm hold. PRESS THE STOP BUTTON")

    def run(
        self,
        controller: Mode | System = "gravity",
        *,
        gains: Gains | None = None,
        friction: FrictionCompensator | None = None,
        report: Callable[[LiveStatus], None] = lambda status: None,
    ) -> None:
        """Controls the arm until `dialog.stopped` returns true. The arm then holds its pose.

        Args:
            controller: Mode of a `GravityPidController`, or a System with an input port `state_estimated` (2n) and an
                output port `effort` (n), for example with a period of 1 ms.
            gains: Gains for all modes except "gravity". None: the gains of the arm.
            friction: Friction compensator for the modes "gravity" and "guide". None: friction is not compensated.
            report: Function that is called with the live status a few times per second.

        Raises:
            ControllerError: The arm cannot be controlled in its present state, or its guard holds it.
            DvrkDrakeError: The arm is not found on ROS 2, or another process could move it.
        """
        made, link = self._start(controller, gains, friction)
        mode = f"mode {controller}" if isinstance(controller, str) else "control"
        self.dialog.report(f"{mode} of {self.arm.name} at {1 / made.period:.0f} Hz as sender {made.sender_id}")
        self._control(link, made, self.dialog.stopped, report=report)

    def teach(self, path: str | Path, *, at_rest: bool = False) -> int:
        """Adds poses to a pose file while the operator moves the arm by hand, until `dialog.stopped` returns true.

        Args:
            path: Pose file. The poses of an existing file are kept.
            at_rest: Whether to add each pose at which the arm is at rest for one second, besides those of the Enter
                key.

        Returns:
            Number of poses in the file.

        Raises:
            CollectionError: The file exists and does not contain poses of this arm.
            DvrkDrakeError: See `run`.
        """
        load_poses_if_any(path, self.arm)  # rejects an invalid file before the arm is connected
        controller, link = self._start("gravity")
        enter = self.dialog.enter or (lambda: False)
        teacher = Teacher(controller, path, at_rest=at_rest, requested=enter, report=self.dialog.report)
        text = f"{self.arm.name} compensates gravity; move the arm by hand"
        self.dialog.report(text)
        try:
            self._control(link, controller, self.dialog.stopped, lambda: f"{len(teacher.poses)} poses", teacher.update)
        finally:
            teacher.close()
        return len(teacher.poses)

    def record(self, path: str | Path, duration: float = float("inf")) -> list[str]:
        """Records the measurements of the arm until `dialog.stopped` returns true. The arm gets no command.

        Args:
            path: New file: *.mcap, or over LCM also *.csv or *.log.
            duration: Duration since the first measurement [s].

        Returns:
            Notes on the recording, one line each.

        Raises:
            RecordingError: The file cannot be written, or no measurement arrives.
            DvrkDrakeError: The arm is not found on ROS 2.
        """
        recorder: ArmRecorder
        if self.transport == "ros":
            recorder = RosRecorder(self.arm, path, self.topic, self.domain, self.dialog.report)
        else:
            check_stream_output(path)
            recorder = LcmRecorder(self.arm, path, open_lcm(self.lcm_url).get_lcm_url(), self.key)
        self.dialog.report(f"recording {self.arm.name} on {recorder.source}")
        recorder.run(duration, self.dialog.stopped, self.dialog.show)
        self.dialog.report(f"wrote {path}: {recorder.num_rows} rows")
        return recorder.notes()

    def collect_poses(
        self, poses: str | Path, output: str | Path, settings: CollectionSettings | None = None
    ) -> Collector | None:
        """Moves the arm to poses and measures its efforts at rest. A later call continues an incomplete output.

        Over LCM, this process controls the arm. Over ROS 2, the dVRK moves the arm (`move_jp`), and the messages are
        also written to a new bag beside the output.

        Args:
            poses: Pose file.
            output: CSV file with one row per pose.
            settings: Settings of the collection. None: `CollectionSettings()`.

        Returns:
            Collector at the end, with `done`, `unsettled` and `problem`. None: the output was complete already, or
            `dialog.stopped` returned true before the first motion.

        Raises:
            CollectionError: A file is not valid, the arm cannot reach the first pose, or it is not ready.
            DvrkDrakeError: See `run`.
        """
        settings = settings or CollectionSettings()
        checked, dialog = load_poses(poses, self.arm), self.dialog
        file = CollectionFile(output, self.arm, settings.both_sides)
        remaining = checked[~file.finished(checked)]
        if not len(remaining):
            dialog.report(f"{output}: contains all {len(checked)} poses already")
            return None
        dialog.report(f"{len(remaining)} poses of {self.arm.name} remain; a later call continues after an interruption")
        controller: ArmController | GoalController
        bag: RosRecorder | None = None
        if self.transport == "lcm":
            controller, link = self._start("hold")
            (first, *_) = approaches(self.arm, remaining[0], settings, controller.style)
            _, link = self._check_path(link, remaining[0] if first is None else first, pose_environment(poses))
        else:
            from dvrk_drake.systems.ros.crtk_move_link import connect_move_link

            self.ready()
            model, ros = ControlModel(self.model), open_ros_domain(self.domain)
            try:
                moved = connect_move_link(
                    ros, self.arm, model, self.topic, settings.max_effort, report=dialog.report, stopped=dialog.stopped
                )
                for line in summary(self.arm, np.array(moved.next_status(SILENCE).position), remaining, settings):
                    dialog.report(line)
                dialog.confirm()
                if dialog.stopped():
                    ros.close()
                    return None
                controller, link = GoalController(self.arm, lambda: moved.is_busy), moved
                bag = RosRecorder(self.arm, bag_path(output), moved.where, ros)
                bag.subscribe(dialog.stopped)
            except BaseException:
                ros.close()
                raise
        collector = Collector(
            checked, controller, file, settings, stopped=dialog.stopped, enter=dialog.enter, report=dialog.report
        )

        def on_status(status: lcmt_dvrk_status, time: float) -> NDArray[np.float64] | None:
            if bag is not None:
                bag.update()
            return collector.update(status, time)

        with contextlib.ExitStack() as stack:
            if bag is not None:
                stack.callback(bag.close)
            stack.callback(collector.close)
            self._control(link, controller, lambda: collector.finished, collector.describe, on_status)
        if bag is not None:
            for line in (f"{bag.num_rows} messages; hold was published", *bag.notes()):
                dialog.report(f"{bag.path}: {line}")
        return collector

    def play(self, path: str | Path, output: str | Path | None = None) -> PlayedMotion:
        """Moves the arm along a motion, and records it. A later call records the missing part of the motion.

        Args:
            path: Motion file.
            output: CSV file for the measurements. If it contains a part of the motion, the missing part is written to a
                new file beside it. None: rehearsal of one period at a fifth of the speed, which is not recorded. It is
                required once before the first recording.

        Raises:
            CollectionError: The motion exceeds a limit of the arm or was not rehearsed, or the arm does not follow.
            DvrkDrakeError: A file is not valid; see also `run`.
        """
        motion, dialog = PeriodicMotion.load(path, self.arm), self.dialog
        begin, end, part, create = 0.0, motion.period, None, None
        if output is not None:
            parts = motion_parts.recorded_parts(output, self.arm, motion)
            rest, end = motion_parts.begin_of_rest(parts, motion.duration), motion.duration
            if rest is None:
                return PlayedMotion(end, end, end, None, 0.0, True)
            if not motion_parts.is_rehearsed(path, self.arm, motion):
                raise CollectionError(
                    f"{path}: the motion was not rehearsed on {self.arm.name}. First run: dvrk-drake collect motion "
                    f"{path} --arm {self.arm.name.lower()} --rehearse"
                )
            begin, part = rest, motion_parts.next_part(output, parts)
            file = part

            def create() -> motion_parts.MotionPartFile:
                return motion_parts.MotionPartFile(file, self.arm, motion)

        # The limits of the arm and of its guard are checked independently of those of the design.
        if violations := motion_violations(motion, self.arm, execution_limits(motion.environment), self.model):
            raise CollectionError(f"{path}: {violations[0]}; design a motion within the limits of {self.arm.name}")
        controller, link = self._start("hold")
        q, link = self._check_path(link, motion.evaluate([begin]).q[0], motion.environment)
        speed = REHEARSAL_SPEED if output is None else 1.0
        player = MotionPlayer(
            motion,
            controller,
            q,
            output=create,
            begin=begin,
            end=end,
            speed=speed,
            stopped=dialog.stopped,
            enter=dialog.enter or (lambda: False),
            report=dialog.report,
        )
        what = f"rehearsal of {path} at {100 * speed:.0f} % speed" if output is None else str(path)
        seconds = (end - begin) / speed
        dialog.report(f"{self.arm.name} moves to the start and then for {seconds:.0f} s: {what}")
        try:
            self._control(link, controller, lambda: player.finished, player.describe, player.update)
        finally:
            player.close()
        if player.problem is not None:
            raise player.problem
        span, is_complete = self.arm.position_upper - self.arm.position_lower, player.motion_time >= end
        if output is None and is_complete:
            errors = player.largest_error.tolist()
            rehearsal = motion_parts.Rehearsal(
                arm=self.arm.name, motion=motion.digest(), speed=speed, tracking_error=errors
            )
            part = rehearsal.save(path)
        written = part if player.motion_time > begin and (is_complete or output is not None) else None
        largest = float((player.largest_error / span).max())
        return PlayedMotion(begin, player.motion_time, motion.duration, written, largest, is_complete)

    def _start(
        self,
        mode: Mode | System,
        gains: Gains | None = None,
        friction: FrictionCompensator | None = None,
    ) -> tuple[ArmController, ArmLink]:
        """Checks that the arm may be controlled. Returns a controller, and a link that accepts only this session."""
        if self.transport == "ros":
            self.ready()  # the threads of DDS inherit the scheduling of this thread
            link: ArmLink = self._ros_link()
            try:
                _, period = first_status(link)
                made = ArmController(self.arm, self.model, mode, period, friction, gains)
            except BaseException:
                link.close()
                raise
            return made, link
        self.dialog.report(f"waiting for {self.arm.name} on LCM {self.lcm_url}".rstrip())
        with closing(self._lcm_link()) as checked:
            if self.reset:
                reset_fault(checked, self.dialog.report)
            status, period = first_status(checked)
        made = ArmController(self.arm, self.model, mode, period, friction, gains)
        self.ready()
        # Messages that arrived during the creation of the controller are out of date, so a new link is opened.
        return made, self._lcm_link(status)

    def _lcm_link(self, before: lcmt_dvrk_status | None = None) -> LcmArmLink:
        return LcmArmLink(self.arm, open_lcm(self.lcm_url).get_lcm_url(), key=self.key, before=before)

    def _ros_link(self) -> ArmLink:
        """Returns a link to the guarded arm on ROS 2, once the rate of its measurements is known."""
        require_cyclonedds()
        from dvrk_drake.systems.ros.crtk_link import CrtkArmLink

        driver = CrtkDriver(domain=self.domain, namespace=self.topic or "", guard=self.guard)
        link = CrtkArmLink(self.arm, driver, report=self.dialog.report, stopped=self.dialog.stopped)
        _settle(link)
        return link

    def _control(
        self,
        link: ArmLink,
        controller: ArmController | GoalController,
        stopped: Callable[[], bool],
        describe: Callable[[], str] | None = None,
        on_status: StatusHandler = lambda status, time: None,
        *,
        report: Callable[[LiveStatus], None] = lambda status: None,
    ) -> None:
        def show(status: LiveStatus) -> None:
            report(status)
            if describe is not None:
                self.dialog.show(lambda: f"{describe()}; {status}")

        with closing(link):
            control(link, controller, stopped, show, on_status)

    def _check_path(
        self, link: ArmLink, q_end: NDArray[np.float64], environment: Environment
    ) -> tuple[NDArray[np.float64], ArmLink]:
        """Checks the straight path in joint space from the present pose to a pose (n,). An error closes the link.

        Returns:
            Present pose (n,), and a link without the messages that arrived during the check, which are out of date.

        Raises:
            CollectionError: The links would collide on the path, or the motors cannot hold the arm.
            ControllerError: The arm sends no status.
        """
        try:
            status = link.next_status(SILENCE)
            q = np.array(status.position)
            if obstacle := path_obstacle(self.arm, q, q_end, environment, self.model):
                raise CollectionError(
                    f"{self.arm.name} cannot move from its present pose to the first pose: {obstacle}. Move the arm "
                    "by hand to another pose first (dvrk-drake control --mode gravity)"
                )
            if self.transport == "ros":
                _settle(link)
                return q, link
        except BaseException:
            link.close()
            raise
        link.close()
        return q, self._lcm_link(status)

    @contextlib.contextmanager
    def _observer(self) -> Iterator[Callable[[float], lcmt_dvrk_status]]:
        """Yields a function that returns the next measurement as a status, without commands to the arm."""
        if self.transport == "lcm":
            with closing(self._lcm_link()) as link:
                yield link.next_status
            return
        with closing(open_ros_domain(self.domain)) as ros:
            from dvrk_drake.systems.ros.crtk_client import CrtkObserver

            observer = CrtkObserver(ros, self.arm, self.topic, self.dialog.report, self.dialog.stopped)
            yield observer.next_status


def _settle(link: ArmLink) -> None:
    """Waits until a guard in this process accepts efforts: the rate of the measurements is known, no step was late."""
    end = time.monotonic() + _RATE_WAIT
    while link.next_status(FIRST_WAIT).fault_text and time.monotonic() < end:
        pass


def connect(
    arm: Arm,
    transport: Literal["lcm", "ros"] = "lcm",
    *,
    model: IdentifiedModel | str | Path | None = None,
    lcm_url: str = "",
    key: str | Path | None = None,
    topic: str | None = None,
    domain: int | None = None,
    reset: bool = False,
    guard: GuardSettings | None = None,
    dialog: Dialog | None = None,
    ready: Callable[[], None] = lambda: None,
) -> ArmConnection:
    """Returns a connection to an arm, whose methods measure, move and control the arm.

    Over LCM, the process of the arm checks the commands: `dvrk-drake sim-arm` or `dvrk-drake bridge`. Over ROS 2, this
    process checks the commands to a dVRK, and a deadman process holds the arm if this process ends or stops.

    Args:
        arm: Arm to connect.
        transport: "lcm" for the messages of this package, "ros" for the topics of a dVRK on ROS 2.
        model: Model for the control of the arm, or its file. None: the nominal model of the arm.
        lcm_url: URL of the LCM network. "": the environment variable LCM_DEFAULT_URL, or else LCM's default.
        key: File with the key that signs LCM messages. None: messages are not signed.
        topic: Topic measured_js of the arm on ROS 2, or its namespace. None: the only topic of this arm.
        domain: ROS domain. None: the environment variable ROS_DOMAIN_ID, or else 0.
        reset: Whether to clear a fault over LCM, or to resume after a watchdog hold, before the arm is controlled.
        guard: Settings of the command guard over ROS 2. None: the defaults. Over LCM, the process of the arm has the
            guard.
        dialog: Functions for the communication with the operator. None: there is none, and a motion runs to its end.
        ready: Function that is called before this process commands the arm, e.g. to handle signals and to request
            real-time scheduling. Over ROS 2, it is called before the connection.

    Raises:
        ModelError: The model cannot be read, or belongs to another arm.
        KeyFileError: The key cannot be used.
        ControllerError: The transport is not known.

    Example:
        >>> import dvrk_drake as dvrk
        >>> connection = dvrk.connect(dvrk.load_arm("mtml"), lcm_url="memq://")
        >>> connection.transport, connection.model.arm.name
        ('lcm', 'MTML')
    """
    if transport not in ("lcm", "ros"):
        raise ControllerError(f'transport is "{transport}"; allowed: lcm, ros')
    dialog = dialog or Dialog()
    if model is None:
        used = IdentifiedModel.from_arm(arm)
    elif isinstance(model, IdentifiedModel):
        used = model
    else:
        used = IdentifiedModel.load(model, arm)
        if warning := model_warning(str(model), used):
            dialog.report(f"warning: {warning}")
    loaded = None if key is None else MessageKey.load(key)
    return ArmConnection(
        arm, used, transport, dialog, lcm_url, loaded, topic, domain, reset, guard or GuardSettings(), ready
    )


def model_warning(path: str, model: IdentifiedModel) -> str:
    """Returns a warning if the model was not validated or a joint failed the validation, otherwise ""."""
    if model.validation is None:
        bad = unfit(cross_validated_verdicts(model), "usable")
        verdict = f"; verdict by cross-validation: {', '.join(bad)}" if bad else ""
        command = f"dvrk-drake validate OTHER.csv --model {path} --save"
        return f"{path}: the model was not validated on another recording{verdict}; run: {command}"
    verdicts = model.validation.verdicts
    if not (bad := unfit({joint.name: verdicts[joint.name] for joint in model.joints}, "usable")):
        return ""
    recording = model.validation.recording
    return f"{path}: failed validation on {recording}: {', '.join(bad)}; for these joints, zero torque may be better"
