"""Meshcat scene of the teleoperation demo: bases, ground and camera, overlays of both arms, and state."""

from __future__ import annotations

from time import monotonic

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_view.camera import geometry_corners
from dvrk_drake.systems.arm_view.controls import PanelText
from dvrk_drake.systems.arm_view.efforts import DrawnForce
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import add_ground, start_meshcat
from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms

#: Positions of the bases in the world frame [m]. Both bases have the same orientation.
BASE_POSITIONS = {"mtml": (0.0, 0.45, 0.05), "psm": (0.0, -0.22, 0.0)}
#: The target is right of the arms, so that the control panel in the upper right corner does not cover them.
CAMERA, TARGET = (2.4, 0.86, 0.68), (0.0, 0.1, 0.08)


class TeleoperationScene:
    """Overlays of both arms, and the state of the teleoperation in the control panel."""

    def __init__(self, arms: TeleoperatedArms, meshcat: Meshcat) -> None:
        """Adds the overlays. The ghost of the PSM shows its desired pose."""
        self._overlays = {station: ArmOverlay(station.arm, meshcat) for station in (arms.master, arms.follower)}
        self._state = PanelText(meshcat)
        self._next_text = 0.0

    def draw(self, arms: TeleoperatedArms, context: Context, time: float | None = None) -> None:
        """Draws the efforts of both arms, the ghost and the trace of the tip, and the force if it is reflected."""
        for station, overlay in self._overlays.items():
            name, n = station.arm.name.lower(), station.arm.num_joints
            station_context = arms.GetSubsystemContext(station, context)
            desired = arms.GetOutputPort("desired_state").Eval(context)[:n] if station is arms.follower else None
            overlay.draw(
                station.GetPositions(station_context),
                effort=station.GetOutputPort(f"{name}.effort_measured").Eval(station_context),
                desired=desired,
                force=self._force(arms, context) if station is arms.follower else None,
                time=time,
            )

    @staticmethod
    def _force(arms: TeleoperatedArms, context: Context) -> DrawnForce | None:
        if not arms.HasOutputPort("force"):
            return None
        force, covariance = (arms.GetOutputPort(name).Eval(context) for name in ("force", "force_covariance"))
        return DrawnForce(arms.CalcX_FT(context).translation(), force, covariance.reshape(3, 3))

    def show_status(self, follows: bool, tracking: float | None) -> None:
        """Shows the clutch and the tracking error [m] at most twice per second."""
        if (now := monotonic()) < self._next_text:
            return
        self._next_text = now + 0.5
        error = "" if tracking is None else f", error {1e3 * tracking:.1f} mm"
        self._state.show(("clutch closed" if follows else "clutch open") + error)


def start_scene(port: int | None = None) -> Meshcat:
    """Starts Meshcat with the ground and the base poses of both arms.

    If `port` is None, Meshcat uses a free port.
    """
    meshcat = start_meshcat(port=port, camera=CAMERA, target=TARGET)
    corners = []
    for name, p_WB in BASE_POSITIONS.items():
        meshcat.SetTransform(name, RigidTransform(np.array(p_WB)))
        corners.append(geometry_corners(load_arm(name)) + p_WB)
    add_ground(meshcat, np.concatenate(corners))
    return meshcat
