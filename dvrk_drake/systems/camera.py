"""Where a camera stands to see an arm: computed from the arm's own geometry."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Role
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, set_arm_positions

#: From what the camera looks at toward the camera (base frame), and the magnification of Meshcat's 75 degree view.
DIRECTION, ZOOM = (1.1, 1.0, 0.3), 2.8
#: Half the height of that view at distance 1, and its width over its height in a common browser window.
HALF_HEIGHT, ASPECT = np.tan(np.radians(75 / 2)) / ZOOM, 1.2
#: How far each joint goes toward its limits in the poses that the view holds (all of it would show the arm small), and
#: how much wider than these poses the view is.
SHARE, MARGIN = 0.75, 1.05


def framing(arm: Arm) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (3,) [m, base frame] of a camera and of what it looks at, such that the arm fills the view.

    The arm at home and with each joint in turn at SHARE of its way to either limit, so that moving it does not
    leave the view at once.

    Raises:
        ArmError: the arm has no visual geometry.
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
    """Corners (n, 3) [m, base frame] of the boxes around the visual geometry at the poses that the view holds.

    Raises:
        ArmError: the arm has no visual geometry.
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
        raise ArmError(f"{arm.name} has no visual geometry yet")
    return np.concatenate(corners)
