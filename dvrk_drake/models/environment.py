"""Fixed objects around an arm, e.g. a table or another arm, with which it must not collide."""

from __future__ import annotations

from dataclasses import dataclass, field

from pydrake.geometry import HalfSpace, Role
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import ExcitationError
from dvrk_drake.models.plant import package_map
from dvrk_drake.models.schema_fault import number_fault, within


@dataclass(frozen=True)
class Environment:
    """Fixed objects around an arm. The world frame is the base frame of the arm.

    Attributes:
        table: Height of a table [m], which is the half-space below this height, or None.
        directives: Drake model directives of other objects, i.e. the text of a .dmd.yaml file, or "". Each object is
            welded to the world, and its joints remain at `default_joint_positions`. Models are named by URL, e.g.
            package://dvrk_drake/sdf/mtmr.sdf.

    Raises:
        ExcitationError: Drake cannot load the directives, an object is not welded to the world, or no object has a
            collision shape.

    Example:
        >>> import dvrk_drake as dvrk
        >>> limits = dvrk.MotionLimits(environment=dvrk.Environment(table=-0.2))
    """

    table: float | None = field(default=None, metadata=within(-10.0, 10.0, "m"))
    directives: str = ""

    def __post_init__(self) -> None:
        if fault := number_fault(self):
            raise ExcitationError(f"environment: {fault}")
        if not self.directives:
            return
        plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
        try:
            self.add_to(plant)
            plant.Finalize()
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise ExcitationError(f"environment: Drake cannot load the directives: {reason}") from error
        if floating := sorted(
            plant.get_body(index).scoped_name().get_full() for index in plant.GetFloatingBaseBodies()
        ):
            raise ExcitationError(f"environment: {', '.join(floating)} is not welded to the world; use add_weld")
        if not scene_graph.model_inspector().NumGeometriesWithRole(Role.kProximity):
            raise ExcitationError("environment: no object in the directives has a collision shape")

    def add_to(self, plant: MultibodyPlant) -> None:
        """Adds the objects to a plant that is not finalized and has a scene graph."""
        if self.table is not None:
            plant.RegisterCollisionGeometry(
                plant.world_body(), RigidTransform([0.0, 0.0, self.table]), HalfSpace(), "table", CoulombFriction()
            )
        if self.directives:
            parser = Parser(plant)
            parser.package_map().AddMap(package_map())
            parser.AddModelsFromString(self.directives, "dmd.yaml")
