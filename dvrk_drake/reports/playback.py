"""3D animation of a recording or of a simulation for a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import REFERENCE

if TYPE_CHECKING:
    from dvrk_drake.systems.arm_view.efforts import DrawnForce

#: Largest rate [Hz] and largest number of key frames. Meshcat interpolates between key frames.
MAX_RATE, MAX_FRAMES = 30.0, 400
_GHOST = "ghost"


def frame_times(start: float, end: float) -> NDArray[np.float64]:
    """Returns the times (k,) of the key frames of a motion from `start` to `end` [s]."""
    count = int(min((end - start) * MAX_RATE, MAX_FRAMES - 1)) + 1
    return np.linspace(start, end, max(count, 2))


def playback(
    arm: Arm,
    t: NDArray[np.float64],
    q: NDArray[np.float64],
    tau: NDArray[np.float64] | None = None,
    *,
    color: str = "",
    ghost: NDArray[np.float64] | None = None,
    forces: Sequence[DrawnForce] | None = None,
    phases: Sequence[tuple[float, str]] = (),
    colors: Mapping[str, str] | None = None,
    title: str = "",
) -> str:
    """Returns a page of Meshcat with an endless animation of the arm. It starts at t[0].

    Args:
        arm: Arm to draw.
        t: Times (m,) of the poses, increasing [s].
        q: Poses (m, n) of the joints [rad, m].
        tau: Efforts (m, n) of the joints [N m, N]. None: they are not drawn.
        color: Colour of the arm as "#rrggbb". "": the colours of its model file.
        ghost: Poses (m, n) of a second arm [rad, m], translucent in the colour `REFERENCE`. None: there is none.
        forces: External force at each of the m times. None: there is no arrow.
        phases: Start times [s] of the phases, and their names.
        colors: CSS colours and their meanings, see `page_html`.
        title: Title of the page. "": the name of the arm.

    Raises:
        ArmError: The arm has no visual geometry.
        DvrkDrakeError: No port of this computer is free.
    """
    # Slow to import, and a terminal shows no animation.
    from pydrake.geometry import MeshcatAnimation, Rgba

    from dvrk_drake.systems.arm_view.drawn_arm import DrawnArm
    from dvrk_drake.systems.arm_view.efforts import FORCE_COLOR, FORCE_SCALE
    from dvrk_drake.systems.arm_view.overlay import ArmOverlay
    from dvrk_drake.systems.arm_view.page import page_html, start_meshcat

    def rgba(colour: str, opacity: float) -> Rgba:
        return Rgba(*(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)), opacity)

    times = frame_times(float(t[0]), float(t[-1]))
    poses, efforts, ghosts = (
        None if values is None else np.column_stack([np.interp(times, t, x) for x in values.T])
        for values in (q, tau, ghost)
    )
    assert poses is not None
    period = float(times[1] - times[0])
    nearest = np.abs(np.subtract.outer(times, t)).argmin(axis=1) if forces is not None else None
    ends = None if forces is None or nearest is None else [forces[k].end for k in nearest]
    meshcat = start_meshcat(arm, poses=poses if ghosts is None else np.vstack([poses, ghosts]), points=ends)
    links = DrawnArm(arm, meshcat, f"{arm.name.lower()}/links", color=rgba(color, 1.0) if color else None)
    overlay = ArmOverlay(arm, meshcat, trace=False)
    if ghosts is not None:
        overlay.add_ghost(_GHOST, rgba(REFERENCE, 0.5))
    meshcat.StartRecording(frames_per_second=1 / period)
    for k, pose in enumerate(poses):
        # The time is in the middle of the frame, so that rounding does not change the number of the frame.
        time = (k + 0.5) * period
        links.draw(pose, time)
        overlay.draw(
            pose,
            effort=None if efforts is None else efforts[k],
            ghosts=None if ghosts is None else {_GHOST: ghosts[k]},
            force=None if forces is None or nearest is None else forces[nearest[k]],
            time=time,
        )
    overlay.end_recording(time)
    meshcat.StopRecording()
    animation = meshcat.get_mutable_recording()
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    animation.set_repetitions(10_000)
    meshcat.PublishRecording()
    relative = [(start - float(t[0]), text) for start, text in phases]
    shown = dict(colors or {}) | ({} if forces is None else {FORCE_COLOR: FORCE_SCALE})
    return page_html(meshcat, title or arm.name, phases=relative, colors=shown, effort_scale=tau is not None)
