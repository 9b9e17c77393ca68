"""Instruments of the dVRK: reads their files, and makes the SDF and the description of an instrument.

The SDF has primitive shapes of the lengths in the DH table. Masses are those of the large needle driver, and that of
the shaft is proportional to its length. Nobody published a mass of an instrument: expect errors of a factor of 2.
"""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Cylinder, Shape
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import SpatialInertia, UnitInertia

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_schema import COUPLINGS, Frames, Instrument, ViewSettings
from dvrk_drake.models.files import read_json_input
from dvrk_drake.models.immutable import Shared
from dvrk_drake.models.ranges import within
from dvrk_drake.models.sdf_elements import (
    DRAKE,
    add_element,
    add_pose,
    inertial_element,
    numbers_text,
    read_xml,
    shape_element,
)
from dvrk_drake.models.typed_yaml import load_typed_yaml, typed_content

_TABLE = Path(__file__).with_name("dvrk_tools.yaml")
#: Folder of the instruments of this package, also of those in the table.
_FOLDER = Path(__file__).parent / "instruments"
#: Description whose effects, gains and margins all instruments share.
_NEEDLE_DRIVER = _FOLDER / "large_needle_driver.yaml"
_JOINTS = ["roll", "wrist_pitch", "wrist_yaw", "jaw"]
#: Pose of the tool frame in the last DH frame of most instruments, by rows.
_TOOL = [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0]]
#: Largest rounding error of an angle in the files [rad], e.g. 1.5708 for a quarter turn.
_ROUNDING = 1e-5
#: Model with the masses and sizes that all instruments share, and the name of its instrument in the table.
_NEEDLE_DRIVER_SDF, _NEEDLE_DRIVER_NAME = _FOLDER.parent / "sdf/large_needle_driver.sdf", "LARGE_NEEDLE_DRIVER_400006"
#: Mass of the drive disc of a snake-like wrist, which is a part of its cables [kg].
_DISC_MASS = 1e-4
#: Gear ratio of the motor of a disc. The model of the needle driver contains its quotients with the disc coupling.
_GEAR = 11.71
_QUARTER = np.pi / 2
#: Pose of the frame that carries an instrument in the base frame, without an arm: z points down along the shaft.
_DOWN = RigidTransform(RotationMatrix(np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])), np.zeros(3))


@dataclass
class DvrkTool(Shared):
    """Facts of one instrument.

    Attributes:
        shaft: Distance from the last frame of the arm to the wrist [m].
        wrist: Distance between successive axes of the wrist [m].
        limits: Largest absolute positions of roll, wrist pitch and wrist yaw [rad]. A snake-like wrist has two joints
            in series in each direction, and each of them has this limit.
        jaw: Position limits and largest effort of the jaw [rad, rad, N m].
        coupling: Matrix (4, 4) from the positions of the discs to those of roll, wrist pitch, wrist yaw and jaw.
        efforts: Largest efforts of roll, wrist pitch and wrist yaw [N m].
        roll_offset: Angle of the roll at position 0 [rad].
        tool: Pose (3, 4) of the tool frame in the last DH frame.
        snake: Whether the wrist is snake-like.
    """

    shaft: float = field(metadata=within(0.1, 1.0, "m"))
    wrist: float = field(metadata=within(0.0, 0.1, "m"))
    limits: list[float] = field(metadata=within(0.01, 12.6, "rad"))
    jaw: list[float] = field(metadata=within(-3.2, 3.2))
    coupling: list[list[float]] = field(metadata=COUPLINGS)
    efforts: list[float] = field(default_factory=lambda: [0.33, 0.25, 0.2], metadata=within(0.001, 10.0, "N m"))
    roll_offset: float = field(default=0.0, metadata=within(-6.3, 6.3, "rad"))
    tool: list[list[float]] = field(default_factory=lambda: _TOOL, metadata=within(-1.0, 1.0))
    snake: bool = False


@dataclass
class DvrkTools(Shared):
    """Schema of `dvrk_tools.yaml`. `couplings` are matrices that several instruments share."""

    format: str = "dvrk_drake tools 1.0"
    couplings: list[list[list[float]]] = field(default_factory=list, metadata=COUPLINGS)
    tools: dict[str, DvrkTool] = field(default_factory=dict)


