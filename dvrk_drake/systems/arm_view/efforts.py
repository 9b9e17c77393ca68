"""Arcs that show the effort of each joint as a share of its effort limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Rgba

from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_view.joints import ArmJoints
from dvrk_drake.systems.arm_view.scene import Scene

#: Shares of the effort limit that are drawn, and angle of an arc at the effort limit [rad].
LEVELS = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
FULL_ANGLE = np.radians(300)
#: Colours at 0 %, 50 % and 100 % of the effort limit. They differ in lightness, so that a colour-blind person
#: distinguishes them.
_STOPS = np.array([[0.13, 0.44, 0.71], [0.97, 0.82, 0.20], [0.75, 0.10, 0.10]])
#: Colour of the line that shows the length of an arc at the effort limit.
SCALE_COLOR = Rgba(0.15, 0.18, 0.22)
#: Radius of the tube and of the base of the arrow head, as multiples of the radius of the arc.
_TUBE, _HEAD = 0.075, 0.2
_SIDES = 8


def share_color(share: float) -> NDArray[np.float64]:
    """Returns the RGB colour (3,) of an effort, for its share of the effort limit (0 to 1)."""
    return np.array([np.interp(share, (0.0, 0.5, 1.0), channel) for channel in _STOPS.T])


def _rgba(share: float) -> Rgba:
    return Rgba(*share_color(share), 1.0)


class EffortArcs:
    """One arc per joint around its axis. A prismatic joint has a straight arrow instead.

    Length and colour show the share of the effort limit, rounded to the nearest of `LEVELS`. The arrow head points in
    the direction of the effort. A thin line shows the length of a positive effort at the limit.
    """

    def __init__(self, arm: Arm, joints: ArmJoints, scene: Scene, radii: NDArray[np.float64]) -> None:
        """Adds the arcs. `radii` (n,) are their radii [m]."""
        self._arm, self._joints, self._scene = arm, joints, scene
        self._levels = np.zeros(arm.num_joints, int)
        scene.set_visible("efforts", False)
        for i, name in enumerate(arm.joint_names):
            scale = _line(1.0, radii[i]) if arm.prismatic[i] else _arc(1.0, radii[i])
            scene.meshcat.SetLine(scene.path(f"efforts/{name}/scale"), np.asfortranarray(scale), 2.0, SCALE_COLOR)
            for level, share in enumerate(LEVELS[1:], 1):
                points = _line(share, radii[i]) if arm.prismatic[i] else _arc(share, radii[i])
                vertices, faces = _arrow(points, radii[i])
                reversed_axis = 2 if arm.prismatic[i] else 1
                for sign in (1, -1):
                    path = f"efforts/{name}/{sign * level}"
                    vertices[reversed_axis] *= sign
                    scene.meshcat.SetTriangleMesh(
                        scene.path(path), np.asfortranarray(vertices), np.asfortranarray(faces), _rgba(share)
                    )
                    scene.set_visible(path, False)

    def draw(self, effort: ArrayLike, time: float | None = None) -> None:
        """Draws the efforts (n,) [N m, N]. A recording stores them at `time` [s]."""
        share = np.asarray(effort, float) / self._arm.effort_limits
        nearest = np.searchsorted((np.array(LEVELS[1:]) + LEVELS[:-1]) / 2, np.abs(np.nan_to_num(share)))
        levels = (np.sign(np.nan_to_num(share)) * nearest).astype(int)
        for i, name in enumerate(self._arm.joint_names):
            if levels[i] != self._levels[i]:
                for level, visible in ((self._levels[i], False), (levels[i], True)):
                    if level:
                        self._scene.set_visible(f"efforts/{name}/{level}", visible, time)
        self._levels = levels

    def move(self, time: float | None = None, scale: float = 1.0) -> None:
        """Moves the arcs to the pose of the joints, and scales them. A recording stores the pose at `time` [s]."""
        for name, X_BJ in zip(self._arm.joint_names, self._joints.axis_frames(), strict=True):
            self._scene.set_transform(f"efforts/{name}", X_BJ, time, scale)

    @property
    def shares(self) -> NDArray[np.float64]:
        """Shares (n,) of the effort limits that are drawn."""
        return np.sign(self._levels) * np.array(LEVELS)[np.abs(self._levels)]


def _arc(share: float, radius: float) -> NDArray[np.float64]:
    """Returns points (3, m) on a circle around z, counterclockwise from the x axis."""
    angle = np.linspace(0, share * FULL_ANGLE, 4 + int(24 * share))
    return radius * np.array([np.cos(angle), np.sin(angle), np.zeros_like(angle)])


def _line(share: float, radius: float) -> NDArray[np.float64]:
    """Returns points (3, 2) on a line parallel to z. Its length at the effort limit is that of the arc."""
    return radius * np.array([[1.0, 1.0], [0.0, 0.0], [0.0, 0.6 * share * FULL_ANGLE]])


def _arrow(points: NDArray[np.float64], radius: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Returns vertices (3, k) and faces (3, l) of a tube along points (3, m), with a cone at its end."""
    tangent = np.gradient(points, axis=1)
    tangent /= np.linalg.norm(tangent, axis=0)
    outward = points * [[1.0], [1.0], [0.0]]
    outward /= np.linalg.norm(outward, axis=0)
    binormal = np.cross(tangent, outward, axis=0)
    tip = points[:, -1] + 2 * _HEAD * radius * tangent[:, -1]
    centers = np.column_stack([points, points[:, -1], tip])
    widths = radius * np.array([_TUBE] * points.shape[1] + [_HEAD, 1e-3])
    side = 2 * np.pi * np.arange(_SIDES) / _SIDES
    last = [*range(points.shape[1]), -1, -1]
    rings = [
        centers[:, [i]] + widths[i] * (np.outer(outward[:, k], np.cos(side)) + np.outer(binormal[:, k], np.sin(side)))
        for i, k in enumerate(last)
    ]
    faces = []
    for i in range(len(rings) - 1):
        for a in range(_SIDES):
            b = (a + 1) % _SIDES
            one, two = i * _SIDES, (i + 1) * _SIDES
            faces += [(one + a, one + b, two + b), (one + a, two + b, two + a)]
    return np.hstack(rings), np.array(faces, np.int32).T
