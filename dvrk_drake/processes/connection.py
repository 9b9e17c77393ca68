"""Connection to an arm over LCM or ROS 2: measures it, moves it, and controls it."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dvrk_drake.analysis.results import cross_validated_verdicts, unfit
from dvrk_drake.dynamics.friction_compensation import Friction, holding_error, is_cross_validated
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains, load_gains
from dvrk_drake.models.lcm_messages import MessageKey, describe_state
from dvrk_drake.processes.arm_operator import ArmObservation, observe, stop_arm
from dvrk_drake.processes.arm_session import ArmSession, Dialog
from dvrk_drake.processes.collector import CollectionSettings, Collector, collect_poses
from dvrk_drake.processes.control import LiveStatus
from dvrk_drake.processes.force_monitor import ForceMonitor
from dvrk_drake.processes.motion_player import PlayedMotion, play_motion
from dvrk_drake.processes.recorder import ArmRecorder, LcmRecorder, RosRecorder
from dvrk_drake.processes.teacher import teach_poses
from dvrk_drake.recordings.writer_stream import check_stream_output
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import Mode
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.lcm.messages import usable_lcm_url
from dvrk_drake.systems.ros.discovery import find_topic
from dvrk_drake.systems.ros.open_domain import open_ros_domain

if TYPE_CHECKING:
    from pydrake.systems.framework import System

    from dvrk_drake.systems.ros.crtk_client import CrtkObserver


class ArmConnection(ArmSession):
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

    def watch(self, seconds: float = 0.5) -> Generator[ArmObservation]:
        """Yields the state of the arm again and again, each time over `seconds` [s], until `dialog.stopped`.

        The arm gets no command. Another process may control it.

        Raises:
            ControllerError: No status arrives over LCM.
            DvrkDrakeError: The arm is not found on ROS 2.
        """
        if self.transport == "lcm":
            with closing(self.open_lcm_link()) as link:
                while not self.dialog.stopped():
                    yield observe(link, seconds, self.options)
            return
        with closing(self._observer()) as observer:
            from dvrk_drake.processes.arm_operator import observe_dvrk

            while not self.dialog.stopped():
                yield observe_dvrk(observer, seconds, self.options)

    def measure(self, seconds: float = 0.25) -> ArmObservation:
        """Returns the mean measurement over a time [s], and the state of the arm. The arm gets no command.

        Raises:
            ControllerError: No valid measurement arrives.
            DvrkDrakeError: The arm is not found on ROS 2.
        """
        with closing(self.watch(seconds)) as states:
            observation = next(states)
        if not np.all(np.isfinite([observation.q, observation.v, observation.effort])):
            raise ControllerError(f"{self.arm.name} has no valid measurement: {observation.why}")
        return observation

    def hold(self, *, power_off: bool = False) -> str:
        """Commands the arm to hold its pose, also while another process controls it.

        Over LCM, an operator must then resume; see `stop_arm`. Over ROS 2, the arm receives `hold`. It does not end
        another process that publishes commands.

        Args:
            power_off: Whether to switch the motor power off afterwards. An arm without brakes falls.

        Returns:
            State of the arm afterwards.

        Raises:
            ControllerError: No status arrives, the arm does not stop or confirm, or its power stays on.
            DvrkDrakeError: The arm is not found on ROS 2.
        """
        if self.transport == "lcm":
            with closing(self.open_lcm_link()) as link:
                after = stop_arm(link, power_off=power_off)
            return describe_state(after.guard_state, after.fault_text)
        with closing(self._observer()) as observer:
            from dvrk_drake.processes.arm_operator import stop_dvrk

            return stop_dvrk(observer, power_off=power_off)

    def run(
        self,
        controller: Mode | System = "gravity",
        *,
        gains: Gains | str | Path | None = None,
        friction_ratio: float = 0.0,
        hysteresis_ratio: float = 0.0,
        friction_model: str | Path | None = None,
        report: Callable[[LiveStatus], None] = lambda status: None,
    ) -> None:
        """Controls the arm until `dialog.stopped` returns true. The arm then holds its pose.

        Args:
            controller: Mode of a `GravityPidController`, or a System with an input port `state_estimated` (2n) and an
                output port `effort` (n), for example with a period of 1 ms.
            gains: Gains for all modes except "gravity", or their file. None: the gains of the arm.
            friction_ratio, hysteresis_ratio: Compensated shares of the friction in the modes "gravity" and "guide"; see
                `FrictionCompensator`. They require a model that was identified from static poses.
            friction_model: File of the model with the friction, identified from a motion. None: the model of this
                connection.
            report: Function that is called with the live status a few times per second.

        Raises:
            ControllerError: The arm cannot be controlled in its present state, its guard holds it, or gains or ratios
                are not valid for the mode.
            ModelError: The model contains no friction or belongs to another arm.
            DvrkDrakeError: The arm is not found on ROS 2, or another process could move it.
        """
        if isinstance(gains, (str, Path)):
            gains = self._load_gains(gains, controller)
        friction = None
        if friction_ratio or hysteresis_ratio:
            friction = self._friction(controller, friction_ratio, hysteresis_ratio, friction_model)
        if controller == "guide" and not is_cross_validated(self.model):
            self.dialog.report(
                "warning: the error of the model is unknown, because it was not identified from a recording; virtual "
                "friction holds the arm only up to the dry friction of the arm file"
            )
        made, link = self.start(controller, gains, friction)
        mode = f"mode {controller}" if isinstance(controller, str) else "control"
        self.dialog.report(f"{mode} of {self.arm.name} at {1 / made.period:.0f} Hz as sender {made.sender_id}")
        self.control(link, made, self.dialog.stopped, report=report)

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
        return teach_poses(self, path, at_rest=at_rest)

    def record(self, path: str | Path, duration: float = float("inf")) -> list[str]:
        """Records the measurements of the arm until `dialog.stopped` returns true. The arm gets no command.

        Args:
            path: New file with the ending .mcap, or over LCM also .csv or .log.
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
            recorder = LcmRecorder(self.arm, path, usable_lcm_url(self.lcm_url), self.key)
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
        return collect_poses(self, poses, output, settings or CollectionSettings())

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
        return play_motion(self, path, output)

    def _load_gains(self, path: str | Path, controller: Mode | System) -> Gains:
        """Loads gains. Raises ControllerError if the mode uses none, or they are not valid for the arm."""
        if controller == "gravity":
            raise ControllerError(f"{path}: mode gravity does not use gains; allowed modes: damped, guide, hold")
        gains = load_gains(path)
        if fault := self.arm.gains_fault(gains):
            raise ControllerError(f"{path}: {fault}")
        return gains

    def _friction(
        self, controller: Mode | System, ratio: float, hysteresis_ratio: float, model: str | Path | None
    ) -> FrictionCompensator:
        """Returns the compensator for two ratios, and reports a reduced friction ratio. See `run` for errors."""
        if controller not in ("gravity", "guide"):
            raise ControllerError("a friction ratio or hysteresis ratio requires mode gravity or guide")
        if self.model.provenance.method == "nominal":
            raise ControllerError(
                "a friction ratio or hysteresis ratio requires an identified model; with compensated friction, an "
                "inaccurate gravity model makes the arm creep"
            )
        friction = Friction.of_model(self.model if model is None else IdentifiedModel.load(model, self.arm))
        error = holding_error(self.model) if ratio else None
        compensator = FrictionCompensator(friction, ratio=ratio, hysteresis_ratio=hysteresis_ratio, holding_error=error)
        elements = zip(friction.effects, compensator.ratios, friction.springs_back, strict=True)
        ratios = {e.coordinate: r for e, r, springs_back in elements if not springs_back}
        if reduced := ", ".join(f"{name} {r:.2f}" for name, r in ratios.items() if r < 0.99 * ratio):
            self.dialog.report(
                "warning: the friction ratio is reduced, because friction must resist the error of the gravity model. "
                f"Ratios: {reduced}"
            )
        return compensator

    def _observer(self) -> CrtkObserver:
        """Finds the arm on ROS 2. The caller closes the observer."""
        domain = open_ros_domain(self.domain)
        from dvrk_drake.systems.ros.crtk_client import CrtkObserver

        try:
            dialog = self.dialog
            topic = find_topic(domain, self.arm, self.topic, report=dialog.report, stopped=dialog.stopped)
            return CrtkObserver(domain, self.arm, topic.rpartition("/")[0])
        except BaseException:
            domain.close()
            raise


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
    stop_on_contact: float | None = None,
    publish_force: bool = False,
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
        stop_on_contact: Expected number of false alarms per hour with which this process detects a contact, ends the
            control and lets the arm hold its pose. It requires a model that was identified from a motion. None:
            contacts are not detected.
        publish_force: Whether this process publishes the estimated force at the frame `arm.frames.hand` while it
            controls the arm. It requires a model that was identified from a motion.

    Raises:
        ModelError: The model cannot be read, belongs to another arm, or is not suitable for `stop_on_contact` or
            `publish_force`.
        KeyFileError: The key cannot be used.
        ControllerError: The transport is not known, or the rate of false alarms is out of range.

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
    connection = ArmConnection(
        arm, used, transport, dialog, lcm_url, loaded, topic, domain, reset, guard or GuardSettings(), ready
    )
    if stop_on_contact is not None or publish_force:
        ForceMonitor(used, stop_on_contact=stop_on_contact)  # raises an error if the model is not suitable
        connection.stop_on_contact, connection.publish_force = stop_on_contact, publish_force
    return connection


def model_warning(path: str, model: IdentifiedModel) -> str:
    """Returns a warning if the model was not validated or a joint failed the validation, otherwise ""."""
    if model.validation is None:
        judged = {name: v for name, v in cross_validated_verdicts(model).items() if v != "not judged"}
        bad = unfit(judged, "usable")
        verdict = f"; verdict by cross-validation: {', '.join(bad)}" if bad else ""
        command = f"dvrk-drake validate OTHER.csv --model {path} --save"
        return f"{path}: the model was not validated on another recording{verdict}; run: {command}"
    verdicts = model.validation.verdicts
    if not (bad := unfit({joint.name: verdicts[joint.name] for joint in model.joints}, "usable")):
        return ""
    recording = model.validation.recording
    return f"{path}: failed validation on {recording}: {', '.join(bad)}; for these joints, zero torque may be better"
