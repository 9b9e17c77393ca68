"""Gravity torque and its regressor, derived symbolically from the arm's own MultibodyPlant (paper, III.B-D, H)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import sympy
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, RigidBody

from dvrk_drake.dynamics.base_parameters import BaseParameters, StandardParameter, reduce_to_base
from dvrk_drake.dynamics.symbolic_plant import SymbolicPlant, arm_instance, exact_rotation
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm

GRAVITY = sympy.Symbol("g", positive=True)


@dataclass(frozen=True, eq=False)
class SymbolicGravity:
    """tau = Y(q) beta: the torque on the n independent joints that holds the arm against gravity.

    Attributes:
        arm: whose equations these are.
        q: the n joint positions as sympy symbols q1..qn [rad, m].
        standard_parameters: mass and first moments of every link, in the named frames of the SDF.
        standard_values: (p,) their values in the SDF [kg, kg m].
        lengths: named distances between the links' frames [m], as they stand in the base parameters' names.
        base: the base parameters beta = base.combination standard_values, in base.units.
        regressor: sympy (n, b) in q and the symbol g = |gravity| [m/s^2]; d potential / dq.
        potential: sympy (1, b); potential beta is the part of the potential energy that depends on q [J].
    """

    arm: Arm
    q: tuple[sympy.Symbol, ...]
    standard_parameters: tuple[StandardParameter, ...]
    standard_values: NDArray[np.float64]
    lengths: dict[str, float]
    base: BaseParameters
    regressor: sympy.ImmutableDenseMatrix
    potential: sympy.ImmutableDenseMatrix

    @property
    def base_values(self) -> NDArray[np.float64]:
        """(b,) base parameters of the SDF, in `base.units`."""
        return self.base.combination @ self.standard_values

    @property
    def gravity_magnitude(self) -> float:
        """|gravity| [m/s^2]: the number for the symbol g."""
        return float(np.linalg.norm(self.arm.gravity))


@cache
def derive_gravity(arm: Arm, frames: str = "dh", serial: bool = False) -> SymbolicGravity:
    """Derives the gravity torque of `arm` from its plant.

    `MultibodyPlant.ToSymbolic()` gives the pose of every link, and so the potential energy P per unit of its mass m and
    of its first moment m c, in which P is linear. tau = G' dP/dq_tree falls out by making the tree a function of the
    independent joints first: the regressor's columns are the derivatives.

    Args:
        arm: the arm; its gravity vector sets the mounting.
        frames: prefix of the SDF frames in which the parameters are written: "dh" (dVRK) or, on the MTM, "paper".
        serial: leaves out the links of the linkage (crank, coupler), as the paper does.

    Raises:
        ArmError: the arm's SDF has no frames of that prefix, gravity is (almost) zero, or `serial` of an arm whose
            joints move other links than the numbered ones, as a PSM's jaw does.
    """
    if np.linalg.norm(arm.gravity) < 1.0:
        raise ArmError(f"{arm.name} is weightless: gravity must be 1 m/s^2 or more for a gravity model, on Earth 9.8")
    plant = SymbolicPlant(arm, frames)
    labels = [label for label in plant.bodies if label.isdigit() or not serial]
    driven = {plant.numeric.GetJointByName(name).child_body().index() for name in arm.joint_names}
    if serial and not driven <= {plant.bodies[label][0].index() for label in labels}:
        raise ArmError(f"{arm.name} has joints whose links have no number: its links cannot be told from its linkage")
    parameters: list[StandardParameter] = []
    values: list[float] = []
    for label in labels:
        parameters += [StandardParameter(label), *(StandardParameter(label, axis) for axis in "xyz")]
        values += _mass_and_moment(plant.numeric, *plant.bodies[label])
    # Simplified before they are differentiated: a linkage turns its links back and forth, which all drops out here.
    energies = [plant.simplify(plant.to_sympy(energy)) for link in plant.potential_energy(labels) for energy in link]
    standard = sympy.Matrix([[energy.diff(q) for q in plant.q] for energy in energies]).T

    lengths = named_lengths(plant.numeric, plant.bodies, frames)
    base = reduce_to_base(
        _evaluate_at_random_poses(standard, plant.q, arm), parameters, _readable_preference(parameters), lengths
    )
    chosen = standard.extract(list(range(arm.num_joints)), list(base.columns))
    return SymbolicGravity(
        arm=arm,
        q=plant.q,
        standard_parameters=tuple(parameters),
        standard_values=np.array(values),
        lengths={name: length for name, length in lengths.items() if name != "1"},
        base=base,
        regressor=sympy.ImmutableDenseMatrix(GRAVITY * chosen.applyfunc(plant.simplify)),
        potential=sympy.ImmutableDenseMatrix([[GRAVITY * energies[column] for column in base.columns]]),
    )


def _mass_and_moment(plant: MultibodyPlant, body: RigidBody, X_BF: RigidTransform) -> list[float]:
    """[m, m cx, m cy, m cz] in F of a link and the rotors on it: child bodies centred on their own axis.

    Turning such a rotor moves no mass, so for gravity it is part of the link.
    """
    mass, moment_B = body.default_mass(), body.default_mass() * body.default_com()
    for joint in map(plant.get_joint, plant.GetJointIndices(body.model_instance())):
        child = joint.child_body()
        if joint.parent_body() == body and not any(f.body() == child for f in _named_frames(plant)):
            if joint.type_name() != "revolute":
                raise ArmError(f"{child.name()} needs a frame dh_<name>: it does not turn like a rotor")
            context = plant.CreateDefaultContext()
            p_FmCcm = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse() @ child.default_com()
            if np.linalg.norm(np.cross(p_FmCcm, joint.revolute_axis())) > 1e-9:
                raise ArmError(f"{child.name()} needs a frame dh_<name>: its centre of mass is off its joint's axis")
            p_BCcm = child.body_frame().CalcPose(context, body.body_frame()) @ child.default_com()
            mass, moment_B = mass + child.default_mass(), moment_B + child.default_mass() * p_BCcm
    R_BF = exact_rotation(X_BF.rotation().matrix())
    return [mass, *(R_BF.T @ (moment_B - mass * X_BF.translation()))]


def _named_frames(plant: MultibodyPlant) -> list[Frame]:
    frames = map(plant.get_frame, plant.GetFrameIndices(arm_instance(plant)))
    return [frame for frame in frames if frame.name().startswith("dh_")]


def named_lengths(
    plant: MultibodyPlant, labels: Mapping[str, tuple[RigidBody, RigidTransform]], frames: str = "dh"
) -> dict[str, float]:
    """Constant distances between the frames of neighbouring links as the field names them: L2, L_crank; and "1"."""
    context = plant.CreateDefaultContext()
    lengths = {"1": 1.0}
    for label in labels:
        if label.isdigit():
            previous = plant.GetFrameByName(f"{frames}_{int(label) - 1}")
            X = plant.GetFrameByName(f"{frames}_{label}").CalcPose(context, previous)
            name = f"L{label}"
        else:
            parents = [plant.get_joint(j) for j in plant.GetJointIndices(arm_instance(plant))]
            child = next((j for j in parents if j.parent_body() == labels[label][0] and j.num_positions()), None)
            if child is None:
                continue
            X = child.frame_on_child().CalcPose(context, labels[label][0].body_frame())
            name = f"L_{label}"
        distance = float(np.round(np.linalg.norm(X.translation()), 12))
        if distance > 0:
            lengths[name] = distance
    return lengths


def _readable_preference(parameters: list[StandardParameter]) -> list[int]:
    """First moments of numbered links from the hand inward, then those of the linkage, masses last and from the base.

    So a link's mass is read as a first moment of the links before it, and where masses do have a column of their own
    (those that a prismatic joint lifts) it is that of the first: "(m3+...+m7)".
    """

    def key(index: int) -> tuple:
        p = parameters[index]
        number = int(p.label) if p.label.isdigit() else 0
        return (not p.axis, -number if p.axis else number or math.inf, p.label, p.axis)

    return sorted(range(len(parameters)), key=key)


def _evaluate_at_random_poses(
    columns: sympy.Matrix, symbols: tuple[sympy.Symbol, ...], arm: Arm
) -> NDArray[np.float64]:
    poses = np.random.default_rng(0).uniform(-2, 2, (columns.shape[1] + 10, arm.num_joints))
    function = sympy.lambdify(symbols, columns.T.tolist(), modules="numpy", cse=True)
    values = function(*poses.T)
    return (
        np.array([[np.broadcast_to(e, len(poses)) for e in column] for column in values])
        .reshape(columns.shape[1], -1)
        .T
    )
