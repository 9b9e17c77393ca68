"""Camera positions from which an arm, or some of its links, fill the view."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Role
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, set_arm_positions

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