@cache
def dvrk_tools() -> dict[str, DvrkTool]:
    """Returns the instruments of the dVRK by name."""
    return load_typed_yaml(DvrkTools, _TABLE, ArmError, "a table of instruments").tools


class _NeedleDriver(NamedTuple):
    """Facts of the large needle driver.

    Attributes:
        shaft: Length of the shaft [m].
        masses: Masses of the shaft, a wrist link and a finger [kg].
        radius: Radius of the shaft [m].
        finger: Width, thickness and length of a finger [m].
        housing: Size of the housing [m].
        housing_center: Centre of the housing relative to the last frame of the arm [m].
        velocities: Largest velocities of roll, wrist pitch, wrist yaw and jaw [rad/s].
        jaw_effort: Largest effort of the jaw [N m].
        rotor: Inertia of the motor of a disc [kg m^2].
    """

    shaft: float
    masses: list[float]
    radius: float
    finger: tuple[float, float, float]
    housing: NDArray[np.float64]
    housing_center: NDArray[np.float64]
    velocities: list[float]
    jaw_effort: float
    rotor: float


@cache
def _needle_driver() -> _NeedleDriver:
    model, shaft = read_xml(_NEEDLE_DRIVER_SDF), dvrk_tools()[_NEEDLE_DRIVER_NAME].shaft

    def numbers(path: str) -> NDArray[np.float64]:
        return np.array((model.findtext(f"model/{path}") or "").split(), dtype=np.float64)

    def number(path: str) -> float:
        return float(numbers(path)[0])

    blade = "link[@name='finger_1_link']/collision[@name='jaw']"
    width, thickness, length = numbers(f"{blade}/geometry/box/size")
    housing = "link[@name='insertion_link']/collision"
    # The shaft is between the last frame of the arm and the origin of the link of the roll.
    last = numbers("link[@name='roll_link']/pose")[:3] + np.array([0.0, 0.0, shaft])
    return _NeedleDriver(
        shaft=shaft,
        masses=[number(f"link[@name='{name}_link']/inertial/mass") for name in ("roll", "wrist_pitch", "finger_1")],
        radius=number("link[@name='roll_link']/collision/geometry/cylinder/radius"),
        # A finger begins at its joint, and its blade behind the hub.
        finger=(width, thickness, round(length / 2 - numbers(f"{blade}/pose")[2], 6)),
        housing=numbers(f"{housing}/geometry/box/size"),
        housing_center=np.round(numbers(f"{housing}/pose")[:3] - last, 6),
        velocities=[number(f"joint[@name='{name}']/axis/limit/velocity") for name in _JOINTS],
        jaw_effort=number("joint[@name='jaw']/axis/limit/effort"),
        rotor=number(f"joint[@name='jaw']/{DRAKE}rotor_inertia"),
    )


def read_tool(path: Path) -> DvrkTool:
    """Reads an instrument file of the dVRK (share/tool/*.json).

    Args:
        path: Path of the file. In the folder `instruments` of this package, the name of an instrument of the table.

    Raises:
        ArmError: The file is not an instrument file of the dVRK, or its wrist is not supported.
    """
    if path.parent == _FOLDER:
        return dvrk_tools()[path.stem]
    content = read_json_input(path, ArmError)
    try:
        rows, jaw = content["DH"]["joints"], content["jaw"]
        snake = content.get("snake-like", False)
        facts: dict[str, Any] = {
            "shaft": rows[0]["D"],
            "wrist": rows[2]["A"],
            "limits": [row["qmax"] for row in rows[:3]],
            "efforts": [row["ftmax"] for row in rows[:3]],
            "jaw": [jaw["qmin"], jaw["qmax"], jaw["ftmax"]],
            "coupling": content["coupling"]["ActuatorToJointPosition"],
            "roll_offset": rows[0]["theta"] + rows[0]["offset"],
            "tool": content["tooltip_offset"][:3],
            "snake": snake,
        }
        tool = typed_content(DvrkTool, facts, str(path), ArmError, "an instrument file of the dVRK")
        expected = [(0.0, 0.0, tool.shaft), (-_QUARTER, 0.0, 0.0), (-_QUARTER, tool.wrist, 0.0)]
        expected += [(0.0, tool.wrist, 0.0), (_QUARTER, tool.wrist, 0.0)] if snake else []
        same = content["DH"]["convention"] == "modified" and len(rows) == len(expected)
        for row, (alpha, a, d) in zip(rows, expected, strict=False):
            same &= abs(row["alpha"] - alpha) < _ROUNDING and (row["A"], row["D"]) == (a, d)
            same &= row["qmin"] == -row["qmax"] and row["type"] == "revolute"
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ArmError(f"{path}: is not an instrument file of the dVRK ({error!r})") from error
    if not same or np.shape(tool.coupling) != (4, 4) or np.shape(tool.tool) != (3, 4):
        raise ArmError(f"{path}: the wrist of this instrument is not supported; allowed: roll, wrist pitch, wrist yaw")
    return tool


