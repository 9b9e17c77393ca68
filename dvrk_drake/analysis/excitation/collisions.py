"""Detects collisions of an arm with fixed objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.plant import add_arm, base_body, set_arm_positions


class CollisionDetector:
    """Detects collisions at poses of one arm.

    Pairs of links are checked, except those that the collision filters of the SDF exclude. In the arms of this package,
    all pairs are excluded.
    """

    def __init__(self, arm: Arm, environment: Environment = Environment()) -> None:
        """Constructs the detector.

        Args:
            arm: Arm with collision shapes.
            environment: Fixed objects around the arm.
        """
        self._arm = arm
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        self._instance = add_arm(self._plant, arm)
        environment.add_to(self._plant)
        self._plant.Finalize()
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._query_port, self._inspector = scene_graph.get_query_output_port(), scene_graph.model_inspector()
        self._graph_context = scene_graph.GetMyMutableContextFromRoot(self._context)
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)

    def tip(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the position (3,) of the tip, the frame `Arm.frames.hand`, in the base frame at a pose (n,) [m]."""
        set_arm_positions(self._plant, self._plant_context, self._arm, pose, self._instance)
        frame = self._plant.GetFrameByName(self._arm.frames.hand, self._instance)
        return np.asarray(frame.CalcPoseInWorld(self._plant_context).translation())

    def collision(self, pose: NDArray[np.float64]) -> str:
        """Returns the description of the first collision at a pose (n,), or "" if there is none."""
        plant, inspector, base = self._plant, self._inspector, base_body(self._plant, self._instance)
        set_arm_positions(plant, self._plant_context, self._arm, pose, self._instance)
        for pair in self._query_port.Eval(self._graph_context).ComputePointPairPenetration():
            ids = pair.id_A, pair.id_B
            bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)) for geometry in ids]
            bodies.sort(key=lambda body: (body.model_instance() != self._instance, body.name()))
            # The base is mounted at the table or at another object, and objects may touch each other.
            if all(body.model_instance() != self._instance or body is base for body in bodies):
                continue
            return f"collision of {' and '.join(map(self._name, bodies))}"
        return ""

    def _name(self, body: RigidBody) -> str:
        if body.model_instance() == self._instance:
            return str(body.name())
        return "the table" if body.index() == self._plant.world_body().index() else str(body.scoped_name().get_full())


def first_collision(
    arm: Arm, q: NDArray[np.float64], environment: Environment = Environment()
) -> tuple[int, str] | None:
    """Returns the index of the first pose with a collision and its description, or None.

    Args:
        arm: Arm with collision shapes.
        q: Poses (m, n) [rad, m].
        environment: Fixed objects around the arm.
    """
    detector = CollisionDetector(arm, environment)
    return next(((i, what) for i, pose in enumerate(q) if (what := detector.collision(pose))), None)
