"""Texts of a view: captions at fixed places of the view, and joint names beside the joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import Rgba
from pydrake.math import RigidTransform, RotationMatrix

from dvrk_drake.systems.arm_view.camera import HALF_HEIGHT, Camera
from dvrk_drake.systems.arm_view.scene import Scene
from dvrk_drake.systems.arm_view.text import LINE, image_mesh, text_image

#: Height of a line of text, as a multiple of half the height of the view.
LINE_HEIGHT = 0.06
#: Depth of the texts, as a share of the depth of the objects that they describe. Texts are nearer, so that the arm does
#: not hide them.
NEARER = 0.6
#: Upper edge of the caption of the phase. Distance of the joint names to the right of their joints.
PHASE_EDGE, NAME_OFFSET = 0.84, 0.16
#: Number of images of a changing text that exist at the same time.
NUM_IMAGES = 32
#: Largest |u| and |v| of a point with a name, see `Camera.point`.
NAMES_INSIDE = 1.4, 0.78
#: Rotation of a text (x right, y into the view, z up) in the camera (x right, y up, z towards the viewer).
_R_CT = RotationMatrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
_LEADER = Rgba(0.1, 0.13, 0.17)


class Captions:
    """Texts that face the camera.

    If the browser reports its camera (`?tracked_camera=on` at the end of the address), the texts follow the camera.
    Otherwise they remain where they were placed for the last camera that was set.
    """

    def __init__(self, scene: Scene, camera: Camera, X_WB: RigidTransform) -> None:
        """Starts without texts. `X_WB` is the pose of the scene's root in the world."""
        self._scene, self._camera, self._X_BW = scene, camera, X_WB.inverse()
        self._texts: dict[str, tuple[int, str]] = {}  # number of the image, and the text
        self._sizes: dict[str, tuple[float, float]] = {}  # width and height, as multiples of half the view's height
        self._places: dict[str, tuple[float, float]] = {}
        self._phases: list[str] = []
        self._phase = ""

    def set_camera(self, camera: Camera) -> None:
        """Moves all captions into the view of `camera`. Joint names follow when they are placed the next time."""
        self._camera = camera
        for name, (u, v) in self._places.items():
            self._place(name, u, v, NEARER * camera.distance)

    def set_text(self, name: str, text: str, u: float = 0.0, v: float = 0.0) -> None:
        """Shows a text with the middle of its upper edge at (u, v), see `Camera.point`. "" hides the caption."""
        count, shown = self._texts.get(name, (-1, ""))
        if text and text != shown:
            # Meshcat deletes the image of a replaced object, although a slow browser may not have loaded it yet.
            self._scene.set_visible(f"{name}/{count % NUM_IMAGES}", False)
            count += 1
            self._texts[name] = count, text
            self.set_image(f"{name}/{count % NUM_IMAGES}", text_image(text), u, v)
            self._scene.set_visible(f"{name}/{count % NUM_IMAGES}", True)
        self._scene.set_visible(name, bool(text))

    def set_image(self, name: str, image: Image.Image, u: float, v: float) -> None:
        """Shows an image with the middle of its upper edge at (u, v), see `Camera.point`."""
        self._add(name, image)
        self._places[name] = u, v
        self._place(name, u, v, NEARER * self._camera.distance)

    def set_phase(self, text: str, time: float | None = None) -> None:
        """Shows the name of a phase below the upper edge of the view. A recording stores the change at `time` [s]."""
        if text and text not in self._phases:
            # One object per phase, because a recording can store the visibility of an object, but not its text.
            self._phases.append(text)
            path = f"phase/{len(self._phases)}"
            self.set_image(path, text_image(text), 0.0, PHASE_EDGE)
            self._scene.set_visible(path, False)
        if text != self._phase:
            for name, visible in ((self._phase, False), (text, True)):
                if name:
                    self._scene.set_visible(f"phase/{self._phases.index(name) + 1}", visible, time)
            self._phase = text

    def place_names(self, names: Sequence[str], p_BJ: NDArray[np.float64]) -> None:
        """Shows names beside the points p_BJ (k, 3) [m] in the base frame, with lines from the points to the names.

        Names of neighbouring points are below each other. Points outside the view have no name.
        """
        X_WB = self._X_BW.inverse()
        places = [self._camera.place(X_WB @ p) for p in p_BJ]
        starts, ends, lowest = [], [], np.inf
        for i in sorted(range(len(names)), key=lambda i: -places[i][1]):
            u, v, depth = places[i]
            path = f"names/{names[i]}"
            inside = depth > 0 and abs(u) < NAMES_INSIDE[0] and abs(v) < NAMES_INSIDE[1]
            self._scene.set_visible(path, inside)
            if not inside:
                continue
            if path not in self._sizes:
                self._add(path, text_image(names[i]))
            width, height = self._sizes[path]
            lowest = min(v + height / 2, lowest)
            at = u + NAME_OFFSET + width / 2, lowest
            self._place(path, *at, NEARER * depth)
            starts.append(self._camera.point(u, v, NEARER * depth))
            ends.append(self._camera.point(u + NAME_OFFSET, lowest - height / 2, NEARER * depth))
            lowest -= height * 1.05
        self._scene.set_visible("names/lines", bool(starts))
        if not starts:
            return
        lines = (np.asfortranarray(np.array([self._X_BW @ p for p in points]).T) for points in (starts, ends))
        self._scene.meshcat.SetLineSegments(self._scene.path("names/lines"), *lines, 2.0, _LEADER)

    def _add(self, name: str, image: Image.Image) -> None:
        height = LINE_HEIGHT * image.height / LINE
        self._sizes[name] = height * image.width / image.height, height
        # The object has the size for a depth of 1 m; `_place` scales it to other depths.
        self._scene.meshcat.SetObject(self._scene.path(name), image_mesh(image, height * HALF_HEIGHT))

    def _place(self, name: str, u: float, v: float, depth: float) -> None:
        v -= self._sizes[name][1] / 2
        X_WT = RigidTransform(self._camera.X_WC.rotation() @ _R_CT, self._camera.point(u, v, depth))
        self._scene.set_transform(name, self._X_BW @ X_WT, scale=depth)