def tool_instrument(path: Path, url: str) -> Instrument:
    """Returns the description of an instrument of the dVRK. Effects, gains and margins are those of a needle driver.

    Args:
        path: Argument of `read_tool`.
        url: Value of the key `sdf` of the description.
    """
    tool, base = read_tool(path), load_typed_yaml(Instrument, _NEEDLE_DRIVER, ArmError, "an instrument file")
    rows = {
        j: {k: x for k, x in zip(_JOINTS, row, strict=True) if x} for j, row in zip(_JOINTS, tool.coupling, strict=True)
    }
    upper = [x * (2 if tool.snake and i else 1) for i, x in enumerate(tool.limits)]
    limits = {name: [-x, x] for name, x in zip(_JOINTS, upper, strict=False)} | {"jaw": tool.jaw[:2]}
    links = [*[name for name, _ in _chain(tool)][1:], "finger_1", "finger_2"]
    return dataclasses.replace(
        base,
        sdf=url,
        joint_from_actuator=rows,
        position_limits=limits,
        frames=Frames(hand="tool", shaft="dh_4"),
        view=ViewSettings({"instrument": [f"{name}_link" for name in links]}),
    )


def _chain(tool: DvrkTool) -> list[tuple[str, RigidTransform]]:
    """Returns the joints of roll and wrist, with the pose of each DH frame in the previous one at position 0."""
    q, a = _QUARTER, tool.wrist
    rows = [("roll", 0.0, 0.0, _exact(tool.roll_offset), tool.shaft), ("wrist_pitch", -q, 0.0, -q, 0.0)]
    if tool.snake:
        rows = [rows[0], ("wrist_pitch_1", -q, 0.0, -q, 0.0), ("wrist_yaw_1", -q, a, 0.0, 0.0)]
        rows += [("wrist_yaw_2", 0.0, a, 0.0, 0.0), ("wrist_pitch_2", q, a, q, 0.0)]
    else:
        rows.append(("wrist_yaw", -q, a, -q, 0.0))
    return [(name, _craig(alpha, a, theta, d)) for name, alpha, a, theta, d in rows]


def _exact(angle: float) -> float:
    """Returns the exact angle for a rounded eighth of a turn."""
    exact = round(angle / (np.pi / 4)) * np.pi / 4
    return exact if abs(angle - exact) < _ROUNDING else angle


def _craig(alpha: float, a: float, theta: float, d: float) -> RigidTransform:
    R = _clean(RotationMatrix.MakeXRotation(alpha) @ RotationMatrix.MakeZRotation(theta))
    return RigidTransform(R, np.array([a, -d * np.sin(alpha), d * np.cos(alpha)]))


def _clean(R: RotationMatrix) -> RotationMatrix:
    """Returns a rotation whose elements near 0 and 1 are exact, so that symbolic models remain exact."""
    matrix, rounded = R.matrix(), np.round(R.matrix())
    return RotationMatrix(np.where(np.abs(matrix - rounded) < 1e-12, rounded, matrix))


