"""Arms that Drake's MeshcatVisualizer draws at given poses, without a simulation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import MemoryFile
from pydrake.geometry import (
    InMemoryMesh,
    MakePhongIllustrationProperties,
    Mesh,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
    SceneGraph,
    Shape,
)
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.visualization import AddFrameTriadIllustration

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, main_frames, set_arm_positions

#: Colour of a ghost at the commanded pose: that of commanded values in plots.
COMMANDED = Rgba(0.47, 0.016, 0.467, 0.5)
#: A ghost is slightly larger than the arm, so that its surfaces are outside those of the arm.
ENLARGEMENT = 1.01
#: Distance [m] and angle [rad] between a link of the ghost and of the arm, below which the link is not drawn.
SAME_POSITION, SAME_ANGLE = 1e-3, 0.01
#: Ratio of the radius of the axes of a frame to their length.
_AXIS_RADIUS = 0.04


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


class DrawnArm:
    """Arm below one path of Meshcat.

    Attributes:
        plant: Plant of the arm.
    """

    def __init__(
        self,
        arm: Arm,
        meshcat: Meshcat,
        path: str,
        *,
        role: Role = Role.kIllustration,
        color: Rgba | None = None,
        axis_length: float = 0.0,
    ) -> None:
        """Adds the arm. `draw` makes it visible.

        Args:
            arm: Arm to draw.
            meshcat: Meshcat in which the arm is drawn.
            path: Path of the arm, e.g. "mtml/links". The links are at `link_path`.
            role: Role of the drawn geometry: visual (kIllustration) or collision (kProximity).
            color: Colour of all links. None: the colours of the model file.
            axis_length: Length of the axes of the frames of `main_frames` [m], which are drawn instead of the links.
                0: the links are drawn.

        Raises:
            ArmError: The arm has no geometry with this role.
        """
        self.arm, self._path = arm, path
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
        add_arm(self.plant, arm, collision_shapes=role == Role.kProximity)
        self.plant.Finalize()
        if axis_length > 0:
            _replace_links_by_frames(self.plant, scene_graph, arm, axis_length)
        elif scene_graph.model_inspector().NumGeometriesWithRole(role) == 0:
            raise ArmError(f"{arm.name} has no {'visual' if role == Role.kIllustration else 'collision'} geometry")
        if color is not None:
            _paint(self.plant, scene_graph, color)
        inspector = scene_graph.model_inspector()
        frames = {inspector.GetFrameId(geometry) for geometry in inspector.GetAllGeometryIds(role)}
        self.drawn_bodies = [body for body in map(self.plant.GetBodyFromFrameId, frames) if body is not None]
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, MeshcatVisualizerParams(role=role, prefix=path))
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()

    @property
    def context(self) -> Context:
        """Context of the plant, at the pose that was drawn last."""
        return self.plant.GetMyMutableContextFromRoot(self._context)

    def link_path(self, link: str) -> str:
        """Returns the path of a link in Meshcat."""
        instance = self.plant.GetBodyByName(link).model_instance()
        return f"{self._path}/{self.plant.GetModelInstanceName(instance)}/{link}"

    def draw(self, q: ArrayLike, time: float | None = None) -> None:
        """Draws the pose q (n,) [rad, m], which may be outside the limits. A recording stores it at `time` [s]."""
        set_arm_positions(self.plant, self.context, self.arm, q)
        self._context.SetTime(time or 0.0)
        self._diagram.ForcedPublish(self._context)


class GhostArm(DrawnArm):
    """Translucent copy of an arm in one colour, e.g. at the commanded pose."""

    def __init__(self, arm: Arm, meshcat: Meshcat, path: str, color: Rgba, visibility: Visibility) -> None:
        """Adds the hidden ghost; `draw_beside` shows it."""
        super().__init__(arm, meshcat, path, color=color)
        self._visibility, self._arm_context = visibility, self.plant.CreateDefaultContext()
        visibility.set(path, False)

    def draw_beside(self, q: ArrayLike | None, q_arm: ArrayLike, time: float | None = None) -> None:
        """Draws the ghost at the pose q (n,) [rad, m], or hides it if q is None.

        Links at the same place as in the pose q_arm (n,) of the arm are not drawn. A recording stores all at `time`.
        """
        self.draw(q_arm if q is None else q, time)
        self._visibility.set(self._path, q is not None, time)
        set_arm_positions(self.plant, self._arm_context, self.arm, q_arm)
        for body in self.drawn_bodies:
            X_WL, X_WA = (self.plant.EvalBodyPoseInWorld(c, body) for c in (self.context, self._arm_context))
            X_AL = X_WA.InvertAndCompose(X_WL)
            apart = np.linalg.norm(X_AL.translation()) > SAME_POSITION
            turned = abs(X_AL.rotation().ToAngleAxis().angle()) > SAME_ANGLE
            self._visibility.set(self.link_path(body.name()), bool(apart or turned), time)


def _replace_links_by_frames(plant: MultibodyPlant, scene_graph: SceneGraph, arm: Arm, length: float) -> None:
    for geometry in scene_graph.model_inspector().GetAllGeometryIds(Role.kIllustration):
        scene_graph.RemoveRole(plant.get_source_id(), geometry, Role.kIllustration)
    for name in main_frames(arm):
        AddFrameTriadIllustration(
            scene_graph=scene_graph,
            frame=plant.GetFrameByName(name),
            name=name,
            length=length,
            radius=_AXIS_RADIUS * length,
            opacity=1.0,
        )


def _paint(plant: MultibodyPlant, scene_graph: SceneGraph, color: Rgba) -> None:
    source, inspector = plant.get_source_id(), scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        scene_graph.ChangeShape(source, geometry, _in_one_color(inspector.GetShape(geometry), color))
        properties = MakePhongIllustrationProperties([color.r(), color.g(), color.b(), color.a()])
        scene_graph.RemoveRole(source, geometry, Role.kIllustration)
        scene_graph.AssignRole(source, geometry, properties)


def _in_one_color(shape: Shape, color: Rgba) -> Shape:
    """Returns the shape. If it is a glTF file, its materials are replaced, because Meshcat would use their colours."""
    if not isinstance(shape, Mesh) or shape.extension() != ".gltf" or not shape.source().is_path():
        return shape
    file = Path(shape.source().path())
    gltf = json.loads(file.read_text())
    material = {
        "pbrMetallicRoughness": {
            # The colours of a glTF file are linear.
            "baseColorFactor": [color.r() ** 2.2, color.g() ** 2.2, color.b() ** 2.2, color.a()],
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "alphaMode": "BLEND",
    }
    gltf["materials"] = [material] * max(1, len(gltf.get("materials", [])))
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(json.dumps(gltf), ".gltf", file.name)), ENLARGEMENT * shape.scale3())
