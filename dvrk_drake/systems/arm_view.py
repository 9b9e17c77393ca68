"""Display of an arm in Meshcat at poses of its independent joints, with a suitable camera position."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, MeshcatParams, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ArmError, DvrkDrakeError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, set_arm_positions

#: Direction from the target to the camera in the base frame. Magnification relative to Meshcat's default view angle of
#: 75 degrees.
DIRECTION, ZOOM = (1.1, 1.0, 0.3), 2.8
#: Half the height of the view at distance 1 from the camera. Aspect ratio (width / height) of a common browser window.
HALF_HEIGHT, ASPECT = np.tan(np.radians(75 / 2)) / ZOOM, 1.2
#: Displacement of a joint from home in the poses that must be inside the view, as a fraction of the distance from home
#: to the joint limit. With a fraction of 1, the arm would appear small. Ratio of the size of the view to the size that
#: these poses require.
SHARE, MARGIN = 0.75, 1.05


def framing(arm: Arm) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns positions (3,) [m] of a camera and of its target in the base frame, so that the arm fills the view.

    The view contains the arm at home. It also contains the poses in which one joint is displaced towards one of its
    limits, by the fraction `SHARE` of the distance to this limit.

    Raises:
        ArmError: The arm has no visual geometry.
    """
    p_WC = geometry_corners(arm)
    target = (p_WC.min(axis=0) + p_WC.max(axis=0)) / 2
    back = np.array(DIRECTION) / np.linalg.norm(DIRECTION)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    from_target = p_WC - target
    off_axis = np.abs(from_target @ np.column_stack([right / ASPECT, np.cross(back, right)])).max(axis=1)
    return target + np.max(from_target @ back + MARGIN * off_axis / HALF_HEIGHT) * back, target


