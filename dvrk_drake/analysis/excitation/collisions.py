"""Detects collisions of the links of an arm with each other and with a table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, set_arm_positions


class CollisionDetector:
    """Detects collisions at poses of one arm.

    Pairs of links that touch in every arm are ignored, as stated by the collision filters of the SDF.
    """

    def __init__(self, arm: Arm, table: float | None = None) -> None:
        """Constructs the detector.

        Args:
            arm: Arm with collision shapes.
            table: Height of a table in the base frame [m], or None.
        """
        self._arm = arm
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        add_arm(self._plant, arm)
        if table is not None:
            shape = HalfSpace()
            self._plant.RegisterCollisionGeometry(
                self._plant.world_body(), RigidTransform([0.0, 0.0, table]), shape, "table", CoulombFriction()
            )
        self._plant.Finalize()
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._query_port, self._inspector = scene_graph.get_query_output_port(), scene_graph.model_inspector()
        self._graph_context = scene_graph.GetMyMutableContextFromRoot(self._context)
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)

    def tip(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the position (3,) of the tip in the base frame at a pose (n,) [m].

        Raises:
            ExcitationError: The arm file does not name the frame of the tip.
        """
        if not self._arm.view.tip:
            raise ExcitationError(f"{self._arm.name}: the arm file does not name a frame of the tip (view.tip)")
        set_arm_positions(self._plant, self._plant_context, self._arm, pose)
        frame = self._plant.GetFrameByName(self._arm.view.tip)
        return np.asarray(frame.CalcPoseInWorld(self._plant_context).translation())

    def collision(self, pose: NDArray[np.float64]) -> str:
        """Returns the description of the first collision at a pose (n,), or "" if there is none."""
        plant, inspector = self._plant, self._inspector
        set_arm_positions(plant, self._plant_context, self._arm, pose)
        for pair in self._query_port.Eval(self._graph_context).ComputePointPairPenetration():
            ids = pair.id_A, pair.id_B
            bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)) for geometry in ids]
            # The base is mounted at the table.
            fixed = {plant.world_body().name(), "base_link"}
            if {body.name() for body in bodies} <= fixed:
                continue
            names = ["the table" if body.index() == plant.world_body().index() else body.name() for body in bodies]
            return f"collision of {' and '.join(sorted(names, key=lambda name: name == 'the table'))}"
        return ""


def first_collision(arm: Arm, q: NDArray[np.float64], table: float | None = None) -> tuple[int, str] | None:
    """Returns the index of the first pose with a collision and its description, or None.

    Args:
        arm: Arm with collision shapes.
        q: Poses (m, n) [rad, m].
        table: Height of a table in the base frame [m], or None.
    """
    detector = CollisionDetector(arm, table)
    return next(((i, what) for i, pose in enumerate(q) if (what := detector.collision(pose))), None)
