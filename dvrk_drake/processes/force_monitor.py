"""Estimates the external force on an arm from its statuses: publishes it, and ends the control after a contact."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import Contact, is_measurable
from dvrk_drake.dynamics.momentum_observer import BANDWIDTH, MomentumObserver
from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.arm_schema import IMPLAUSIBLE

#: Longest time between two measurements [s] over which the estimate is continued: three time constants. After a longer
#: gap, it starts from 0.
_MAX_GAP = 3.0 / BANDWIDTH
#: Period in which the force is published [us], that of the topics of a dVRK.
_SEND_PERIOD = 10_000


class ForceMonitor:
    """Estimates the external force on an arm from its statuses, over LCM and ROS 2.

    The force acts at the origin of the frame `arm.frames.hand`, and is published in the axes of this frame. The
    covariance contains the assumed change of the efforts between days; see `ExternalForceEstimator`.

    Without a valid measurement, NaN is published once per period, and the estimate starts from 0 afterwards.
    """

    def __init__(
        self,
        model: IdentifiedModel,
        *,
        send: Callable[[lcmt_dvrk_force], None] | None = None,
        stop_on_contact: float | None = None,
    ) -> None:
        """Creates the monitor.

        Args:
            model: Model of the arm that was identified from a motion.
            send: Function that publishes the force, 100 times per second. None: it is not published.
            stop_on_contact: Expected number of false alarms per hour with which contacts are detected, see
                `MomentumObserver.threshold`. None: contacts are not detected.

        Raises:
            ModelError: The model was identified from static poses, or does not state its errors.
            ControllerError: The rate of false alarms is out of range.
        """
        arm = model.arm
        self._observer, self._contact, self._send = MomentumObserver(model), Contact(arm, axes="frame"), send
        self._threshold = np.inf if stop_on_contact is None else self._observer.threshold(stop_on_contact)
        self._state, self._utime, self._next_send = self._observer.start(), 0, 0
        self._observer.covariance(self._state)  # raises an error if the model does not state its errors
        self._message = lcmt_dvrk_force()
        self._message.arm_name, self._message.frame_name = arm.name, arm.frames.hand

    def update(self, status: lcmt_dvrk_status) -> None:
        """Continues the estimate with a status. A repeated measurement is ignored.

        Raises:
            ControllerError: Something touches the arm.
        """
        period = 1e-6 * (status.utime - self._utime)
        if period <= 0:
            return
        self._utime = status.utime
        q, v, tau = (np.array(x) for x in (status.position, status.velocity, status.effort_measured))
        is_valid = bool(np.all(np.abs([q, v, tau]) < IMPLAUSIBLE))  # false for NaN
        if period > _MAX_GAP or not is_valid:
            self._state = self._observer.start()
        if is_valid:
            self._observer.update(self._state, q, v, tau, min(period, _MAX_GAP))
            if np.isfinite(self._threshold):
                self._check(status.arm_name)
        if self._send is not None and status.utime >= self._next_send:
            self._next_send = status.utime + _SEND_PERIOD
            self._send(self._estimate(status, is_valid))

    def _estimate(self, status: lcmt_dvrk_status, is_valid: bool) -> lcmt_dvrk_force:
        message = self._message
        message.utime, message.session_id, message.sequence = status.utime, status.session_id, message.sequence + 1
        force, covariance = np.full(3, np.nan), np.full((3, 3), np.nan)
        if is_valid:
            observer, state = self._observer, self._state
            measured = observer.pose(state), observer.effort(state), observer.covariance(state)
            force, covariance = (x[0] for x in self._contact.force(*(x[None] for x in measured)))
            force[~is_measurable(covariance)] = np.nan
        message.force, message.force_covariance = force.tolist(), covariance.tolist()
        return message

    def _check(self, name: str) -> None:
        if self._observer.significance(self._state) <= self._threshold:
            return
        effort = self._observer.effort(self._state)
        deviation = np.sqrt(np.diag(self._observer.covariance(self._state)))
        joint = int(np.argmax(np.abs(effort) / deviation))
        arm = self._observer.model.arm
        unit = "N" if arm.prismatic[joint] else "N m"
        raise ControllerError(
            f"{name}: contact: the external effort of {arm.joint_names[joint]} is {effort[joint]:.3g} {unit}, with a "
            f"standard deviation of {deviation[joint]:.2g} {unit} without a contact. The arm holds. Remove the "
            "contact, then start again"
        )
