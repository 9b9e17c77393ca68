"""Overlay of an arm in Meshcat: ghosts, efforts, frames, joint names, RCM, tip trace and captions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_view.camera import Camera, close_up, framing, geometry_corners, home_position
from dvrk_drake.systems.arm_view.captions import Captions
from dvrk_drake.systems.arm_view.efforts import EffortArcs, share_color
from dvrk_drake.systems.arm_view.ghost import ORANGE, GhostArm
from dvrk_drake.systems.arm_view.joints import ArmJoints
from dvrk_drake.systems.arm_view.markers import FrameAxes, RemoteCenter, TipTrace
from dvrk_drake.systems.arm_view.scene import Scene
from dvrk_drake.systems.arm_view.text import color_scale_image

WHOLE_ARM = "whole arm"
#: Pose of the camera of `Camera` in Meshcat's camera.
_X_CAMERA = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])))
DESIRED = "desired"
#: Upper edges of title and legend, see `Camera.point`.
TITLE_EDGE, LEGEND_EDGE = 0.97, -0.78
#: Largest radius of the effort arcs, length of the frames' axes, radius of the RCM, and distance below which arcs have
#: different radii, as multiples of the size of the arm.
_ARC, _AXIS, _RCM, _NEAR = 0.085, 0.07, 0.009, 0.05
#: Size of arcs and frames on the screen in a close-up, as a multiple of their size in the view of the whole arm.
_CLOSE_UP = 3.0


class ArmOverlay:
    """Information about an arm, drawn in Meshcat in addition to its links.

    The overlay does not draw the links. `ArmStation(arm, meshcat=meshcat)` or `ArmView` draws them. All objects are
    below the path of the arm, e.g. "mtml/overlay", so `SetTransform("mtml", X_WB)` moves them together with the links.

    With `time`, the methods also store the drawn objects in the recording of Meshcat, if one was started. The names of
    joints, the trace of the tip, and texts other than phases are not part of the recording.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from dvrk_drake.systems.arm_view.overlay import ArmOverlay
        >>> from dvrk_drake.systems.arm_view.page import page_html
        >>> arm = dvrk.load_arm("mtml")
        >>> meshcat = dvrk.start_meshcat(arm)
        >>> overlay = ArmOverlay(arm, meshcat)
        >>> meshcat.StartRecording()
        >>> overlay.set_phase("held", time=0.0)
        >>> overlay.draw([0.0] * 7, effort=[0.0, 1.6, 0.0, 0.0, 0.0, 0.0, 0.0], desired=[0.1] * 7, time=0.0)
        >>> meshcat.StopRecording()
        >>> meshcat.PublishRecording()
        >>> "<title>MTML</title>" in page_html(meshcat, "MTML")
        True
    """

    def __init__(
        self,
        arm: Arm,
        meshcat: Meshcat,
        *,
        X_WB: RigidTransform | None = None,
        camera: Camera | None = None,
        legend: bool = True,
    ) -> None:
        """Adds the overlay. Nothing is visible except the RCM of the arm, if it has one.

        Args:
            arm: Arm that the overlay describes.
            meshcat: Meshcat with the arm.
            X_WB: Pose of the arm's base in the world. None: identity.
            camera: Camera for which the texts are placed. None: the camera of `start_meshcat(arm)`.
            legend: Whether the colour scale of the efforts is shown together with the efforts.
        """
        self.arm, self.meshcat = arm, meshcat
        self._X_WB = X_WB or RigidTransform()
        self._camera = camera or self._looking_at(*framing(arm))
        self._scene = Scene(meshcat, f"{arm.name.lower()}/overlay")
        self.captions = Captions(self._scene, self._camera, self._X_WB)
        self._joints = ArmJoints(arm)
        self._q = home_position(arm)
        self._joints.set_positions(self._q)
        size = float(np.ptp(geometry_corners(arm), axis=0).max())
        radii = _radii(self._origins(), size)
        self._efforts = EffortArcs(arm, self._joints, self._scene, radii)
        self._frames = FrameAxes(self._joints, self._scene, _AXIS * size)
        self._ghosts: dict[str, GhostArm] = {}
        self._shows_names, self._shows_efforts, self._has_legend = False, False, legend
        rcm = arm.frames.remote_center
        self._rcm = RemoteCenter(self._joints, self._scene, rcm, _RCM * size) if rcm else None
        self._trace = TipTrace(self._joints, self._scene, arm.frames.hand)
        self._scene.set_visible("names", False)
        self._legend_drawn = False
        self._tracked = RigidTransform()
        self._whole_distance, self._scale = self._camera.distance, 1.0

    def add_ghost(self, name: str, color: Rgba = ORANGE) -> None:
        """Adds a translucent arm, which `draw` shows if its argument `ghosts` has a pose with this name."""
        self._ghosts[name] = GhostArm(self.arm, self._scene, f"ghost/{name}", color)

    def draw(
        self,
        q: ArrayLike,
        *,
        effort: ArrayLike | None = None,
        desired: ArrayLike | None = None,
        ghosts: Mapping[str, ArrayLike] | None = None,
        time: float | None = None,
    ) -> None:
        """Moves the overlay to the pose of the arm.

        Args:
            q: Pose (n,) [rad, m] of the arm.
            effort: Efforts (n,) [N m, N] to show. None: the efforts remain as they are.
            desired: Desired or commanded pose (n,) [rad, m], drawn as a ghost. None: this ghost is hidden.
            ghosts: Poses of the other ghosts, see `add_ghost`. Ghosts without a pose are hidden.
            time: Time in the recording of Meshcat [s]. None: the objects are not recorded.
        """
        self._q = np.array(q, float)
        self._joints.set_positions(self._q)
        if effort is not None:
            if not self._shows_efforts:
                self.show_efforts(True)
            self._efforts.draw(effort, time)
        poses = dict(ghosts or {})
        if desired is not None:
            poses[DESIRED] = desired
            if DESIRED not in self._ghosts:
                self.add_ghost(DESIRED)
        if unknown := set(poses) - set(self._ghosts):
            raise DvrkDrakeError(f"unknown ghost {sorted(unknown)[0]}; known: {', '.join(self._ghosts) or 'none'}")
        for name, ghost in self._ghosts.items():
            if name in poses:
                ghost.draw(poses[name], self._q, time)
            else:
                ghost.hide(time)
        self._efforts.move(time, self._scale)
        self._frames.move(time, self._scale)
        self._trace.draw()
        self._draw_names()

    def set_phase(self, text: str, time: float | None = None) -> None:
        """Shows the name of a phase, e.g. "released". "" shows nothing. A recording stores the change at `time` [s]."""
        self.captions.set_phase(text, time)

    def end_recording(self, time: float) -> None:
        """Stores the last state of all objects at the end of a recording [s], so that all tracks have one length."""
        self._scene.end_recording(time)

    def set_title(self, text: str) -> None:
        """Shows a title at the upper edge of the view."""
        self.captions.set_text("title", text, v=TITLE_EDGE)

    def show_frames(self, visible: bool) -> None:
        """Shows or hides the frames of the DH convention (x red, y green, z blue); see `ArmJoints.frame_names`."""
        self._frames.show(visible)

    def show_names(self, visible: bool) -> None:
        """Shows or hides the names of the joints."""
        self._shows_names = visible
        self._scene.set_visible("names", visible)
        self._draw_names()

    def show_efforts(self, visible: bool) -> None:
        """Shows or hides the efforts of the joints and their legend. `draw` with an effort shows them."""
        self._shows_efforts = visible
        self._scene.set_visible("efforts", visible)
        if self._has_legend:
            if visible and not self._legend_drawn:
                colors = [share_color(share) for share in np.linspace(0, 1, 50)]
                image = color_scale_image("joint effort / effort limit", colors, ("0 %", "50 %", "100 %"))
                self.captions.set_image("legend", image, 0.0, LEGEND_EDGE)
                self._legend_drawn = True
            self._scene.set_visible("legend", visible)

    def clear_trace(self) -> None:
        """Deletes the trace of the tip."""
        self._trace.clear()

    @property
    def camera_presets(self) -> tuple[str, ...]:
        """Names of camera positions for `look_at`: the whole arm, and the close-ups of the arm's file."""
        return (WHOLE_ARM, *self.arm.view.close_ups)

    def look_at(self, preset: str) -> None:
        """Moves the camera to one of `camera_presets`. A close-up shows its links at the pose that was drawn last."""
        links = self.arm.view.close_ups.get(preset)
        position, target = framing(self.arm) if links is None else close_up(self.arm, self._q, tuple(links))
        camera = self._looking_at(position, target)
        # In a close-up, arcs and frames would otherwise be larger than the links.
        self._scale = min(1.0, _CLOSE_UP * camera.distance / self._whole_distance)
        self._efforts.move(scale=self._scale)
        self._frames.move(scale=self._scale)
        if self._rcm is not None:
            self._rcm.resize(self._scale)
        self._set_camera(camera)
        self.meshcat.SetCameraPose(self._X_WB @ position, self._X_WB @ target)

    def follow_camera(self) -> None:
        """Turns the texts to the camera, if the browser reports its camera; see `tracked_url`."""
        X_WC = self.meshcat.GetTrackedCameraPose()
        if X_WC is None or X_WC.IsNearlyEqualTo(self._tracked, 1e-9):
            return
        self._tracked = X_WC
        self._set_camera(Camera(X_WC @ _X_CAMERA, self._camera.distance))

    def _origins(self) -> NDArray[np.float64]:
        """Returns points (n, 3) on the axes of the joints in the base frame [m]."""
        return np.array([X_BJ.translation() for X_BJ in self._joints.axis_frames()])

    def _looking_at(self, p_BC: ArrayLike, p_BT: ArrayLike) -> Camera:
        return Camera.looking_at(self._X_WB @ np.asarray(p_BC), self._X_WB @ np.asarray(p_BT))

    def _set_camera(self, camera: Camera) -> None:
        self._camera = camera
        self.captions.set_camera(camera)
        self._draw_names()

    def _draw_names(self) -> None:
        if self._shows_names:
            names = [f"{i + 1} {name}" for i, name in enumerate(self.arm.joint_names)]
            self.captions.place_names(names, self._origins())


def _radii(origins: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Returns radii (n,) of the effort arcs [m]. Arcs of joints at nearly the same place have different radii."""
    near = np.linalg.norm(origins[:, None] - origins, axis=2) < _NEAR * size
    return _ARC * size * 0.82 ** np.tril(near, -1).sum(axis=1)
