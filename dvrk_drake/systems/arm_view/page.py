"""Meshcat page: start of the server, background, ground, camera positions, and the page as an HTML file."""

from __future__ import annotations

import gc
import html
import json
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Box, Meshcat, MeshcatParams, Rgba, Role
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ArmError, DvrkDrakeError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, set_arm_positions
from dvrk_drake.systems.arm_view.efforts import share_color

#: Share of its range by which a prismatic joint is extended in the first pose of a view: 0.1 m for the insertion of a
#: PSM.
EXTENSION = 5 / 12
#: Direction from the target to the camera in the base frame. Magnification relative to Meshcat's default view angle of
#: 75 degrees.
DIRECTION, ZOOM = (1.1, 1.0, 0.3), 2.8
#: Half the height of the view at distance 1 from the camera. Aspect ratio (width / height) of a common browser window.
#: Aspect ratio of the 3D view of a report, which is beside plots.
HALF_HEIGHT, ASPECT, REPORT_ASPECT = np.tan(np.radians(75 / 2)) / ZOOM, 1.2, 0.8
#: Displacement of a joint from home in the poses that must be inside the view, as a fraction of the distance from home
#: to the joint limit. With a fraction of 1, the arm would appear small. Ratio of the size of the view to the size that
#: these poses require.
SHARE, MARGIN = 0.75, 1.05
#: Smallest width of a close-up [m].
_LEAST_WIDTH = 0.02
#: Colours of the background. Light castings and dark motors of an arm stand out from both.
TOP, BOTTOM = [0.36, 0.45, 0.55], [0.62, 0.69, 0.75]
GROUND, LINES = Rgba(0.56, 0.63, 0.69), Rgba(0.45, 0.52, 0.58)
#: Distance of the grid lines, half the width of the ground, and distance of the ground below the lowest point [m].
GRID, HALF_WIDTH, CLEARANCE = 0.1, 1.5, 0.03
#: Views that remain until others replace them. Drake searches a free port among 1000.
MAX_VIEWS = 100
#: Newest views. Drake ends the process if another thread than the creating one destroys a Meshcat. Without these
#: references, Python's garbage collection could do so in any thread.
_VIEWS: list[Meshcat] = []


def start_meshcat(
    arm: Arm | None = None,
    *,
    poses: ArrayLike | None = None,
    points: ArrayLike | None = None,
    camera: ArrayLike = (2.0, 2.0, 1.0),
    target: ArrayLike = (0.0, 0.0, 0.0),
    zoom: float = ZOOM,
    port: int | None = None,
) -> Meshcat:
    """Starts Meshcat, Drake's 3D view in a browser, on localhost with a ground and a camera position.

    Args:
        arm: Arm that fills the view. The caller draws it, e.g. with `ArmStation(arm, meshcat=meshcat)`. None: `camera`
            and `target` define the view, and there is no ground.
        poses: Poses (m, n) [rad, m] of the arm that a report shows. None: any poses of the arm.
        points: Points (k, 3) in the base frame [m] that are visible beside the arm at `poses`.
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
        corners = geometry_corners(arm) if poses is None else corners_at(arm, poses)
        if points is not None:
            corners = np.vstack([corners, points])
        camera, target = framing(corners, ASPECT if poses is None else REPORT_ASPECT)
    if port is not None and not 1024 <= port <= 65535:
        raise DvrkDrakeError(f"port {port} cannot be opened; allowed: 1024..65535")
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost", port=port, show_stats_plot=False))
    except RuntimeError as error:
        raise DvrkDrakeError(
            "no free port can be opened" if port is None else f"port {port} cannot be opened. Choose another port"
        ) from error
    _VIEWS.append(meshcat)
    if len(_VIEWS) > MAX_VIEWS:
        gc.collect()  # destroys Diagrams that still use an old view
        del _VIEWS[0]
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background/<object>", "top_color", TOP)
    meshcat.SetProperty("/Background/<object>", "bottom_color", BOTTOM)
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "zoom", zoom)
    meshcat.SetCameraPose(np.asarray(camera, float), np.asarray(target, float))
    if arm is not None:
        add_ground(meshcat, corners, arm.gravity)
    return meshcat


def add_ground(meshcat: Meshcat, p_WC: NDArray[np.float64], gravity: ArrayLike = (0.0, 0.0, -9.81)) -> None:
    """Draws the ground with a grid of 10 cm below the points p_WC (k, 3) [m], perpendicular to gravity (3,) [m/s^2]."""
    down = np.array(gravity, float)  # a copy, because the array belongs to the arm
    if np.linalg.norm(down) < 1e-9:
        return
    down /= np.linalg.norm(down)
    center = p_WC.mean(axis=0)
    center += (np.max((p_WC - center) @ down) + CLEARANCE) * down
    X_WG = RigidTransform(RotationMatrix.MakeFromOneVector(-down, 2), center)
    meshcat.SetObject("ground", Box(2 * HALF_WIDTH, 2 * HALF_WIDTH, 0.01), GROUND)
    meshcat.SetTransform("ground", X_WG @ RigidTransform([0.0, 0.0, -0.006]))
    steps = np.arange(-HALF_WIDTH, HALF_WIDTH + GRID / 2, GRID)
    edge, zero = np.full_like(steps, HALF_WIDTH), np.zeros_like(steps)
    start = np.hstack([[steps, -edge, zero], [-edge, steps, zero]])
    end = np.hstack([[steps, edge, zero], [edge, steps, zero]])
    meshcat.SetLineSegments("grid", np.asfortranarray(start), np.asfortranarray(end), 1.0, LINES)
    meshcat.SetTransform("grid", X_WG)


def page_html(
    meshcat: Meshcat,
    title: str,
    *,
    phases: Sequence[tuple[float, str]] = (),
    colors: Mapping[str, str] | None = None,
    effort_scale: bool = False,
) -> str:
    """Returns the page with its recorded animation as one HTML document.

    The title of a page that Meshcat serves cannot be changed: it is fixed in Drake's HTML document.

    Args:
        meshcat: Meshcat with the scene.
        title: Title of the page.
        phases: Start times [s] and names of the phases of the animation. The page shows the current one.
        colors: CSS colours and their meanings, e.g. {"green": "model of the SDF"}.
        effort_scale: Whether the page explains the colours of the efforts.
    """
    gradient = ", ".join(f"rgb({', '.join(f'{255 * c:.0f}' for c in share_color(share))})" for share in (0.0, 0.5, 1.0))
    legend = "".join(
        f'<div><i style="background: {color}"></i>{html.escape(text)}</div>' for color, text in (colors or {}).items()
    )
    if effort_scale:
        legend += (
            f'<div>effort 0 <i class="scale" style="background: linear-gradient(90deg, {gradient})"></i>limit</div>'
        )
    captions = _CAPTIONS.replace("LEGEND", legend).replace("PHASES", json.dumps(list(phases)))
    page = str(meshcat.StaticHtml()).replace("<title>Drake MeshCat</title>", f"<title>{html.escape(title)}</title>", 1)
    return page.replace("</body>", captions + "</body>", 1) if phases or legend else page


#: Texts in the lower left corner of a page, which change with the time of the animation. The controls are above.
_CAPTIONS = """
<style>
  #captions { position: fixed; left: 0; bottom: 0; max-width: calc(100% - 16px); padding: 6px 12px; color: #141a21;
              background: rgba(255, 255, 255, 0.85); font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; }
  #captions i { display: inline-block; width: 12px; height: 12px; margin-right: 8px; border: 1px solid #141a21; }
  #captions i.scale { width: 90px; margin: 0 6px 0 2px; }
