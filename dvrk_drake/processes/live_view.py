"""Displays the messages of an arm, in the process `dvrk-drake view --live`."""

from __future__ import annotations

import lcm
import numpy as np

from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ArmError, ControllerError
from dvrk_drake.lcmtypes import lcmt_dvrk_force, lcmt_dvrk_status
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.lcm_messages import decode, describe_state, force_channel
from dvrk_drake.systems.arm_view.arm_view import ArmView
from dvrk_drake.systems.arm_view.efforts import DrawnForce
from dvrk_drake.systems.lcm.arm_link import ArmLink
from dvrk_drake.systems.lcm.messages import handle_message

#: Longest time to wait for a status [s]. It is short, so that the view can be closed at any time.
_TIMEOUT = 0.2
#: Largest difference between the times of a force and of the drawn status [us]: 20 periods of the topic.
_MAX_AGE = 200_000
#: Largest number of forces that are read for one picture, so that a flood of messages cannot stop the view.
_MAX_MESSAGES = 200


class LiveForce:
    """Newest estimated force on an arm, from the messages of `control` or `bridge` with --publish-force."""

    def __init__(self, arm: Arm, url: str) -> None:
        """Subscribes to the forces on the LCM network `url`."""
        self._arm, self._frame, self._last = arm, ArmFrame(arm), lcmt_dvrk_force()
        self._lcm = lcm.LCM(url)
        self._lcm.subscribe(force_channel(arm), lambda channel, data: self.receive(data))

    def receive(self, data: bytes) -> None:
        """Stores a force, unless the message is not valid."""
        force = decode(lcmt_dvrk_force, data)
        if force is None or force.arm_name != self._arm.name:
            return
        if force.frame_name != self._last.frame_name:
            try:
                self._frame = ArmFrame(self._arm, force.frame_name)
            except ArmError:
                return
        self._last = force

    def at(self, status: lcmt_dvrk_status) -> DrawnForce | None:
        """Returns the force in the base frame at the pose of a status. Returns None if it is old or not valid."""
        for _ in range(_MAX_MESSAGES):
            if not handle_message(self._lcm, 0.0):
                break
        covariance = np.array(self._last.force_covariance)
        is_old = abs(status.utime - self._last.utime) > _MAX_AGE
        if is_old or self._last.session_id != status.session_id or not np.all(np.isfinite(covariance)):
            return None
        X_BF = self._frame.pose(status.position)
        R = X_BF.rotation().matrix()
        return DrawnForce(X_BF.translation(), R @ np.nan_to_num(self._last.force), R @ covariance @ R.T)


def show_status(view: ArmView, link: ArmLink, force: LiveForce) -> None:
    """Displays the newest status, if there is a new status and its measured pose is finite.

    The view shows the measured pose and efforts, and the estimated force if it is published. A ghost shows the
    commanded pose, the control panel the guard state.
    """
    view.follow_controls()
    try:
        status = link.next_status(_TIMEOUT)
    except ControllerError:
        return
    if np.all(np.isfinite(status.position)):
        commanded = status.position_commanded
        desired = commanded if np.all(np.isfinite(commanded)) else None
        view.show(status.position, effort=status.effort_measured, desired=desired, force=force.at(status))
        view.overlay.set_state(describe_state(status.guard_state))
