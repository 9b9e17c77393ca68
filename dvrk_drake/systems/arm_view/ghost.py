"""Ghost arm: a translucent copy of an arm in one colour, e.g. at the commanded pose."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Rgba, Role, SceneGraph, Shape
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, set_arm_positions
from dvrk_drake.systems.arm_view.scene import Scene

#: Colour of a ghost.
ORANGE = Rgba(0.93, 0.42, 0.05, 0.5)
#: A ghost is slightly larger than the arm, so that its surfaces are outside those of the arm.
ENLARGEMENT = 1.01
#: Distance [m] and angle [rad] between a link of the ghost and of the arm, below which the link is not drawn.
SAME_POSITION, SAME_ANGLE = 1e-3, 0.01


class GhostArm:
    """Translucent copy of an arm below one path of a scene."""

    def __init__(self, arm: Arm, scene: Scene, name: str, color: Rgba = ORANGE) -> None:
        """Adds the hidden ghost `name` to a scene. `draw` shows it."""
        self._arm, self._scene, self._name = arm, scene, name
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
        add_arm(self._plant, arm, collision_shapes=False)
        self._plant.Finalize()
        self._context, self._arm_context = self._plant.CreateDefaultContext(), self._plant.CreateDefaultContext()
        self._bodies = _add_shapes(scene_graph, self._plant, scene, name, color)
        scene.set_visible(name, False)

    def draw(self, q: ArrayLike, q_arm: ArrayLike, time: float | None = None) -> None:
        """Shows the ghost at the pose q (n,) [rad, m]. A recording stores the pose at `time` [s].

        Links at the same place as in the pose q_arm (n,) of the arm are not drawn.
        """
        set_arm_positions(self._plant, self._context, self._arm, q)
        set_arm_positions(self._plant, self._arm_context, self._arm, q_arm)
        for body in self._bodies:
            path = f"{self._name}/{body.name()}"
            X_BL, X_BA = (self._plant.EvalBodyPoseInWorld(c, body) for c in (self._context, self._arm_context))
            X_AL = X_BA.InvertAndCompose(X_BL)
            apart = np.linalg.norm(X_AL.translation()) > SAME_POSITION
            turned = abs(X_AL.rotation().ToAngleAxis().angle()) > SAME_ANGLE
            self._scene.set_visible(path, bool(apart or turned), time)
            self._scene.set_transform(path, X_BL, time)
        self._scene.set_visible(self._name, True, time)

    def hide(self, time: float | None = None) -> None:
        """Hides the ghost until `draw` is called."""
        self._scene.set_visible(self._name, False, time)


def _add_shapes(
    scene_graph: SceneGraph, plant: MultibodyPlant, scene: Scene, name: str, color: Rgba
) -> list[RigidBody]:
    """Adds all visual shapes and returns the bodies that have one."""
    inspector, bodies = scene_graph.model_inspector(), []
    for frame in inspector.GetAllFrameIds():
        body = plant.GetBodyFromFrameId(frame)
        shapes = inspector.GetGeometries(frame, Role.kIllustration) if body is not None else []
        for shape in shapes:
            path = f"{name}/{body.name()}/{shape.get_value()}"
            scene.meshcat.SetObject(scene.path(path), _in_one_color(inspector.GetShape(shape), color), color)
            scene.set_transform(path, inspector.GetPoseInFrame(shape))
        if shapes:
            bodies.append(body)
    return bodies


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
