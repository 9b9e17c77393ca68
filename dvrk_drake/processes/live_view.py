"""Displays the poses in the status messages of an arm, in the process `dvrk-drake view --live`."""

from __future__ import annotations

import numpy as np

from dvrk_drake.errors import ControllerError
from dvrk_drake.models.lcm_messages import describe_state
from dvrk_drake.systems.arm_view.arm_view import ArmView
from dvrk_drake.systems.lcm.arm_link import ArmLink

#: Longest time to wait for a status [s]. It is short, so that the view can be closed at any time.
_TIMEOUT = 0.2


def show_status(view: ArmView, link: ArmLink) -> None:
    """Displays the newest status, if there is a new status and its measured pose is finite.

    The view shows the measured pose and efforts. A ghost shows the commanded pose, the control panel the guard state.
    """
    view.follow_controls()
    try:
        status = link.next_status(_TIMEOUT)
    except ControllerError:
        return
    if np.all(np.isfinite(status.position)):
        commanded = status.position_commanded
        desired = commanded if np.all(np.isfinite(commanded)) else None
        view.show(status.position, effort=status.effort_measured, desired=desired)
        view.overlay.set_state(describe_state(status.guard_state))