def tool_sdf(path: Path, arm: ElementTree.Element | None) -> ElementTree.Element:
    """Returns the root element of the SDF of an instrument, in the base frame of its arm at the home pose.

    Args:
        path: Argument of `read_tool`.
        arm: Root element of the SDF of the arm, whose frame dh_3 carries the instrument. None: the frame is at the
            origin.

    Raises:
        ArmError: See `read_tool`; additionally if the arm has no frame dh_3.
    """
    tool, common, parent, X = read_tool(path), _needle_driver(), "insertion_link", _DOWN
    if arm is not None:
        frame = arm.find("model/frame[@name='dh_3']")
        if frame is None:
            raise ArmError(f"{path.stem}: the arm has no frame dh_3, which carries an instrument")
        parent = frame.get("attached_to", "")
        link = arm.find(f"model/link[@name='{parent}']")
        for part in (frame, link) if link is not None else (frame,):
            p = np.array((part.findtext("pose") or "0 0 0").split()[:3], dtype=np.float64)
            X = RigidTransform(X.rotation(), X.translation() + p)
    root = ElementTree.Element("sdf", version="1.9")
    writer = _Writer(ElementTree.SubElement(root, "model", name=path.stem.lower().replace("-", "_")))
    writer.housing(parent, X)
    # A file gives the jaw no effort if nothing moves (cautery). Each joint of an arm needs an effort limit, and the
    # fourth disc exists.
    efforts, limits = [*tool.efforts, tool.jaw[2] or common.jaw_effort], [*([-x, x] for x in tool.limits), tool.jaw[:2]]
    driven = {
        name: (
            limits[i],
            efforts[i],
            common.velocities[i],
            _GEAR / (abs(tool.coupling[i][i]) or np.abs(tool.coupling[i]).max()),
        )
        for i, name in enumerate(_JOINTS)
    }
    for number, (name, X_before) in enumerate(_chain(tool), 4):
        X = X @ X_before
        X = RigidTransform(_clean(X.rotation()), X.translation())
        shaft_mass, wrist_mass, _ = common.masses
        length = tool.shaft if name == "roll" else 2 * common.radius + tool.wrist
        mass = shaft_mass * tool.shaft / common.shaft if name == "roll" else wrist_mass
        if tool.snake and name != "roll":
            mass = 2 * wrist_mass / 4
            leader = name[:-2]
            if name.endswith("_1"):  # The position of the joint is the sum of two angles, which this disc shows.
                writer.add(
                    f"{leader}_disc", X, parent, _DISC_MASS, 2 * common.radius, leader, driven[leader], limit_factor=2
                )
            writer.add(name, X, parent, mass, length, name, mimic=(leader, 0.5))
        else:
            writer.add(name, X, parent, mass, length, name, driven[name])
        parent = f"{name}_link"
        writer.frame(f"dh_{number}", X.rotation(), parent)
    X_tool = np.array(tool.tool)
    X_T = X @ RigidTransform(_clean(RotationMatrix.ProjectToRotationMatrix(X_tool[:, :3])), X_tool[:, 3])
    writer.frame("tool", X_T.rotation(), parent, X_T.translation() - X.translation())
    # The jaw opens about the x axis of the tool frame, at the last joint of a standard wrist. The tool frame of a
    # snake-like wrist is at the tips.
    fingers = RigidTransform(RotationMatrix.MakeFromOneVector(-X_T.rotation().col(0), 2), X.translation())
    if tool.snake:
        fingers.set_translation(X_T.translation() - common.finger[2] * X_T.rotation().col(2))
    writer.finger("finger_1", fingers, X_T.rotation(), -1.0, parent, "finger_1", mimic=("jaw", -0.5))
    writer.finger("finger_2", fingers, X_T.rotation(), 1.0, "finger_1_link", "jaw", driven=driven["jaw"])
    return root


