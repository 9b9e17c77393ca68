"""Interactive view of one arm in Meshcat, with sliders and buttons."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import Context, DiagramBuilder

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, holding_torque, set_arm_positions
from dvrk_drake.systems.arm_view.camera import home_position
from dvrk_drake.systems.arm_view.controls import JointSliders
from dvrk_drake.systems.arm_view.overlay import ArmOverlay

#: Buttons of the view, besides those of the camera positions.
FRAMES, NAMES, EFFORTS = "frames", "joint names", "gravity efforts"
HOME, RANDOM, DEGREES = "home pose", "random pose", "degrees / radians"
#: Upper edge of the caption of a coupled limit, see `Camera.point`.
LIMIT_EDGE = 0.74


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
        """Draws an arm at its home pose: all joints at zero, or at the limit nearest to zero.

        Args:
            arm: Arm to draw.
            meshcat: Meshcat in which the arm is drawn.
            role: Role of the drawn geometry: visual (kIllustration) or collision (kProximity).

        Raises:
            ArmError: The arm has no geometry with this role.
        """
        self.arm, self.meshcat = arm, meshcat
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
        add_arm(self._plant, arm)
        self._plant.Finalize()
        if scene_graph.model_inspector().NumGeometriesWithRole(role) == 0:
            raise ArmError(f"{arm.name} has no {'visual' if role == Role.kIllustration else 'collision'} geometry")
        parameters = MeshcatVisualizerParams(role=role, prefix=f"{arm.name.lower()}/links")
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self.overlay = ArmOverlay(arm, meshcat)
        self.overlay.set_title(arm.name)
        self._q = home_position(arm)
        self._sliders: JointSliders | None = None
        self._clicks: dict[str, int] = {}
        self._shown = {FRAMES: False, NAMES: False, EFFORTS: False}
        self._generator = np.random.default_rng()
        self.show(self._q)

    def show(self, q: ArrayLike, *, effort: ArrayLike | None = None, desired: ArrayLike | None = None) -> None:
        """Draws the pose q (n,) [rad, m], which may be outside the limits.

        Args:
            q: Pose (n,) [rad, m].
            effort: Efforts (n,) [N m, N] for the arcs. None: they are not changed.
            desired: Pose (n,) [rad, m] of the ghost. None: no ghost.
        """
        self._q = np.array(q, dtype=float)
        set_arm_positions(self._plant, self._plant_context(), self.arm, self._q)
        self._diagram.ForcedPublish(self._context)
        self.overlay.draw(self._q, effort=effort, desired=desired)

    def add_view_buttons(self) -> None:
        """Adds buttons for the camera positions, and for frames and joint names."""
        self._add_buttons(*self.overlay.camera_presets, FRAMES, NAMES)

    def add_sliders(self) -> None:
        """Adds buttons for poses, units and gravity efforts, and one slider per independent joint."""
        self._add_buttons(EFFORTS, HOME, RANDOM, DEGREES)
        self._sliders = JointSliders(self.arm, self.meshcat, self._q)

    def follow_controls(self) -> NDArray[np.float64]:
        """Applies clicked buttons and moved sliders. Returns the drawn pose (n,) [rad, m]."""
        for button in self._clicks:
            clicks = self.meshcat.GetButtonClicks(button)
            if clicks != self._clicks[button]:
                self._clicks[button] = clicks
                self._press(button)
        if self._sliders is not None:
            q = self._sliders.positions()
            self.overlay.captions.set_text("limit", self._sliders.stopped_by, v=LIMIT_EDGE)
            if not np.array_equal(q, self._q):
                self.show(q, effort=self._gravity_effort(q))
        self.overlay.follow_camera()
        return self._q

    def _add_buttons(self, *names: str) -> None:
        for name in names:
            self.meshcat.AddButton(name)
            self._clicks[name] = 0

    def _press(self, button: str) -> None:
        if button in self._shown:
            self._shown[button] = not self._shown[button]
        if button in self.overlay.camera_presets:
            self.overlay.look_at(button)
        elif button == FRAMES:
            self.overlay.show_frames(self._shown[FRAMES])
        elif button == NAMES:
            self.overlay.show_names(self._shown[NAMES])
        elif self._sliders is not None:
            if button == EFFORTS:
                self.overlay.show_efforts(self._shown[EFFORTS])
                self.show(self._q, effort=self._gravity_effort(self._q))
            elif button == DEGREES:
                self._sliders.set_degrees(not self._sliders.degrees)
            else:
                self.overlay.clear_trace()
                q = home_position(self.arm)
                if button == RANDOM:
                    (q,) = self.arm.sample_poses(1, self._generator, margin=0.02)
                self._sliders.set_positions(q)

    def _gravity_effort(self, q: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Returns the efforts (n,) [N m, N] that hold the arm, or None if they are not shown."""
        if not self._shown[EFFORTS]:
            return None
        set_arm_positions(self._plant, self._plant_context(), self.arm, q)
        return holding_torque(self._plant, self._plant_context(), self.arm)

    def _plant_context(self) -> Context:
        return self._plant.GetMyMutableContextFromRoot(self._context)
