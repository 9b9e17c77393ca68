"""Frames, remote centre of motion (RCM) and tip trace of an arm."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Cylinder, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from dvrk_drake.systems.arm_view.joints import ArmJoints
from dvrk_drake.systems.arm_view.scene import Scene

#: Colours of the x, y and z axes of a frame, of the RCM and of the trace of the tip.
AXES = (Rgba(0.85, 0.1, 0.1), Rgba(0.05, 0.6, 0.15), Rgba(0.1, 0.25, 0.9))
RCM_COLOR, TRACE_COLOR = Rgba(0.6, 0.1, 0.65), Rgba(0.6, 0.1, 0.65)
#: Distance between two positions of which the second one begins a new trace [m], e.g. of two poses without a motion. At
#: 1 m/s, the positions of 30 pictures per second differ by 0.033 m.
TRACE_JUMP = 0.1
#: Shortest distance between two points of the trace [m]. Maximum number of points.
TRACE_STEP, TRACE_POINTS = 5e-4, 2000


class FrameAxes:
    """Axes of the frames of an arm: x red, y green, z blue."""

    def __init__(self, joints: ArmJoints, scene: Scene, length: float) -> None:
        """Adds the hidden axes of `joints.frame_names`. `length` is the length of an axis [m]."""
        self._joints, self._scene = joints, scene
        for name in joints.frame_names:
            for axis, color in enumerate(AXES):
                path, direction = f"frames/{name}/{'xyz'[axis]}", np.eye(3)[axis]
                scene.meshcat.SetObject(scene.path(path), Cylinder(0.04 * length, length), color)
                X = RigidTransform(RotationMatrix.MakeFromOneVector(direction, 2), direction * length / 2)
                scene.set_transform(path, X)
        self.show(False)

    def show(self, visible: bool) -> None:
        """Shows or hides all frames."""
        self._scene.set_visible("frames", visible)

    def move(self, time: float | None = None, scale: float = 1.0) -> None:
        """Moves the frames to the pose of the joints, and scales them. A recording stores the pose at `time` [s]."""
        for name in self._joints.frame_names:
            self._scene.set_transform(f"frames/{name}", self._joints.frame_pose(name), time, scale)


class RemoteCenter:
    """Sphere at the remote centre of motion, i.e. at the origin of the SDF frame `frame_name`."""

    def __init__(self, joints: ArmJoints, scene: Scene, frame_name: str, radius: float) -> None:
        """Adds the sphere with this radius [m]."""
        self._scene, self._X_BR = scene, joints.frame_pose(frame_name)
        scene.meshcat.SetObject(scene.path("rcm"), Sphere(radius), RCM_COLOR)
        self.resize(1.0)

    def resize(self, scale: float) -> None:
        """Scales the sphere."""
        self._scene.set_transform("rcm", self._X_BR, scale=scale)


class TipTrace:
    """Line along the latest positions of the origin of the SDF frame `frame_name`."""

    def __init__(self, joints: ArmJoints, scene: Scene, frame_name: str) -> None:
        """Starts with an empty trace."""
        self._joints, self._scene, self._frame_name = joints, scene, frame_name
        self._points: deque[NDArray[np.float64]] = deque(maxlen=TRACE_POINTS)

    def draw(self) -> None:
        """Adds the current position. Meshcat cannot record a growing line, so a recording shows the whole line."""
        p = self._joints.frame_pose(self._frame_name).translation()
        step = np.linalg.norm(p - self._points[-1]) if self._points else np.inf
        if step < TRACE_STEP:
            return
        if TRACE_JUMP < step < np.inf:
            self.clear()
        self._points.append(p)
        if len(self._points) > 1:
            points = np.asfortranarray(np.array(self._points).T)
            self._scene.meshcat.SetLine(self._scene.path("trace"), points, 3.0, TRACE_COLOR)

    def clear(self) -> None:
        """Deletes all points."""
        self._points.clear()
        self._scene.meshcat.Delete(self._scene.path("trace"))
