"""Gravity torque and its regressor, derived symbolically from the arm's own MultibodyPlant (paper, III.B-D, H)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pydrake.symbolic as symbolic
import sympy
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody, SpatialInertia_, UnitInertia_

from dvrk_drake.dynamics.base_parameters import BaseParameters, StandardParameter, reduce_to_base
from dvrk_drake.dynamics.trigonometry import simplify_trigonometry
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, tree_selector

GRAVITY = sympy.Symbol("g", positive=True)


@dataclass(frozen=True, eq=False)
class SymbolicGravity:
    """tau = Y(q) beta: the torque on the n independent joints that holds the arm against gravity.

    Attributes:
        arm: whose equations these are.
        q: the n joint positions as sympy symbols q1..qn [rad, m].
        standard_parameters: mass and first moments of every link, in the named frames of the SDF.
        standard_values: (p,) their values in the SDF [kg, kg m].
        base: the base parameters beta = base.combination standard_values [kg m].
        regressor: sympy (n, b) in q and the symbol g = |gravity| [m/s^2].
    """

    arm: Arm
    q: tuple[sympy.Symbol, ...]
    standard_parameters: tuple[StandardParameter, ...]
    standard_values: NDArray[np.float64]
    base: BaseParameters
    regressor: sympy.ImmutableDenseMatrix

    @property
    def base_values(self) -> NDArray[np.float64]:
        """(b,) base parameters of the SDF [kg m]."""
        return self.base.combination @ self.standard_values

    @property
    def gravity_magnitude(self) -> float:
        """|gravity| [m/s^2]: the number for the symbol g."""
        return float(np.linalg.norm(self.arm.gravity))


@cache
def derive_gravity(arm: Arm, frames: str = "dh", serial: bool = False) -> SymbolicGravity:
    """Derives the gravity torque of `arm` from its plant.

    The plant gives its potential energy P(q, m, c) with every link's mass m and centre of mass c as symbols
    (`MultibodyPlant.CalcPotentialEnergy` on `ToSymbolic()`); tau = G' dP/dq_tree falls out by making the tree a
    function of the independent joints first. P is linear in m and m c: the regressor's columns are its derivatives.

    Args:
        arm: the arm; its gravity vector sets the mounting.
        frames: prefix of the SDF frames in which the parameters are written: "dh" (dVRK) or, on the MTM, "paper".
        serial: leaves out the links of the linkage (crank, coupler), as the paper does.

    Raises:
        ArmError: the arm's SDF has no frames of that prefix.
    """
    numeric = make_arm_plant(arm)
    plant = numeric.ToSymbolic()
    magnitude = np.linalg.norm(arm.gravity)
    plant.mutable_gravity_field().set_gravity_vector(arm.gravity / magnitude)
    labels = _labelled_bodies(numeric, frames)

    q = [symbolic.Variable(f"q{i + 1}") for i in range(arm.num_joints)]
    context = plant.CreateDefaultContext()
    q_plant = np.empty(plant.num_positions(), dtype=object)
    q_plant[tree_selector(numeric, arm)] = _tree_positions(arm, q)
    plant.SetPositions(context, q_plant)

    parameters: list[StandardParameter] = []
    values: list[float] = []
    unknowns: list[tuple[symbolic.Variable, list[symbolic.Variable]]] = []
    for label, (body, X_BF) in labels.items():
        m = symbolic.Variable(f"m_{label}")
        c_F = [symbolic.Variable(f"c_{label}{axis}") for axis in "xyz"]
        R_BF = _exact(X_BF.rotation().matrix())
        p_BoBcm = [
            symbolic.Expression(X_BF.translation()[i])
            + sum((R_BF[i, j] * c_F[j] for j in range(3)), symbolic.Expression(0))
            for i in range(3)
        ]
        M_BBo = SpatialInertia_[symbolic.Expression](
            symbolic.Expression(m),
            p_BoBcm,
            UnitInertia_[symbolic.Expression](1, 1, 1),
            skip_validity_check=True,
        )
        plant.get_body(body.index()).SetSpatialInertiaInBodyFrame(context, M_BBo)
        if label.isdigit() or not serial:
            unknowns.append((m, c_F))
            parameters += [StandardParameter(label), *(StandardParameter(label, axis) for axis in "xyz")]
            mass, moment_B = _mass_and_moment(numeric, body)
            values += [mass, *(R_BF.T @ (moment_B - mass * X_BF.translation()))]

    for index in plant.GetBodyIndices(_arm_instance(plant)):
        if not any(index == body.index() for body, _ in labels.values()) and not numeric.IsAnchored(
            numeric.get_body(index)
        ):
            # A rotor: counted with its link (_mass_and_moment). Mass 0 would divide by zero in newer Drake.
            M_rotor = SpatialInertia_[symbolic.Expression](
                symbolic.Variable("m_rotor"),
                [0, 0, 0],
                UnitInertia_[symbolic.Expression](1, 1, 1),
                skip_validity_check=True,
            )
            plant.get_body(index).SetSpatialInertiaInBodyFrame(context, M_rotor)
    P = plant.CalcPotentialEnergy(context)
    energies: list[symbolic.Expression] = []  # P per unit of each standard parameter
    for m, c_F in unknowns:
        dP_dm = P.Differentiate(m)
        energies.append(dP_dm.Substitute({c: symbolic.Expression(0) for c in c_F}))
        energies += [dP_dm.Differentiate(c) for c in c_F]
    drake_columns = [[energy.Differentiate(v) for v in q] for energy in energies]

    memo: dict = {}
    symbols = tuple(sympy.Symbol(f"q{i + 1}", real=True) for i in range(arm.num_joints))
    to_ours = {symbolic.to_sympy(symbolic.Expression(v), memo=memo): s for v, s in zip(q, symbols, strict=True)}
    columns = [[symbolic.to_sympy(e, memo=memo) for e in column] for column in drake_columns]
    standard = sympy.Matrix(columns).T.xreplace(to_ours)

    base = reduce_to_base(
        _evaluate_at_random_poses(standard, symbols, arm),
        parameters,
        _readable_preference(parameters),
        _named_lengths(numeric, frames, labels),
    )
    chosen = standard.extract(list(range(arm.num_joints)), list(base.columns))
    parallel = _parallel_pairs(numeric, arm)
    regressor = chosen.applyfunc(lambda e: GRAVITY * simplify_trigonometry(e, symbols, parallel))
    return SymbolicGravity(
        arm, symbols, tuple(parameters), np.array(values), base, sympy.ImmutableDenseMatrix(regressor)
    )


def _exact(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation matrix with the entries that are 0 or +-1 but for the rounding of their angles made exactly that."""
    return np.where(np.abs(R - np.round(R)) < 1e-12, np.round(R), R)


