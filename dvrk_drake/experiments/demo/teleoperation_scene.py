"""Meshcat scene of the teleoperation demo: bases, ground and camera, overlays of both arms, and captions."""

from __future__ import annotations

from time import monotonic

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_view.camera import Camera, geometry_corners
from dvrk_drake.systems.arm_view.captions import Captions
from dvrk_drake.systems.arm_view.overlay import TITLE_EDGE, ArmOverlay
from dvrk_drake.systems.arm_view.page import add_ground, start_meshcat
from dvrk_drake.systems.arm_view.scene import Scene
from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms

#: Positions of the bases in the world frame [m]. Both bases have the same orientation.
BASE_POSITIONS = {"mtml": (0.0, 0.45, 0.05), "psm": (0.0, -0.22, 0.0)}
#: The target is right of the arms, so that the control panel in the upper right corner does not cover them.
CAMERA, TARGET = (2.4, 0.86, 0.68), (0.0, 0.1, 0.08)
#: Upper edge of the caption with clutch, scale and error, see `systems.arm_view.camera.Camera.point`.
STATUS_EDGE = -0.62


class TeleoperationScene:
    """Overlays of both arms and captions."""

    def __init__(self, arms: TeleoperatedArms, meshcat: Meshcat) -> None:
        """Adds the overlays. The ghost of the PSM shows its desired pose."""
        camera = Camera.looking_at(CAMERA, TARGET)
        self._overlays = {
            station: ArmOverlay(
                station.arm,
                meshcat,
                X_WB=RigidTransform(np.array(BASE_POSITIONS[station.arm.name.lower()])),
                camera=camera,
                legend=station is arms.master,
            )
            for station in (arms.master, arms.follower)
        }
        self._captions = _captions(meshcat)
        self._captions.set_text("title", "MTML teleoperates PSM", v=TITLE_EDGE)
        self._next_text = 0.0

    def draw(self, arms: TeleoperatedArms, context: Context, time: float | None = None) -> None:
        """Draws the efforts of both arms, the ghost and the trace of the tip."""
        for station, overlay in self._overlays.items():
            name, n = station.arm.name.lower(), station.arm.num_joints
            station_context = arms.GetSubsystemContext(station, context)
            desired = arms.GetOutputPort("desired_state").Eval(context)[:n] if station is arms.follower else None
            overlay.draw(
                station.GetPositions(station_context),
                effort=station.GetOutputPort(f"{name}.effort_measured").Eval(station_context),
                desired=desired,
                time=time,
            )

    def set_phase(self, text: str, time: float) -> None:
        """Shows and records the state of the clutch."""
        self._captions.set_phase(text, time)

    def show_status(self, follows: bool, scale: float, tracking: float | None) -> None:
        """Shows clutch, scale and tracking error [m] at most twice per second."""
        if (now := monotonic()) < self._next_text:
            return
        self._next_text = now + 0.5
        clutch = "clutch closed: PSM follows" if follows else "clutch open: PSM holds its pose"
        error = "" if tracking is None else f"   tracking error {1e3 * tracking:.1f} mm"
        self._captions.set_text("status", f"{clutch}   scale {scale:.2f}{error}", v=STATUS_EDGE)


def _captions(meshcat: Meshcat) -> Captions:
    return Captions(Scene(meshcat, "captions"), Camera.looking_at(CAMERA, TARGET), RigidTransform())


def start_scene(port: int | None = None) -> Meshcat:
    """Starts Meshcat, sets the base poses of both arms, and shows that they are being loaded.

    If `port` is None, Meshcat uses a free port.
    """
    meshcat = start_meshcat(port=port, camera=CAMERA, target=TARGET)
    _captions(meshcat).set_text("title", "Loading MTML and PSM ...", v=TITLE_EDGE)
    corners = []
    for name, p_WB in BASE_POSITIONS.items():
        meshcat.SetTransform(name, RigidTransform(np.array(p_WB)))
        corners.append(geometry_corners(load_arm(name)) + p_WB)
    add_ground(meshcat, np.concatenate(corners))
    return meshcat
