"""Where the mass of an arm's links can be: boxes around what the SDF draws, or those that the arm's files state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Role, SceneGraphInspector
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import BoundingShapes, BoxCorners
from dvrk_drake.models.plant import add_arm
from dvrk_drake.models.sdf_model import compose_sdf


@dataclass(frozen=True, eq=False)
class BoundingBox:
    """A box along the axes of the frame of link L: `lower` and `upper` (3,) are its corners, p_LoC_L [m]."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) [m]."""
        return (self.lower + self.upper) / 2

    @property
    def half_width(self) -> NDArray[np.float64]:
        """(3,) [m]."""
        return (self.upper - self.lower) / 2


def bounding_boxes(arm: Arm) -> dict[str, BoundingBox]:
    """Link -> its box, for every link of the arm, as the `bounding_shapes` of the arm's files say.

    Raises:
        ArmError: a link that can move has neither collision shapes nor a box of its own, or a box is none.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    instance = add_arm(plant, arm)
    plant.Finalize()
    shapes = _shapes_of_links(arm)
    boxes = {}
    for body in map(plant.get_body, plant.GetBodyIndices(instance)):
        if not plant.IsAnchored(body):
            name = body.name()
            stated = shapes[name].boxes.get(name)
            if stated is None:
                boxes[name] = _around_shapes(plant, scene_graph.model_inspector(), name, shapes[name].margin)
            else:
                boxes[name] = _stated(name, stated)
    return boxes


def _shapes_of_links(arm: Arm) -> dict[str, BoundingShapes]:
    """Link -> the settings that stand beside the SDF file that it is first named in."""
    settings: dict[str, BoundingShapes] = {}
    for url, shapes in zip(arm.sdf, arm.bounding_shapes, strict=True):
        names = [link.get("name", "") for link in compose_sdf([url]).iterfind("model/link")]
        if unknown := set(shapes.boxes) - set(names):
            raise ArmError(f"{arm.name}: bounding_shapes.boxes names {', '.join(sorted(unknown))}, no link of {url}")
        for name in names:
            settings.setdefault(name, shapes)
    return settings


def _around_shapes(plant: MultibodyPlant, inspector: SceneGraphInspector, link: str, margin: float) -> BoundingBox:
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName(link).index())
    for geometry in inspector.GetGeometries(frame, Role.kProximity):
        box = inspector.GetObbInGeometryFrame(geometry)
        X_LB = inspector.GetPoseInFrame(geometry) @ box.pose()
        half_width = np.abs(X_LB.rotation().matrix()) @ box.half_width()
        lower = np.minimum(lower, X_LB.translation() - half_width)
        upper = np.maximum(upper, X_LB.translation() + half_width)
    if not np.all(np.isfinite(lower)):
        raise ArmError(
            f"{link} has no <collision> in its SDF, so nothing says where its mass can be: give it a box in "
            "bounding_shapes of the arm's mechanism or instrument file"
        )
    return BoundingBox(lower - margin, upper + margin)


def _stated(link: str, corners: BoxCorners) -> BoundingBox:
    lower, upper = np.array(corners.lower, float), np.array(corners.upper, float)
    if lower.shape != (3,) or upper.shape != (3,) or not np.all(lower < upper) or not np.isfinite(upper - lower).all():
        raise ArmError(f"bounding_shapes: lower and upper of {link} must be three numbers each, lower below upper [m]")
    return BoundingBox(lower, upper)
