"""Interactive view of one arm in Meshcat, with sliders and buttons."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, Role

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import holding_torque, set_arm_positions
from dvrk_drake.systems.arm_view.drawn_arm import DrawnArm
from dvrk_drake.systems.arm_view.efforts import DrawnForce
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import corners_at, framing, geometry_corners, home_position

#: Buttons of the view, and sliders that are 0 (off) or 1 (on), so that they show their state.
WHOLE_ARM, HOME, RANDOM = "whole arm", "home pose", "random pose"
FRAMES, EFFORTS, DEGREES = "frames", "gravity efforts", "degrees, mm"
#: Length of the axes of the frames, as a multiple of the size of the arm.
_AXIS = 0.07
#: Size of arcs and frames on the screen in a close-up, as a multiple of their size in the view of the whole arm.
_CLOSE_UP = 3.0


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


class ArmView:
    """Draws an arm with its overlay at poses of its independent joints, and optionally adds controls.

    The positions of the dependent joints follow from the linkage. Drake's JointSliders would move every joint of the
    tree independently and open the parallelogram.

    Attributes:
        arm: Arm that is drawn.
        meshcat: Meshcat in which the arm is drawn.
        overlay: Overlay of the arm.
    """

    def __init__(self, arm: Arm, meshcat: Meshcat, role: Role = Role.kIllustration) -> None:
        """Draws an arm in the first pose of a view, see `home_position`.

        Args:
            arm: Arm to draw.
            meshcat: Meshcat in which the arm is drawn.
            role: Role of the drawn geometry: visual (kIllustration) or collision (kProximity).

        Raises:
            ArmError: The arm has no geometry with this role.
        """
        self.arm, self.meshcat = arm, meshcat
        self._path = arm.name.lower()
        self._links = DrawnArm(arm, meshcat, f"{self._path}/links", role=role)
        self.overlay = ArmOverlay(arm, meshcat)
        self._frames: DrawnArm | None = None
        self._q = home_position(arm)
        self._sliders: JointSliders | None = None
        self._clicks: dict[str, int] = {}
        self._switches: dict[str, float] = {}
        self._generator = np.random.default_rng()
        self._scale = 1.0
        self.show(self._q)

    @property
    def camera_presets(self) -> tuple[str, ...]:
        """Names of camera positions for `look_at`: the whole arm, and the close-ups of the arm's file."""
        return (WHOLE_ARM, *self.arm.view.close_ups)

    def show(
        self,
        q: ArrayLike,
        *,
        effort: ArrayLike | None = None,
        desired: ArrayLike | None = None,
        force: DrawnForce | None = None,
    ) -> None:
        """Draws the pose q (n,) [rad, m], which may be outside the limits.

        Args:
            q: Pose (n,) [rad, m].
            effort: Efforts (n,) [N m, N] for the arcs. None: they are not changed.
            desired: Pose (n,) [rad, m] of the ghost. None: no ghost.
            force: External force. None: no arrow.
        """
        self._q = np.array(q, dtype=float)
        for drawn in filter(None, (self._links, self._frames)):
            drawn.draw(self._q)
        self.overlay.draw(self._q, effort=effort, desired=desired, force=force)

    def look_at(self, preset: str) -> None:
        """Moves the camera to one of `camera_presets`. A close-up shows its links at the pose that was drawn last."""
        position, target = framing(geometry_corners(self.arm))
        whole_distance = np.linalg.norm(position - target)
        if (links := self.arm.view.close_ups.get(preset)) is not None:
            position, target = framing(corners_at(self.arm, self._q, tuple(links)))
        # In a close-up, arcs and frames would otherwise be larger than the links.
        self._scale = min(1.0, _CLOSE_UP * float(np.linalg.norm(position - target) / whole_distance))
        self.overlay.resize(self._scale)
        if self._frames is not None:
            self.show_frames(True)
        self.meshcat.SetCameraPose(position, target)

    def show_frames(self, visible: bool) -> None:
        """Shows or hides the frames of the DH convention (x red, y green, z blue); see `main_frames`."""
        path = f"{self._path}/frames"
        self.meshcat.Delete(path)
        self._frames = None
        if visible:
            length = _AXIS * self._scale * float(np.ptp(geometry_corners(self.arm), axis=0).max())
            self._frames = DrawnArm(self.arm, self.meshcat, path, axis_length=length)
            self._frames.draw(self._q)

    def add_view_buttons(self) -> None:
        """Adds buttons for the camera positions, and a switch for the frames."""
        self._add_buttons(*self.camera_presets)
        self._add_switches(FRAMES)

    def add_sliders(self) -> None:
        """Adds buttons for poses, switches for units and gravity efforts, and one slider per independent joint."""
        self._add_buttons(HOME, RANDOM)
        self._add_switches(EFFORTS, DEGREES)
        self._sliders = JointSliders(self.arm, self.meshcat, self._q)

    def follow_controls(self) -> NDArray[np.float64]:
        """Applies clicked buttons and moved sliders. Returns the drawn pose (n,) [rad, m]."""
        for button in self._clicks:
            clicks = self.meshcat.GetButtonClicks(button)
            if clicks != self._clicks[button]:
                self._clicks[button] = clicks
                self._press(button)
        for switch in self._switches:
            value = self.meshcat.GetSliderValue(switch)
            if value != self._switches[switch]:
                self._switches[switch] = value
                self._turn(switch, bool(value))
        if self._sliders is not None:
            q = self._sliders.positions()
            if not np.array_equal(q, self._q):
                self.overlay.set_state(self._sliders.stopped_by or self._describe(int(np.abs(q - self._q).argmax())))
                self.show(q, effort=self._gravity_effort(q))
        return self._q

    def _add_buttons(self, *names: str) -> None:
        for name in names:
            self.meshcat.AddButton(name)
            self._clicks[name] = 0

    def _add_switches(self, *names: str) -> None:
        for name in names:
            self._switches[name] = self.meshcat.AddSlider(name, 0.0, 1.0, 1.0, 0.0)

    def _press(self, button: str) -> None:
        if button in self.camera_presets:
            self.look_at(button)
        elif self._sliders is not None:
            self.overlay.clear_trace()
            q = home_position(self.arm)
            if button == RANDOM:
                (q,) = self.arm.sample_poses(1, self._generator, margin=0.02)
            self._sliders.set_positions(q)

    def _turn(self, switch: str, on: bool) -> None:
        if switch == FRAMES:
            self.show_frames(on)
        elif switch == DEGREES and self._sliders is not None:
            self._sliders.set_degrees(on)
        elif switch == EFFORTS:
            self.overlay.show_efforts(on)
            self.show(self._q, effort=self._gravity_effort(self._q))

    def _describe(self, joint: int) -> str:
        """Returns name and range of a joint, for the control panel."""
        unit = "m" if self.arm.prismatic[joint] else "rad"
        lower, upper = self.arm.position_lower[joint], self.arm.position_upper[joint]
        return f"{self.arm.joint_names[joint]}: {lower:.3g} to {upper:.3g} {unit}"

    def _gravity_effort(self, q: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Returns the efforts (n,) [N m, N] that hold the arm, or None if they are not shown."""
        if not self._switches.get(EFFORTS):
            return None
        set_arm_positions(self._links.plant, self._links.context, self.arm, q)
        return holding_torque(self._links.plant, self._links.context, self.arm)
