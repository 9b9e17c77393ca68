"""Converts a robot model that Drake's parser reads (URDF, SDF, MJCF, model directives) to the SDF of an arm."""

from __future__ import annotations

import logging
import math
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Capsule, SceneGraph, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import LoadModelDirectives, PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RevoluteJoint, RotationalInertia, SpatialInertia, UnitInertia

from dvrk_drake.errors import ArmError
from dvrk_drake.models.plant_tree import Mimic, PlantTree
from dvrk_drake.models.sdf_elements import DRAKE, add_pose, read_xml, shape_element

#: Endings of the names of model files.
MODEL_SUFFIXES = (".urdf", ".sdf", ".xml", ".mjcf", ".dmd.yaml", ".dmd.yml")
#: Position limits of a joint that can turn without end [rad]. Most drives of such joints count two turns at most.
CONTINUOUS = 2 * math.pi
#: Mass of a massless link between two moving joints, as a share of the mean mass of the links. Such a link only
#: connects the axes of a joint with two degrees of freedom. Its mass must be positive, and small for the other links.
_CONNECTOR_MASS = 1e-3
#: Smallest radius of gyration of a link, as a share of the largest distance between two neighbouring joints. A smaller
#: one (in some files 0) would fix the inertia in an identification, since priors are relative to it.
_MIN_GYRATION = 0.02
#: Radius of the shapes of a model without shapes, as a share of the largest distance between two neighbouring joints.
_STICK = 0.05


def convert_model(path: Path) -> ElementTree.Element:
    """Returns the root element `<sdf>` of the arm in a model file.

    The links are those of `PlantTree`. Joints, mimic joints, limits, rotors, frames and shapes are those of the file.
    Shapes are omitted if a mesh is missing. Without shapes, sticks show the links.

    Raises:
        ArmError: Drake cannot read the file, or the model is not an arm: it has a floating body, a joint with several
            degrees of freedom, a closed loop, no moving joint, no masses, or two joints with one name.
    """
    try:
        return _Model.of(path).to_sdf()
    except ArmError as error:
        raise error if str(error).startswith(str(path)) else ArmError(f"{path}: {error}") from error


