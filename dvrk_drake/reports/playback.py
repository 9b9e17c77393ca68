"""3D animation of a recording for a report."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_view.drawn_arm import DrawnArm
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import page_html, start_meshcat

#: Largest rate [Hz] and largest number of key frames. Meshcat interpolates between key frames.
MAX_RATE, MAX_FRAMES = 30.0, 400


def frame_times(start: float, end: float) -> NDArray[np.float64]:
    """Returns the times (k,) of the key frames of a motion from `start` to `end` [s]."""
    count = int(min((end - start) * MAX_RATE, MAX_FRAMES - 1)) + 1
    return np.linspace(start, end, max(count, 2))


def playback(arm: Arm, t: NDArray[np.float64], q: NDArray[np.float64], tau: NDArray[np.float64]) -> str:
    """Returns a page of Meshcat with an animation of the arm and its efforts. It starts at t[0].

    Args:
        arm: Arm to draw.
        t: Times (m,) of the poses, increasing [s].
        q: Poses (m, n) of the joints [rad, m].
        tau: Efforts (m, n) of the joints [N m, N].

    Raises:
        ArmError: The arm has no visual geometry.
        DvrkDrakeError: No port of this computer is free.
    """
    times = frame_times(float(t[0]), float(t[-1]))
    poses, efforts = (np.column_stack([np.interp(times, t, x) for x in values.T]) for values in (q, tau))
    period = float(times[1] - times[0])
    meshcat = start_meshcat(arm)
    links, overlay = DrawnArm(arm, meshcat, f"{arm.name.lower()}/links"), ArmOverlay(arm, meshcat)
    meshcat.StartRecording(frames_per_second=1 / period)
    for k, (pose, effort) in enumerate(zip(poses, efforts, strict=True)):
        # The time is in the middle of the frame, so that rounding does not change the number of the frame.
        time = (k + 0.5) * period
        links.draw(pose, time)
        overlay.draw(pose, effort=effort, time=time)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return page_html(meshcat, arm.name, effort_scale=True)