def _tree_positions(arm: Arm, q: list[symbolic.Variable]) -> list[symbolic.Expression]:
    G, c = arm.linkage.matrix, arm.linkage.offset
    return [
        sum((G[row, j] * q[j] for j in np.flatnonzero(G[row])), symbolic.Expression(c[row])) for row in range(len(c))
    ]


def _labelled_bodies(plant: MultibodyPlant, frames: str) -> dict[str, tuple[RigidBody, RigidTransform]]:
    """Bodies by label with the frame F that their parameters are written in, X_BF; numbered links first.

    The links are those with a frame <frames>_<number>, the base's 0 left out, or dh_<name> for links of a linkage.
    """
    bodies = {}
    for index in plant.GetFrameIndices(_arm_instance(plant)):
        frame = plant.get_frame(index)
        prefix, _, label = frame.name().partition("_")
        if (prefix == frames or (prefix == "dh" and not label.isdigit())) and not plant.IsAnchored(frame.body()):
            bodies[label] = (frame.body(), frame.GetFixedPoseInBodyFrame())
    if not any(label.isdigit() for label in bodies):
        raise ArmError(f'the SDF has no frames "{frames}_1", "{frames}_2", ...; try "dh"')
    return dict(sorted(bodies.items(), key=lambda item: (not item[0].isdigit(), item[0])))


def _mass_and_moment(plant: MultibodyPlant, body: RigidBody) -> tuple[float, NDArray[np.float64]]:
    """Mass and first moment about Bo in B of a link and the rotors on it: child bodies centred on their own axis.

    Turning such a rotor moves no mass, so for gravity it is part of the link.
    """
    mass, moment_B = body.default_mass(), body.default_mass() * body.default_com()
    for joint in map(plant.get_joint, plant.GetJointIndices(body.model_instance())):
        child = joint.child_body()
        if joint.parent_body() == body and not any(f.body() == child for f in _named_frames(plant)):
            context = plant.CreateDefaultContext()
            p_FmCcm = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse() @ child.default_com()
            if np.linalg.norm(np.cross(p_FmCcm, joint.revolute_axis())) > 1e-9:
                raise ArmError(f"{child.name()} needs a frame dh_<name>: its centre of mass is off its joint's axis")
            p_BCcm = child.body_frame().CalcPose(context, body.body_frame()) @ child.default_com()
            mass, moment_B = mass + child.default_mass(), moment_B + child.default_mass() * p_BCcm
    return mass, moment_B


def _named_frames(plant: MultibodyPlant) -> list[Frame]:
    frames = map(plant.get_frame, plant.GetFrameIndices(_arm_instance(plant)))
    return [frame for frame in frames if frame.name().startswith("dh_")]


def _arm_instance(plant: MultibodyPlant) -> ModelInstanceIndex:
    return plant.GetBodyByName("base_link").model_instance()


def _named_lengths(plant: MultibodyPlant, frames: str, labels: dict) -> dict[str, float]:
    """Constant distances between the frames of neighbouring links, named as the field does: L2, L3, L4, L_crank."""
    context = plant.CreateDefaultContext()
    lengths = {"1": 1.0}
    for label in labels:
        if label.isdigit():
            previous = plant.GetFrameByName(f"{frames}_{int(label) - 1}")
            X = plant.GetFrameByName(f"{frames}_{label}").CalcPose(context, previous)
            name = f"L{label}"
        else:
            parents = [plant.get_joint(j) for j in plant.GetJointIndices(_arm_instance(plant))]
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
    """First moments of numbered links from the hand inward, then those of the linkage, masses last."""

    def key(index: int) -> tuple:
        p = parameters[index]
        number = int(p.label) if p.label.isdigit() else 0
        return (not p.axis, -number, p.label, p.axis)

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


def _parallel_pairs(plant: MultibodyPlant, arm: Arm) -> list[tuple[int, int]]:
    """Neighbouring independent joints that turn about parallel axes: their angles appear as a sum."""
    context = plant.CreateDefaultContext()
    pairs = []
    joints = [plant.GetJointByName(name) for name in arm.joint_names]
    for i in range(len(joints) - 1):
        a, b = joints[i], joints[i + 1]
        if a.type_name() == b.type_name() == "revolute" and b.parent_body() == a.child_body():
            axes = [j.frame_on_parent().CalcPoseInWorld(context).rotation() @ j.revolute_axis() for j in (a, b)]
            if np.allclose(axes[0], axes[1], atol=1e-12):
                pairs.append((i, i + 1))
    return pairs