class _DrakeLog(logging.Handler):
    """Context in which the messages of Drake's parser are collected instead of being printed."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[str] = []
        self._logger = logging.getLogger("drake")

    def emit(self, record: logging.LogRecord) -> None:
        """Collects a message."""
        self.messages.append(record.getMessage())

    def __enter__(self) -> _DrakeLog:
        self._handlers, self._propagate = self._logger.handlers, self._logger.propagate
        self._logger.handlers, self._logger.propagate = [self], False
        return self

    def __exit__(self, *_: object) -> None:
        self._logger.handlers, self._logger.propagate = self._handlers, self._propagate


@dataclass(eq=False)
class _Model:
    """Model that Drake has read.

    Attributes:
        tree: Links of the model.
        documents: Root elements of the XML files of the model.
    """

    tree: PlantTree
    documents: list[ElementTree.Element]

    @classmethod
    def of(cls, path: Path) -> _Model:
        """Reads a model file, without its shapes if a mesh is missing."""
        if path.suffix.lower() not in (".yaml", ".yml"):
            read_xml(path)
        try:
            with _DrakeLog() as log:
                try:
                    model = cls._read(path, with_shapes=True)
                except (RuntimeError, ValueError):
                    log.messages.clear()
                    model = cls._read(path, with_shapes=False)
        except (RuntimeError, ValueError) as error:
            raise ArmError(f"Drake cannot read this model: {' '.join(str(error).split())[:300]}") from error
        if places := sorted({message.split(": warning: ")[0] for message in log.messages if "inertia" in message}):
            warnings.warn(
                f"{', '.join(places)}: the inertia is not physically consistent; a sphere of the same mass is assumed",
                UserWarning,
                stacklevel=2,
            )
        return model

    @classmethod
    def _read(cls, path: Path, with_shapes: bool) -> _Model:
        plant, scene_graph = MultibodyPlant(1e-3), SceneGraph() if with_shapes else None
        if scene_graph is not None:
            plant.RegisterAsSourceForSceneGraph(scene_graph)
        parser = Parser(plant)
        add_packages(parser.package_map(), path.parent)
        parser.AddModels(str(path))
        documents = [read_xml(file) for file in _files(path, parser)]
        _weld_base(plant)
        plant.Finalize()
        return cls(PlantTree(plant, scene_graph), documents)

    def to_sdf(self) -> ElementTree.Element:
        """Returns the root element of the SDF."""
        names = [link.joint.name() for link in self.tree.moving]
        if not names:
            raise ArmError("the model has no moving joint")
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            raise ArmError(f"several joints have the name {repeated[0]}")
        mimics = self._mimics()
        if self.tree.plant.num_constraints() > len(mimics):
            raise ArmError("the model has a closed loop; allowed: loops whose dependent joints are mimic joints")
        for link in self.tree.moving:
            lower, upper = float(link.joint.position_lower_limits()[0]), float(link.joint.position_upper_limits()[0])
            if not lower < upper:
                raise ArmError(
                    f"joint {link.joint.name()}: the position limits are {lower:g}, {upper:g}; allowed: lower < upper"
                )
            if isinstance(link.joint, RevoluteJoint) and math.isinf(lower) and math.isinf(upper):
                link.joint.set_position_limits([-CONTINUOUS], [CONTINUOUS])
        root = self.tree.to_sdf(self._inertias(), mimics, self._effort_limits())
        if root.find("model/link/visual") is None:
            self._add_sticks(root)
        return root

    def _inertias(self) -> list[SpatialInertia]:
        """Returns the inertia of each moving link about its origin, with `_MIN_GYRATION`."""
        found = self.tree.inertias(dict.fromkeys(self._massless, SpatialInertia.Zero()))
        sizes = [0.0]
        for link in self.tree.moving:
            sizes += [float(np.linalg.norm(X_LB.translation())) for X_LB in link.members.values()]
            sizes.append(float(np.linalg.norm(link.joint.frame_on_parent().GetFixedPoseInBodyFrame().translation())))
        masses = [M.get_mass() for M in found]
        if not max(masses) > 0:
            raise ArmError("no moving link has a mass; the model must state <inertial> or geometry with a density")
        least_gyration = _MIN_GYRATION * max(sizes)
        for i, mass in enumerate(masses):
            if not mass > 0:
                found[i] = SpatialInertia(_CONNECTOR_MASS * float(np.mean(masses)), np.zeros(3), UnitInertia(0, 0, 0))
            found[i] = _with_gyration(found[i], least_gyration)
        return found

    @cached_property
    def _massless(self) -> set[str]:
        """Links of URDF and SDF files without a mass. For some of them, Drake's parser assumes 1 kg.

        Raises:
            ArmError: A mass is negative or not a number.
        """
        found = set()
        for link in (link for document in self.documents for link in document.iter("link")):
            mass = link.find("inertial/mass")
            text = "0" if mass is None else mass.get("value", mass.text or "")
            try:
                is_valid = float(text) >= 0
            except ValueError:
                is_valid = False
            if not is_valid:
                raise ArmError(f"link {link.get('name')}: the mass is {text!r}; allowed: a number, not negative [kg]")
            if float(text) == 0:
                found.add(link.get("name", ""))
        return found

    def _mimics(self) -> dict[str, Mimic]:
        """Returns the leading joint, the multiplier and the offset of each dependent joint."""
        found = {}
        for document in self.documents:
            for joint in document.iter("joint"):
                for mimic in (joint.find("mimic"), joint.find(f"{DRAKE}mimic"), joint.find("axis/mimic")):
                    if mimic is not None:
                        multiplier = mimic.findtext("multiplier", mimic.get("multiplier", "1"))
                        offset = mimic.findtext("offset", mimic.get("offset", "0"))
                        found[joint.get("name", "")] = mimic.get("joint", ""), float(multiplier), float(offset)
            for equality in document.iterfind("equality/joint"):
                constant, linear, *higher = [*map(float, equality.get("polycoef", "0 1 0 0 0").split()), 0.0]
                second = equality.get("joint2")
                if second is not None and not any(higher):
                    found[equality.get("joint1", "")] = second, linear, constant
        return found

    def _effort_limits(self) -> dict[str, float]:
        """Returns the effort limits of the joints. A URDF states them also for joints without a motor."""
        limits = {
            joint.get("name", ""): float(limit.get("effort", "0"))
            for document in self.documents
            if document.tag == "robot"
            for joint in document.iter("joint")
            if (limit := joint.find("limit")) is not None
        }
        for index in self.tree.plant.GetJointActuatorIndices():
            actuator = self.tree.plant.get_joint_actuator(index)
            limits.setdefault(actuator.joint().name(), actuator.effort_limit())
        return {name: limit for name, limit in limits.items() if 0 < limit < math.inf}

    def _add_sticks(self, root: ElementTree.Element) -> None:
        """Adds visual shapes from the joint of each link to the next joints, to show a model without shapes."""
        ends: dict[str, list[NDArray[np.float64]]] = {link.name: [] for link in self.tree.links}
        for link in self.tree.moving:
            body = link.joint.parent_body().index()
            parent = next(other for other in self.tree.links if body in other.members)
            X_LF = parent.members[body] @ link.joint.frame_on_parent().GetFixedPoseInBodyFrame()
            ends[parent.name].append(X_LF.translation())
        for link in self.tree.moving:
            # The last link ends at its farthest part, e.g. the frame of a tool.
            parts = [X_LB.translation() for X_LB in link.members.values()]
            ends[link.name] = ends[link.name] or [max(parts, key=np.linalg.norm)]
        radius = _STICK * max(float(np.linalg.norm(p)) for points in ends.values() for p in points)
        for element in root.iterfind("model/link"):
            for p_LE in ends[element.get("name", "")]:
                length = float(np.linalg.norm(p_LE))
                visual = ElementTree.SubElement(element, "visual", name=f"stick_{len(element)}")
                if length > radius:
                    add_pose(visual, RigidTransform(RotationMatrix.MakeFromOneVector(p_LE, 2), p_LE / 2))
                shape = shape_element(Capsule(radius, length) if length > radius else Sphere(1.5 * radius))
                assert shape is not None
                ElementTree.SubElement(visual, "geometry").append(shape)


def add_packages(packages: PackageMap, folder: Path) -> None:
    """Adds the packages of ROS and those in a folder, and the folder and its parent, where most packages have models.

    Drake's own search is not used, because it would search all folders below, e.g. of a home folder.
    """
    packages.PopulateFromRosPackagePath()
    parents = folder, folder.parent
    for file in (*(parent / "package.xml" for parent in parents), *sorted(folder.glob("*/package.xml"))):
        if file.is_file():
            with suppress(RuntimeError):  # a package of that name is known already, or the file has no name
                packages.AddPackageXml(str(file))
    for parent in parents:
        if parent.name and not packages.Contains(parent.name):
            packages.Add(parent.name, str(parent))


def _files(path: Path, parser: Parser) -> Iterator[Path]:
    """Yields the XML files of a model file, which may be model directives."""
    if not path.name.lower().endswith((".yaml", ".yml")):
        yield path
        return
    for directive in LoadModelDirectives(str(path)).directives:
        added = directive.add_model or directive.add_directives
        if added is not None:
            yield from _files(Path(parser.package_map().ResolveUrl(added.file)), parser)


def _weld_base(plant: MultibodyPlant) -> None:
    """Welds the only body that no joint moves to the world, if nothing is attached to the world.

    Raises:
        ArmError: Several bodies are not connected by joints.
    """
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    moved = {joint.child_body().index() for joint in joints}
    bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
    roots = [body for body in bodies if body.index() not in moved]
    if len(roots) > 1 or (roots and any(joint.parent_body() is plant.world_body() for joint in joints)):
        names = ", ".join(sorted(body.name() for body in roots)[:5])
        raise ArmError(f"no joint connects {names} to the rest; allowed: one tree of links, without a floating base")
    for root in roots:
        plant.WeldFrames(plant.world_frame(), root.body_frame())


def _with_gyration(M_LLo_L: SpatialInertia, least: float) -> SpatialInertia:
    """Returns the inertia, with a sphere added to its moments if a radius of gyration [m] is less than `least`."""
    m, p_LoLcm_L = M_LLo_L.get_mass(), M_LLo_L.get_com()
    I_LLcm_L = M_LLo_L.Shift(p_LoLcm_L).CalcRotationalInertia().CopyToFullMatrix3()
    moments = np.linalg.eigvalsh(I_LLcm_L)
    # The second moments along the principal axes, of which those of a flat or thin body are 0.
    if moments.sum() / 2 - moments.max() >= m * least**2:
        return M_LLo_L
    I_LLcm_L += 2 * m * least**2 * np.eye(3)
    central = RotationalInertia(*np.diag(I_LLcm_L), I_LLcm_L[0, 1], I_LLcm_L[0, 2], I_LLcm_L[1, 2])
    return SpatialInertia.MakeFromCentralInertia(m, p_LoLcm_L, central)
