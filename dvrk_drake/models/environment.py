"""Fixed objects around an arm, e.g. a table or another arm, with which it must not collide."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import HalfSpace, Role
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.errors import DvrkDrakeError, ExcitationError
from dvrk_drake.models.files import read_text_input
from dvrk_drake.models.plant import package_map
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.models.typed_yaml import parse_yaml

#: Accepted directives. `add_directives` would read a second file, which a motion file does not contain.
_DIRECTIVES = "add_model", "add_weld", "add_frame"


@dataclass(frozen=True)
class Environment:
    """Fixed objects around an arm. The world frame is the base frame of the arm.

    Attributes:
        table: Height of a table [m], which is the half-space below this height, or None.
        directives: Drake model directives of other objects, i.e. the text of a .dmd.yaml file, or "". Each object is
            welded to the world, and its joints remain at `default_joint_positions`. Models are named by URL, e.g.
            package://dvrk_drake/sdf/mtmr.sdf.

    Raises:
        ExcitationError: The directives are not valid, an object is not welded to the world, a joint is outside its
            limits, or there is no collision shape.

    Example:
        >>> import dvrk_drake as dvrk
        >>> limits = dvrk.MotionLimits(environment=dvrk.Environment(table=-0.2))
    """

    table: float | None = field(default=None, metadata=within(-10.0, 10.0, "m"))
    directives: str = ""

    def __post_init__(self) -> None:
        if fault := number_fault(self):
            raise ExcitationError(f"environment: {fault}")
        if not isinstance(self.directives, str):
            raise ExcitationError("environment: directives must be the text of a file; Environment.load reads a file")
        if self.directives:
            self._check_directives()

    @classmethod
    def load(cls, path: str | Path, table: float | None = None) -> Environment:
        """Reads Drake model directives from a .dmd.yaml file.

        Args:
            path: File with the directives.
            table: Height of a table in the base frame [m], or None.

        Raises:
            ExcitationError: The file cannot be read, is empty, or its directives are not valid.
        """
        text = read_text_input(path, ExcitationError)
        if not text.strip():
            raise ExcitationError(f"{path}: the file is empty")
        try:
            return cls(table, text)
        except ExcitationError as error:
            raise ExcitationError(f"{path}: {error}") from error

    def add_to(self, plant: MultibodyPlant) -> None:
        """Adds the objects to a plant that is not finalized and has a scene graph.

        Raises:
            ExcitationError: Drake cannot load the directives.
        """
        if self.table is not None:
            plant.RegisterCollisionGeometry(
                plant.world_body(), RigidTransform([0.0, 0.0, self.table]), HalfSpace(), "table", CoulombFriction()
            )
        if self.directives:
            add_directives(plant, self.directives, package_map(), "environment", ExcitationError)

    def _check_directives(self) -> None:
        plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
        self.add_to(plant)
        plant.Finalize()
        if floating := plant.GetFloatingBaseBodies():
            name = plant.get_body(min(floating)).scoped_name().get_full()
            raise ExcitationError(f"environment: {name} is not welded to the world; use add_weld")
        for index in plant.GetJointIndices():
            joint = plant.get_joint(index)
            q, lower, upper = joint.default_positions(), joint.position_lower_limits(), joint.position_upper_limits()
            if np.any((q < lower) | (q > upper)):
                raise ExcitationError(
                    f"environment: joint {joint.name()} is at {q[0]:g}; allowed: {lower[0]:g}..{upper[0]:g}"
                )
        inspector = scene_graph.model_inspector()
        shapes = [inspector.GetShape(i) for i in inspector.GetAllGeometryIds(Role.kProximity)]
        if sum(isinstance(shape, HalfSpace) for shape in shapes) > (self.table is not None):
            raise ExcitationError("environment: a plane is not supported; use a box, or --table")
        if len(shapes) == (self.table is not None):
            raise ExcitationError("environment: no object in the directives has a collision shape")


def add_directives(
    plant: MultibodyPlant, directives: str, packages: PackageMap, where: str, error: type[DvrkDrakeError]
) -> None:
    """Adds the objects in Drake model directives to a plant that is not finalized.

    Args:
        plant: Plant, with or without a scene graph.
        directives: Text of a .dmd.yaml file.
        packages: Packages of the URLs in the directives.
        where: Source of the text, for messages.
        error: Type of error to raise.

    Raises:
        DvrkDrakeError: The directives are not valid, or Drake cannot load them. The exception has the type `error`.
    """
    # Drake ends the process for some wrong directives and shapes, so these are found before Drake reads them.
    if fault := _fault(parse_yaml(directives, where, error), packages):
        raise error(f"{where}: {fault}")
    parser = Parser(plant)
    parser.package_map().AddMap(packages)
    try:
        parser.AddModelsFromString(directives, "dmd.yaml")
    except RuntimeError as cause:
        raise error(f"{where}: Drake cannot load the directives: {str(cause).splitlines()[0][:300]}") from cause


def _fault(content: Any, packages: PackageMap) -> str:
    """Returns why the parsed content of directives is not valid, or ""."""
    if not isinstance(content, dict) or set(content) != {"directives"} or not isinstance(content["directives"], list):
        return "the file must have the key directives with a list"
    for number, entry in enumerate(content["directives"], 1):
        (name, values) = next(iter(entry.items())) if isinstance(entry, dict) and len(entry) == 1 else ("", None)
        if name not in _DIRECTIVES or not isinstance(values, dict):
            return f"directive {number} is not valid; allowed: {', '.join(_DIRECTIVES)}"
        url = str(values.get("file", "file:///"))
        scheme, _, rest = url.partition("://")
        if scheme not in ("package", "file") or (scheme == "file" and not rest.startswith("/")):
            return f'directive {number}: file is "{url}"; allowed: package://dvrk_drake/... or file:///...'
        if scheme == "package" and not packages.Contains(package := rest.partition("/")[0]):
            known = ", ".join(sorted(packages.GetPackageNames()))[:200]  # ROS may have hundreds of packages
            return f'directive {number}: unknown package "{package}"; allowed: {known}, or an absolute file:/// URL'
        if fault := number_fault(values):
            return f"directive {number}: {fault.removeprefix('.')}"
    return ""
