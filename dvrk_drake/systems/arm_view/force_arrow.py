"""Arrow of an external force on an arm, with the ellipsoid of its uncertainty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from dvrk_drake.dynamics.contact import MAX_DEVIATION
from dvrk_drake.systems.arm_view.drawn_arm import Visibility

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
_SHAFT, _HEAD, _HEAD_LENGTH = 0.0025, 0.007, 0.02
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


class ForceArrow:
    """Arrow that begins at the point of a force. Its end is the centre of the ellipsoid that contains 95 % of forces.

    Objects are moved and scaled only, so that a recording stores them.
    """

    def __init__(self, meshcat: Meshcat, path: str, shown: Visibility) -> None:
        """Adds the hidden objects below a path of Meshcat."""
        self._meshcat, self._path, self._visibility = meshcat, path, shown
        meshcat.SetObject(f"{path}/arrow/shaft/cylinder", Cylinder(_SHAFT, 1.0), _COLOR)
        meshcat.SetTransform(f"{path}/arrow/shaft/cylinder", RigidTransform([0.0, 0.0, 0.5]))
        meshcat.SetObject(f"{path}/head/size/cone", MeshcatCone(_HEAD_LENGTH, _HEAD, _HEAD), _COLOR)
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
        end = drawn.point + LENGTH * drawn.force
        head = min(_HEAD_LENGTH, length)
        self._place("arrow", RigidTransform(R, drawn.point), "shaft", [1.0, 1.0, length - head], time)
        # The point of the cone is at its origin, and the cone extends along z.
        back = R @ RotationMatrix.MakeXRotation(np.pi)
        self._place("head", RigidTransform(back, end), "size", [head / _HEAD_LENGTH] * 3, time)
        variances, axes = np.linalg.eigh(drawn.covariance)
        axes[:, 0] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
        radii = LENGTH * _RADIUS_95 * np.sqrt(np.clip(variances, 0.0, MAX_DEVIATION**2))
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(axes), end)
        self._place("ellipsoid", X, "size", radii.tolist(), time)

    def _place(self, name: str, X: RigidTransform, scaled: str, scale: list[float], time: float | None) -> None:
        self._meshcat.SetTransform(f"{self._path}/{name}", X, time)
        sizes = [max(size, _MIN_SCALE) for size in scale]
        self._meshcat.SetProperty(f"{self._path}/{name}/{scaled}", "scale", sizes, time)
