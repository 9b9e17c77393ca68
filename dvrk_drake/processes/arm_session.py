"""Channels of one arm over LCM or ROS 2, and its control by this process."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.excitation.motion_limits import path_obstacle
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import CollectionError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.lcm_messages import MessageKey
from dvrk_drake.processes.arm_controller import ArmController, GoalController
from dvrk_drake.processes.arm_operator import reset_fault
from dvrk_drake.processes.control import FIRST_WAIT, SILENCE, LiveStatus, StatusHandler, control, first_status
from dvrk_drake.processes.force_monitor import ForceMonitor
from dvrk_drake.systems.driver import CrtkDriver
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import Mode
from dvrk_drake.systems.guard.settings import GuardSettings
from dvrk_drake.systems.lcm.arm_link import ArmLink, LcmArmLink
from dvrk_drake.systems.lcm.messages import usable_lcm_url
from dvrk_drake.systems.ros.open_domain import require_cyclonedds

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


@dataclass
class ArmSession:
    """Channels of one arm with n joints. Each method opens them anew.

    Attributes:
        arm: Arm with n joints.
        model: Model for the control of the arm.
        transport: "lcm" or "ros".
        dialog: Functions for the communication with the operator.
        lcm_url, key, topic, domain, reset, guard, ready, stop_on_contact, publish_force: See
            `connect`.
        options: Options of a command line for this arm, for messages.
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
    stop_on_contact: float | None = None
    publish_force: bool = False
    options: str = ""

    def __post_init__(self) -> None:
        transport = " --transport ros" if self.transport == "ros" else ""
        self.options = self.options or f"--arm {self.arm.name.lower()}{transport}"

    def start(
        self,
        mode: Mode | System,
        gains: Gains | None = None,
        friction: FrictionCompensator | None = None,
    ) -> tuple[ArmController, ArmLink]:
        """Checks that the arm may be controlled.

        Args:
            mode, gains, friction: See `ArmController`.

        Returns:
            Controller, and a link that accepts only the statuses of this run of the arm's process.

        Raises:
            DvrkDrakeError: The arm is not found, or cannot be controlled in its present state.
        """
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
        with closing(self.open_lcm_link()) as checked:
            if self.reset:
                reset_fault(checked, self.dialog.report)
            status, period = first_status(checked)
        made = ArmController(self.arm, self.model, mode, period, friction, gains)
        self.ready()
        # Messages that arrived during the creation of the controller are out of date, so a new link is opened.
        return made, self.open_lcm_link(status)

    def open_lcm_link(self, before: lcmt_dvrk_status | None = None) -> LcmArmLink:
        """Opens the channels over LCM; see `LcmArmLink` for `before`."""
        return LcmArmLink(self.arm, usable_lcm_url(self.lcm_url), key=self.key, before=before)

    def _ros_link(self) -> ArmLink:
        """Returns a link to the guarded arm on ROS 2, once the rate of its measurements is known."""
        require_cyclonedds()
        from dvrk_drake.systems.ros.crtk_link import CrtkArmLink

        driver = CrtkDriver(domain=self.domain, namespace=self.topic or "", guard=self.guard)
        link = CrtkArmLink(self.arm, driver, report=self.dialog.report, stopped=self.dialog.stopped)
        _settle(link)
        return link

    def control(
        self,
        link: ArmLink,
        controller: ArmController | GoalController,
        stopped: Callable[[], bool],
        describe: Callable[[], str] | None = None,
        on_status: StatusHandler = lambda status, time: None,
        *,
        report: Callable[[LiveStatus], None] = lambda status: None,
    ) -> None:
        """Controls the arm until `stopped` returns true, then closes the link.

        Args:
            link, controller: See `start`.
            stopped, on_status: See `dvrk_drake.processes.control.control`.
            describe: Function that returns the progress for the status line. None: there is no status line.
            report: Function that is called with the live status a few times per second.

        Raises:
            ControllerError: See `dvrk_drake.processes.control.control`, or something touches the arm.
            ModelError: The force cannot be estimated with this model, see `ForceMonitor`.
        """

        def show(status: LiveStatus) -> None:
            report(status)
            if describe is not None:
                self.dialog.show(lambda: f"{describe()}; {status}")

        with closing(link):
            handler = on_status
            if self.stop_on_contact is not None or self.publish_force:
                send = link.send_force if self.publish_force else None
                monitor = ForceMonitor(self.model, send=send, stop_on_contact=self.stop_on_contact)

                def handler(status: lcmt_dvrk_status, time: float) -> NDArray[np.float64] | None:
                    monitor.update(status)
                    return on_status(status, time)

            control(link, controller, stopped, show, handler)

    def check_path(
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
                    f"by hand to another pose first (dvrk-drake control {self.options} --mode gravity)"
                )
            if self.transport == "ros":
                _settle(link)
                return q, link
        except BaseException:
            link.close()
            raise
        link.close()
        return q, self.open_lcm_link(status)


def _settle(link: ArmLink) -> None:
    """Waits until a guard in this process accepts efforts: the rate of the measurements is known, no step was late."""
    end = time.monotonic() + _RATE_WAIT
    while link.next_status(FIRST_WAIT).fault_text and time.monotonic() < end:
        pass