</style>
<div id="captions"><b id="phase"></b>LEGEND</div>
<script>
  const phases = PHASES;
  (function showPhase() {
    const time = Math.max(0, ...viewer.animator.actions.map((action) => action.time));
    const started = phases.filter(([start]) => start <= time + 1e-6);
    document.getElementById("phase").textContent = started.length ? started.at(-1)[1] : "";
    if (phases.length) requestAnimationFrame(showPhase);
  })();
</script>
"""


def framing(p_WC: NDArray[np.float64], aspect: float = ASPECT) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns positions (3,) [m] of a camera and of its target in the base frame, so that points fill the view.

    Args:
        p_WC: Points (k, 3) in the base frame [m], see `geometry_corners` and `corners_at`.
        aspect: Width / height of the view.
    """
    target = (p_WC.min(axis=0) + p_WC.max(axis=0)) / 2
    back = np.array(DIRECTION) / np.linalg.norm(DIRECTION)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    from_target = p_WC - target
    off_axis = np.abs(from_target @ np.column_stack([right / aspect, np.cross(back, right)])).max(axis=1)
    off_axis = np.maximum(off_axis, _LEAST_WIDTH / 2)
    return target + np.max(from_target @ back + MARGIN * off_axis / HALF_HEIGHT) * back, target


def home_position(arm: Arm) -> NDArray[np.float64]:
    """Returns the first pose (n,) of a view [rad, m].

    Revolute joints are at zero, or at the limit nearest to zero. Prismatic joints are extended by `EXTENSION`, because
    a retracted instrument is hidden.
    """
    zero = np.clip(np.zeros(arm.num_joints), arm.position_lower, arm.position_upper)
    extended = arm.position_lower + EXTENSION * (arm.position_upper - arm.position_lower)
    return np.where(arm.prismatic, extended, zero)


@cache
def geometry_corners(arm: Arm) -> NDArray[np.float64]:
    """Returns the corners (k, 3) of boxes around the visual geometry in the base frame [m].

    The poses are home, and those in which one joint is displaced towards one of its limits, by the fraction `SHARE` of
    the distance to this limit.

    Raises:
        ArmError: The arm has no visual geometry.
    """
    home = home_position(arm)
    steps = [SHARE * np.diag(limit - home) for limit in (arm.position_lower, arm.position_upper)]
    return corners_at(arm, home + np.vstack([np.zeros_like(home), *steps]))


def corners_at(arm: Arm, poses: ArrayLike, links: tuple[str, ...] = ()) -> NDArray[np.float64]:
    """Returns the corners (k, 3) of boxes around visual geometry in the base frame [m], at given poses.

    Args:
        arm: Arm.
        poses: Poses (m, n) of the joints [rad, m].
        links: Names of the links. Empty: all links.

    Raises:
        ArmError: The arm or the links have no visual geometry.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    add_arm(plant, arm)
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query_port, inspector = scene_graph.get_query_output_port(), scene_graph.model_inspector()
    corners, signs = [], np.array(list(product((-1.0, 1.0), repeat=3)))
    for q in np.atleast_2d(np.asarray(poses, float)):
        set_arm_positions(plant, plant.GetMyMutableContextFromRoot(context), arm, q)
        query = query_port.Eval(scene_graph.GetMyContextFromRoot(context))
        for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
            if links and (body is None or body.name() not in links):
                continue
            box = inspector.GetObbInGeometryFrame(geometry)
            X_WB = query.GetPoseInWorld(geometry) @ box.pose()
            corners.append((X_WB @ (box.half_width() * signs).T).T)
    if not corners:
        raise ArmError(f"{arm.name} has no visual geometry" + (f" of {', '.join(links)}" if links else ""))
    return np.concatenate(corners)
