"""Paths of one arm in Meshcat. Transforms and visibilities are sent only if they change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform


class Scene:
    """Writes to the Meshcat paths below one root path.

    Attributes:
        meshcat: Meshcat that draws the scene.
    """

    def __init__(self, meshcat: Meshcat, root: str) -> None:
        """Creates a scene below `root`, e.g. "mtml/overlay". Existing objects below this path are deleted."""
        self.meshcat, self._root = meshcat, root
        self._transforms: dict[str, NDArray[np.float64]] = {}
        self._visible: dict[str, bool] = {}
        self._recorded: set[str] = set()
        self._moved: dict[str, RigidTransform] = {}
        meshcat.Delete(root)

    def path(self, name: str) -> str:
        """Returns the Meshcat path of `name`."""
        return f"{self._root}/{name}"

    def set_transform(self, name: str, X_PN: RigidTransform, time: float | None = None, scale: float = 1.0) -> None:
        """Sets the pose of `name` in its parent path, and its size.

        A recording stores the pose at `time` [s]. It cannot store a scale other than 1.
        """
        matrix = X_PN.GetAsMatrix4()
        matrix[:3, :3] *= scale
        # A recording interpolates between its samples, so it also requires the samples without a change.
        if time is None and name in self._transforms and np.array_equal(self._transforms[name], matrix):
            return
        self._transforms[name] = matrix
        if scale == 1.0:
            if time is not None:
                self._moved[name] = X_PN
            self.meshcat.SetTransform(self.path(name), X_PN, time)
        else:
            self.meshcat.SetTransform(self.path(name), np.asfortranarray(matrix))

    def set_visible(self, name: str, visible: bool, time: float | None = None) -> None:
        """Shows or hides `name`. A recording stores the change at `time` [s]."""
        before = self._visible.get(name)
        if before == visible:
            return
        self._visible[name] = visible
        if time is not None and name not in self._recorded:
            # An animation uses its first value also for earlier times.
            self._recorded.add(name)
            self.meshcat.SetProperty(self.path(name), "visible", before is not False, 0.0)
        self.meshcat.SetProperty(self.path(name), "visible", visible, time)

    def end_recording(self, time: float) -> None:
        """Stores the last pose and visibility of all recorded objects at the end of a recording [s].

        Otherwise the track of each object ends at its last change, and each track repeats alone.
        """
        for name, X_PN in self._moved.items():
            self.meshcat.SetTransform(self.path(name), X_PN, time)
        for name in self._recorded:
            self.meshcat.SetProperty(self.path(name), "visible", self._visible[name], time)
