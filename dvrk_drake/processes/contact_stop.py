"""Ends the control of an arm when something touches it. The arm then holds its pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.momentum_observer import BANDWIDTH, MomentumObserver
from dvrk_drake.errors import ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.processes.control import StatusHandler

#: Longest time between two measurements [s] over which the estimate is continued: three time constants. After a longer
#: gap, it starts from 0.
_MAX_GAP = 3.0 / BANDWIDTH


class ContactStop:
    """Status handler that raises an error when the external effort is significant, see `MomentumObserver.threshold`.

    `control` commands HOLD after an error, and the guard of the arm regulates the pose.
    """

    def __init__(
        self,
        model: IdentifiedModel,
        false_alarms_per_hour: float,
        handler: StatusHandler = lambda status, time: None,
    ) -> None:
        """Creates the handler.

        Args:
            model: Model of the arm that was identified from a motion.
            false_alarms_per_hour: Expected number of false alarms per hour.
            handler: Handler that returns the desired state.

        Raises:
            ModelError: The model was identified from static poses, or does not state its errors.
            ControllerError: The rate of false alarms is out of range.
        """
        self._observer, self._handler = MomentumObserver(model), handler
        self._threshold = self._observer.threshold(false_alarms_per_hour)
        self._state, self._utime = self._observer.start(), 0
        self._observer.covariance(self._state)

    def __call__(self, status: lcmt_dvrk_status, time: float) -> NDArray[np.float64] | None:
        """Returns the desired state of the handler. The arguments are those of `StatusHandler`.

        Raises:
            ControllerError: Something touches the arm.
        """
        period = 1e-6 * (status.utime - self._utime)
        if period > 0:
            if period > _MAX_GAP:
                self._state = self._observer.start()
            self._utime = status.utime
            q, v, tau = (np.array(x) for x in (status.position, status.velocity, status.effort_measured))
            self._observer.update(self._state, q, v, tau, min(period, _MAX_GAP))
            self._check(status.arm_name)
        return self._handler(status, time)

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
