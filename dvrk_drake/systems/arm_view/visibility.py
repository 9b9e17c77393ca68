"""Visibility of objects in Meshcat, live and in a recording."""

from __future__ import annotations

from pydrake.geometry import Meshcat


class Visibility:
    """Shows and hides objects. Only changes are sent."""

    def __init__(self, meshcat: Meshcat) -> None:
        """Starts with all objects as they are."""
        self._meshcat = meshcat
        self._visible: dict[str, bool] = {}
        self._recorded: set[str] = set()

    def set(self, path: str, visible: bool, time: float | None = None) -> None:
        """Shows or hides the object at a path. A recording stores the change at `time` [s]."""
        before = self._visible.get(path)
        if before == visible:
            return
        self._visible[path] = visible
        if time is not None and path not in self._recorded:
            # An animation uses its first value also for earlier times.
            self._recorded.add(path)
            self._meshcat.SetProperty(path, "visible", before is not False, 0.0)
        self._meshcat.SetProperty(path, "visible", visible, time)

    def end_recording(self, time: float) -> None:
        """Stores the last state of all recorded objects at the end of a recording [s].

        Otherwise the track of each object ends at its last change, and each track repeats alone.
        """
        for path in self._recorded:
            self._meshcat.SetProperty(path, "visible", self._visible[path], time)