class _Writer:
    """Adds links, joints and frames to a model. Links are parallel to the base at the home pose."""

    def __init__(self, model: ElementTree.Element) -> None:
        self._model, self._common = model, _needle_driver()

    def add(
        self,
        name: str,
        X: RigidTransform,
        parent: str,
        mass: float,
        length: float,
        joint: str,
        driven: tuple | None = None,
        *,
        mimic: tuple[str, float] | None = None,
        limit_factor: float = 1.0,
    ) -> None:
        """Adds a link with a cylinder, and the joint that moves it about the z axis of X.

        The roll link is a shaft behind its origin, and the links of the wrist are centred.
        """
        height = length if name == "roll" else 0.0
        p_LC = np.array([0.0, 0.0, height / 2])
        inertia = UnitInertia.SolidCylinder(self._common.radius, length, np.array([0.0, 0.0, 1.0]))
        link = self._link(name, X, mass, p_LC, inertia)
        # Short links end before the next one, and the disc of a snake-like wrist is inside the shaft.
        if not name.endswith("_disc"):
            cylinder = Cylinder(self._common.radius, length if name == "roll" else 0.9 * length)
            self._shapes(link, cylinder, RigidTransform(p_LC))
        self._joint(joint, parent, name, X.rotation().col(2), driven, mimic, limit_factor)

    def housing(self, carrier: str, X: RigidTransform) -> None:
        """Adds the housing in front of the last frame of the arm to the link that carries it, which has the mass."""
        link = ElementTree.SubElement(self._model, "link", name=carrier)
        self._shapes(link, Box(self._common.housing), RigidTransform(X.translation() + self._common.housing_center))

    def finger(
        self, name: str, X: RigidTransform, R_tool: RotationMatrix, side: float, parent: str, joint: str, **kind: Any
    ) -> None:
        """Adds a finger, which points along the z axis of the tool frame and lies on one side of it."""
        width, _, length = size = self._common.finger
        p_LC = R_tool @ np.array([0.0, side * width / 2, length / 2])
        R = RotationMatrix(np.column_stack([R_tool.col(1), -R_tool.col(0), R_tool.col(2)]))
        inertia = UnitInertia.SolidBox(*size).ReExpress(R)
        link = self._link(name, X, self._common.masses[2], p_LC, inertia)
        self._shapes(link, Box(*size), RigidTransform(R, p_LC))
        self._joint(joint, parent, name, X.rotation().col(2), kind.get("driven"), kind.get("mimic"), 1.0)

    def frame(self, name: str, R: RotationMatrix, link: str, p: NDArray[np.float64] | None = None) -> None:
        """Adds a frame of a link."""
        element = ElementTree.SubElement(self._model, "frame", name=name, attached_to=link)
        add_pose(element, RigidTransform(R, np.zeros(3) if p is None else p))

    def _link(
        self, name: str, X: RigidTransform, mass: float, p_LC: NDArray[np.float64], inertia: UnitInertia
    ) -> ElementTree.Element:
        link = ElementTree.SubElement(self._model, "link", name=f"{name}_link")
        add_pose(link, RigidTransform(X.translation()))
        central = SpatialInertia(mass, np.zeros(3), inertia)
        link.append(inertial_element(central.Shift(-p_LC)))
        return link

    def _shapes(self, link: ElementTree.Element, shape: Shape, X: RigidTransform) -> None:
        for tag in ("visual", "collision"):
            element = shape_element(shape)
            assert element is not None
            part = ElementTree.SubElement(link, tag, name=f"{self._model.get('name')}_{element.tag}_{tag}")
            add_pose(part, X)
            ElementTree.SubElement(part, "geometry").append(element)
            if tag == "visual":
                add_element(ElementTree.SubElement(part, "material"), "diffuse", "0.3 0.32 0.35 1")

    def _joint(
        self,
        name: str,
        parent: str,
        child: str,
        axis: NDArray[np.float64],
        driven: tuple | None,
        mimic: tuple[str, float] | None,
        limit_factor: float,
    ) -> None:
        joint = ElementTree.SubElement(self._model, "joint", name=name, type="revolute")
        add_element(joint, "parent", parent)
        add_element(joint, "child", f"{child}_link")
        element = ElementTree.SubElement(joint, "axis")
        add_element(element, "xyz", numbers_text(axis))
        limit = ElementTree.SubElement(element, "limit")
        if driven is None:
            assert mimic is not None
            add_element(limit, "effort", "0")
            leader, multiplier = mimic
            ElementTree.SubElement(joint, f"{DRAKE}mimic", joint=leader, multiplier=repr(multiplier), offset="0")
            return
        (lower, upper), effort, velocity, gear = driven
        for tag, value in zip(
            ("lower", "upper", "effort", "velocity"),
            (limit_factor * lower, limit_factor * upper, effort, velocity),
            strict=True,
        ):
            add_element(limit, tag, repr(float(value)))
        add_element(joint, f"{DRAKE}rotor_inertia", repr(self._common.rotor))
        add_element(joint, f"{DRAKE}gear_ratio", repr(round(float(gear), 4)))