def geometry_corners(arm: Arm) -> NDArray[np.float64]:
    """Returns the corners (k, 3) of boxes around the visual geometry in the base frame [m].

    The corners are those at all poses that the view must show.

    Raises:
        ArmError: The arm has no visual geometry.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    add_arm(plant, arm)
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query_port, inspector = scene_graph.get_query_output_port(), scene_graph.model_inspector()
    home = np.clip(np.zeros(arm.num_joints), arm.position_lower, arm.position_upper)
    steps = [SHARE * np.diag(limit - home) for limit in (arm.position_lower, arm.position_upper)]
    corners = []
    for q in home + np.vstack([np.zeros_like(home), *steps]):
        set_arm_positions(plant, plant.GetMyMutableContextFromRoot(context), arm, q)
        query = query_port.Eval(scene_graph.GetMyContextFromRoot(context))
        for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
            box = inspector.GetObbInGeometryFrame(geometry)
            X_WB = query.GetPoseInWorld(geometry) @ box.pose()
            corners.append([X_WB @ (box.half_width() * sign) for sign in product((-1.0, 1.0), repeat=3)])
    if not corners:
        raise ArmError(f"{arm.name} has no visual geometry")
    return np.concatenate(corners)


def start_meshcat(
    arm: Arm | None = None,
    *,
    camera: ArrayLike = (2.0, 2.0, 1.0),
    target: ArrayLike = (0.0, 0.0, 0.0),
    zoom: float = ZOOM,
    port: int | None = None,
) -> Meshcat:
    """Starts Meshcat, Drake's 3D view in a browser, on localhost with a light background.

    Args:
        arm: Arm that fills the view. The caller draws it, e.g. with `ArmStation(arm, meshcat=meshcat)`. None: `camera`
            and `target` define the view.
        camera: Position (3,) [m] of the camera, for a view without an arm.
        target: Position (3,) [m] of the camera's target, for a view without an arm.
        zoom: Magnification relative to Meshcat's default view angle of 75 degrees.
        port: Port in 1024..65535. None: a free port is used.

    Raises:
        DvrkDrakeError: The port cannot be opened.
        ArmError: The arm has no visual geometry.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.load_arm("psm")
        >>> meshcat = dvrk.start_meshcat(arm)
        >>> station = dvrk.ArmStation(arm, meshcat=meshcat)  # drawn when it is simulated
        >>> meshcat.web_url().startswith("http://localhost:")
        True
    """
    if arm is not None:
        camera, target = framing(arm)
    if port is not None and not 1024 <= port <= 65535:
        raise DvrkDrakeError(f"port {port} cannot be opened; allowed: 1024..65535")
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost", port=port, show_stats_plot=False))
    except RuntimeError as error:
        raise DvrkDrakeError(
            "no free port can be opened" if port is None else f"port {port} cannot be opened. Choose another port"
        ) from error
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.86, 0.89, 0.92])
    meshcat.SetProperty("/Background", "bottom_color", [0.97, 0.97, 0.97])
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "zoom", zoom)
    meshcat.SetCameraPose(np.asarray(camera, float), np.asarray(target, float))
    return meshcat


class ArmView:
    """Draws an arm at poses of its independent joints, and optionally adds one slider per independent joint.

    The positions of the dependent joints follow from the linkage. Drake's JointSliders would move every joint of the
    tree independently and open the parallelogram.
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
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, MeshcatVisualizerParams(role=role))
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._q = np.clip(np.zeros(arm.num_joints), arm.position_lower, arm.position_upper)
        self._slider_names: list[str] = []
        self._stopped_by = ""
        self.show(self._q)

    def show(self, q: ArrayLike) -> None:
        """Draws the pose q (n,) [rad, m], which may be outside the limits."""
        self._q = np.array(q, dtype=float)
        set_arm_positions(self._plant, self._plant.GetMyMutableContextFromRoot(self._context), self.arm, self._q)
        self._diagram.ForcedPublish(self._context)

    def add_sliders(self) -> None:
        """Adds one slider per independent joint, from its lower to its upper limit."""
        self._slider_names = [f"q{i + 1} {name}" for i, name in enumerate(self.arm.joint_names)]
        for i, name in enumerate(self._slider_names):
            lower, upper = self.arm.position_lower[i], self.arm.position_upper[i]
            self.meshcat.AddSlider(name, lower, upper, (upper - lower) / 1000, self._q[i])

    def follow_sliders(self) -> NDArray[np.float64]:
        """Draws the pose of the sliders if a slider was moved. Returns the drawn pose (n,) [rad, m].

        Sliders of joints with a coupled limit stop at this limit. While a slider is stopped, a button without a
        function shows the name of the limit.
        """
        requested = np.array([self.meshcat.GetSliderValue(name) for name in self._slider_names])
        if np.array_equal(requested, self._q):
            return self._q
        q, stopped_by = self._inside_coupled_limits(requested)
        for name, value, target in zip(self._slider_names, requested, q, strict=True):
            if value != target:
                self.meshcat.SetSliderValue(name, target)
        if stopped_by != self._stopped_by:
            if self._stopped_by:
                self.meshcat.DeleteButton(self._stopped_by)
            if stopped_by:
                self.meshcat.AddButton(stopped_by)
            self._stopped_by = stopped_by
        self.show([self.meshcat.GetSliderValue(name) for name in self._slider_names])
        return self._q

    def _inside_coupled_limits(self, requested: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
        """Returns the pose inside the coupled limits, and a description of the limits that stopped the sliders.

        A slider moves in steps, so the drawn pose may exceed a limit slightly. In that case, the sliders cannot move
        further beyond the limit.
        """
        A, lower, upper = self.arm.limit_matrix()
        n, q, stops = self.arm.num_joints, requested.copy(), []
        for a, least, most, limit in zip(A[n:], lower[n:], upper[n:], self.arm.coupled_limits, strict=True):
            start, end = a @ self._q, a @ q
            allowed = np.clip(end, min(least, start), max(most, start))
            if end != allowed:
                stopped = a != 0
                q[stopped] = (self._q + (allowed - start) / (end - start) * (q - self._q))[stopped]
                stops.append(f"stopped by the limit {limit.name}: {least:.4g} to {most:.4g}")
        return q, "; ".join(stops)
