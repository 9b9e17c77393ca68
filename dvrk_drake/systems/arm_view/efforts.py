"""Arcs that show the effort of each joint, and the arrow of an external force with the ellipsoid of its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from dvrk_drake.dynamics.kinematics import MAX_DEVIATION
from dvrk_drake.models.arm import Arm
from dvrk_drake.systems.arm_view.drawn_arm import Visibility

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


class EffortArcs:
    """One arc per joint around its axis. A prismatic joint has a straight arrow instead.

    Length and colour show the share of the effort limit, rounded to the nearest of `LEVELS`. The arrow head points in
    the direction of the effort. A thin line shows the length of a positive effort at the limit.
    """

    def __init__(self, arm: Arm, meshcat: Meshcat, path: str, radii: NDArray[np.float64], shown: Visibility) -> None:
        """Adds the arcs below a path of Meshcat. `radii` (n,) are their radii [m]."""
        self._arm, self._meshcat, self._path, self._visibility = arm, meshcat, path, shown
        self._levels = np.zeros(arm.num_joints, int)
        for i, name in enumerate(arm.joint_names):
            scale = _line(1.0, radii[i]) if arm.prismatic[i] else _arc(1.0, radii[i])
            meshcat.SetLine(f"{path}/{name}/scale", np.asfortranarray(scale), 2.0, SCALE_COLOR)
            for level, share in enumerate(LEVELS[1:], 1):
                color = Rgba(*share_color(share))
                points = _line(share, radii[i]) if arm.prismatic[i] else _arc(share, radii[i])
                vertices, faces = _arrow(points, radii[i])
                reversed_axis = 2 if arm.prismatic[i] else 1
                for sign in (1, -1):
                    arc = f"{path}/{name}/{sign * level}"
                    vertices[reversed_axis] *= sign
                    meshcat.SetTriangleMesh(arc, np.asfortranarray(vertices), np.asfortranarray(faces), color)
                    shown.set(arc, False)

    def draw(self, effort: ArrayLike, time: float | None = None) -> None:
        """Draws the efforts (n,) [N m, N]. A recording stores them at `time` [s]."""
        share = np.asarray(effort, float) / self._arm.effort_limits
        nearest = np.searchsorted((np.array(LEVELS[1:]) + LEVELS[:-1]) / 2, np.abs(np.nan_to_num(share)))
        levels = (np.sign(np.nan_to_num(share)) * nearest).astype(int)
        for name, before, after in zip(self._arm.joint_names, self._levels, levels, strict=True):
            if before != after:
                for level in (before, after):
                    if level:
                        self._visibility.set(f"{self._path}/{name}/{level}", bool(level == after), time)
        self._levels = levels

    def move(self, X_BJ: Sequence[RigidTransform], time: float | None = None, scale: float = 1.0) -> None:
        """Moves the arcs to the poses of `axis_frames`, and scales them.

        A recording stores the poses at `time` [s]. It cannot store a scale other than 1.
        """
        for name, X in zip(self._arm.joint_names, X_BJ, strict=True):
            if scale == 1.0:
                self._meshcat.SetTransform(f"{self._path}/{name}", X, time)
            else:
                matrix = X.GetAsMatrix4() * [[scale, scale, scale, 1.0]]
                self._meshcat.SetTransform(f"{self._path}/{name}", np.asfortranarray(matrix))

    @property
    def shares(self) -> NDArray[np.float64]:
        """Shares (n,) of the effort limits that are drawn."""
        return np.sign(self._levels) * np.array(LEVELS)[np.abs(self._levels)]


def axis_frames(arm: Arm, plant: MultibodyPlant, context: Context) -> list[RigidTransform]:
    """Returns one pose per joint: origin of the joint, z along its axis, and x fixed to the parent link."""
    poses = []
    for name in arm.joint_names:
        joint = plant.GetJointByName(name)
        axis = joint.translation_axis() if joint.type_name() == "prismatic" else joint.revolute_axis()
        X_FJ = RigidTransform(RotationMatrix.MakeFromOneVector(np.asarray(axis, float), 2))
        poses.append(joint.frame_on_parent().CalcPoseInWorld(context) @ X_FJ)
    return poses


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


#: Length of the arrow [m/N]. 10 N are a quarter of the length of a PSM.
LENGTH = 0.02
#: Colour, which no other object of an overlay has, and those of arrow and ellipsoid.
FORCE_COLOR = "#0d8026"
_COLOR, _ELLIPSOID_COLOR = (Rgba(0.05, 0.5, 0.15, alpha) for alpha in (1.0, 0.3))
#: Text for the control panel, which is 40 characters wide.
FORCE_SCALE = f"force: {1e3 * LENGTH:.0f} mm per N, ellipsoid: 95 %"
#: Square root of the 95 % quantile of the chi-squared distribution with 3 degrees of freedom.
_RADIUS_95 = 2.7955
#: Radii of the shaft and of the head, and length of the head [m].
_SHAFT, _HEAD_RADIUS, _HEAD_LENGTH = 0.0025, 0.007, 0.02
#: Smallest scale of an object. With 0, Meshcat cannot invert its transform.
_MIN_SCALE = 1e-3


class DrawnForce(NamedTuple):
    """Force to draw, in the base frame.

    Attributes:
        point: Position (3,) of the point at which the force acts [m].
        force: Force (3,) on the arm [N]. It is 0 in directions that the arm cannot measure.
        covariance: Covariance (3, 3) of the force [N^2]. Standard deviations above `MAX_DEVIATION` are drawn as this
            value.
    """

    point: NDArray[np.float64]
    force: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def end(self) -> NDArray[np.float64]:
        """End (3,) of the arrow in the base frame [m]."""
        return self.point + LENGTH * self.force


class ForceArrow:
    """Arrow that begins at the point of a force. Its end is the centre of the ellipsoid that contains 95 % of forces.

    Objects are moved and scaled only, so that a recording stores them.
    """

    def __init__(self, meshcat: Meshcat, path: str, shown: Visibility) -> None:
        """Adds the hidden objects below a path of Meshcat."""
        self._meshcat, self._path, self._visibility = meshcat, path, shown
        meshcat.SetObject(f"{path}/arrow/shaft/cylinder", Cylinder(_SHAFT, 1.0), _COLOR)
        meshcat.SetTransform(f"{path}/arrow/shaft/cylinder", RigidTransform([0.0, 0.0, 0.5]))
        meshcat.SetObject(f"{path}/head/size/cone", MeshcatCone(_HEAD_LENGTH, _HEAD_RADIUS, _HEAD_RADIUS), _COLOR)
        meshcat.SetObject(f"{path}/ellipsoid/size/sphere", Sphere(1.0), _ELLIPSOID_COLOR)
        shown.set(path, False)

    def draw(self, drawn: DrawnForce | None, time: float | None = None) -> None:
        """Draws a force, or hides the arrow. A recording stores it at `time` [s]."""
        self._visibility.set(self._path, drawn is not None, time)
        if drawn is None:
            return
        length = LENGTH * float(np.linalg.norm(drawn.force))
        axis = drawn.force if length > 0 else np.array([0.0, 0.0, 1.0])
        R = RotationMatrix.MakeFromOneVector(axis, 2)
        head = min(_HEAD_LENGTH, length)
        self._place("arrow", RigidTransform(R, drawn.point), "shaft", [1.0, 1.0, length - head], time)
        # The point of the cone is at its origin, and the cone extends along z.
        back = R @ RotationMatrix.MakeXRotation(np.pi)
        self._place("head", RigidTransform(back, drawn.end), "size", [head / _HEAD_LENGTH] * 3, time)
        variances, axes = np.linalg.eigh(drawn.covariance)
        axes[:, 0] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
        radii = LENGTH * _RADIUS_95 * np.sqrt(np.clip(variances, 0.0, MAX_DEVIATION**2))
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(axes), drawn.end)
        self._place("ellipsoid", X, "size", radii.tolist(), time)

    def _place(self, name: str, X: RigidTransform, scaled: str, scale: list[float], time: float | None) -> None:
        self._meshcat.SetTransform(f"{self._path}/{name}", X, time)
        sizes = [max(size, _MIN_SCALE) for size in scale]
        self._meshcat.SetProperty(f"{self._path}/{name}/{scaled}", "scale", sizes, time)
