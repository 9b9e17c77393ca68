"""Controls of a view in Meshcat's control panel: sliders for the joints, and texts."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat

from dvrk_drake.models.arm import Arm


class PanelText:
    """Row of the control panel with a text that changes.

    It is a button without effect, because the panel has no texts. Meshcat adds it below the existing rows.
    """

    def __init__(self, meshcat: Meshcat) -> None:
        """Starts without a text."""
        self._meshcat, self._text = meshcat, ""

    def show(self, text: str) -> None:
        """Replaces the text. "" removes the row."""
        if text == self._text:
            return
        if self._text:
            self._meshcat.DeleteButton(self._text, strict=False)
        if text:
            self._meshcat.AddButton(text)
        self._text = text


class JointSliders:
    """One slider per independent joint, from its lower to its upper limit.

    The unit follows the number of the joint, because Meshcat cuts labels after 14 characters.

    Attributes:
        names: Names of the sliders: number, unit and name of each joint.
        degrees: Whether revolute joints have degrees, and prismatic joints mm. Otherwise, the units are rad and m.
        stopped_by: Description of the coupled limits that stopped the sliders, or "".
    """

    def __init__(self, arm: Arm, meshcat: Meshcat, q: ArrayLike) -> None:
        """Adds the sliders at the pose q (n,) [rad, m]."""
        self._arm, self._meshcat = arm, meshcat
        self._q = np.array(q, float)
        self.names: list[str] = []
        self.degrees = False
        self.stopped_by = ""
        self._add()

    def _add(self) -> None:
        self._unit = self._arm.per_joint(np.radians(1.0), 1e-3) if self.degrees else np.ones(self._arm.num_joints)
        units = ("deg", "mm") if self.degrees else ("rad", "m")
        joints = enumerate(zip(self._arm.joint_names, self._arm.prismatic, strict=True), 1)
        self.names = [f"q{i} [{units[int(slides)]}] {name}" for i, (name, slides) in joints]
        lower, upper = self._arm.position_lower / self._unit, self._arm.position_upper / self._unit
        step = 0.1 if self.degrees else 0.001  # Meshcat shows five characters of the value
        for i, name in enumerate(self.names):
            self._meshcat.AddSlider(name, lower[i], upper[i], step, self._q[i] / self._unit[i])

    def set_degrees(self, degrees: bool) -> None:
        """Replaces the sliders by sliders in the other units."""
        for name in self.names:
            self._meshcat.DeleteSlider(name)
        self.degrees = degrees
        self._add()

    def set_positions(self, q: ArrayLike) -> None:
        """Moves the sliders to the pose q (n,) [rad, m]."""
        self._q = np.array(q, float)
        for name, value in zip(self.names, self._q / self._unit, strict=True):
            self._meshcat.SetSliderValue(name, value)

    def positions(self) -> NDArray[np.float64]:
        """Returns the pose (n,) [rad, m] of the sliders.

        Sliders of joints with a coupled limit stop at this limit.
        """
        requested = self._read()
        if np.array_equal(requested, self._q):
            return self._q
        q, self.stopped_by = self._inside_coupled_limits(requested)
        for name, value, target in zip(self.names, requested / self._unit, q / self._unit, strict=True):
            if value != target:
                self._meshcat.SetSliderValue(name, target)
        self._q = self._read()
        return self._q

    def _read(self) -> NDArray[np.float64]:
        return np.array([self._meshcat.GetSliderValue(name) for name in self.names]) * self._unit

    def _inside_coupled_limits(self, requested: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
        """Returns the pose inside the coupled limits, and a description of the limits that stopped the sliders.

        A slider moves in steps, so the pose may exceed a limit slightly. In that case, the sliders cannot move further
        beyond the limit.
        """
        A, lower, upper = self._arm.limit_matrix()
        n, q, stops = self._arm.num_joints, requested.copy(), []
        for a, least, most, limit in zip(A[n:], lower[n:], upper[n:], self._arm.coupled_limits, strict=True):
            start, end = a @ self._q, a @ q
            allowed = np.clip(end, min(least, start), max(most, start))
            if end != allowed:
                stopped = a != 0
                q[stopped] = (self._q + (allowed - start) / (end - start) * (q - self._q))[stopped]
                stops.append(f"stop: {limit.name} {least:.4g} to {most:.4g} rad")
        return q, "; ".join(stops)
