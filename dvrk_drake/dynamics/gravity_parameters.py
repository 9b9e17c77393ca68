"""Base parameters, the identifiable combinations of link parameters, their names, and those of the gravity torque."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, RigidBody

from dvrk_drake.dynamics.inertial_parameters import link_inertias, moving_bodies, rotor_links
from dvrk_drake.dynamics.kinematic_tree import KinematicTree
from dvrk_drake.dynamics.regressor_kernel import fill_regressor
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import DH_PREFIX, arm_frames, base_body, shared_plant


@dataclass(frozen=True)
class StandardParameter:
    """Inertial parameter of a link or a rotor.

    Attributes:
        label: Number or name of the link, such as "2" or "crank". For a rotor, number of the actuator.
        axis: "" for the mass [kg], "x", "y" or "z" for a first moment [kg m], "xx", "yy", "zz", "xy", "xz" or "yz" for
            a moment or product of inertia [kg m^2], and "a" for the inertia of a rotor [kg m^2; kg if `prismatic`].
        prismatic: True for the rotor of a prismatic actuator.
    """

    label: str
    axis: str = ""
    prismatic: bool = False

    def __str__(self) -> str:
        if self.is_inertia:
            return f"I{self.axis}_{self.label}"
        separator = "" if self.label.isdigit() else "_"
        mass = f"m{separator}{self.label}"
        return f"{mass} c{separator}{self.label}{separator}{self.axis}" if self.axis else mass

    @property
    def is_inertia(self) -> bool:
        """True for a second moment of mass of a link or a rotor."""
        return self.axis == "a" or len(self.axis) == 2

    @property
    def unit(self) -> str:
        """SI unit of the parameter."""
        if self.is_inertia:
            return "kg" if self.prismatic else "kg m^2"
        return "kg m" if self.axis else "kg"


@dataclass(frozen=True)
class BaseParameters:
    """Base parameters beta = combination @ phi, where phi (p,) contains the standard parameters.

    The regressor for beta consists of the columns `columns` of the regressor for phi.

    Attributes:
        columns: Indices (b,) of the standard parameters whose regressor columns form the regressor for beta.
        combination: Matrix (b, p) that maps phi to beta.
        names: Names (b,), such as "L2 (m2+...+m7) + m2 c2x".
        units: Units (b,) of the base parameters.
    """

    columns: tuple[int, ...]
    combination: NDArray[np.float64]
    names: tuple[str, ...]
    units: tuple[str, ...]


#: Largest rounding error of a coefficient. A column is dependent if the norm of its component that is orthogonal to the
#: chosen columns is at most this share of the largest column norm. For this package's arms, the share is above 1e-3 for
#: independent and below 1e-15 for dependent columns.
TOLERANCE = 1e-9


def independent_columns(regressor: NDArray[np.float64]) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Returns indices of linearly independent columns of a regressor, and the combinations that give all columns.

    The indices `columns` (b,) and the matrix B (b, p) satisfy regressor = regressor[:, columns] B.

    Args:
        regressor: Regressor rows (rows, p) at random states, with many more rows than columns.
    """
    R, pivots = scipy.linalg.qr(regressor, mode="r", pivoting=True)
    rank = int(np.sum(np.abs(np.diag(R)) > TOLERANCE * abs(R[0, 0])))
    order = np.argsort(pivots[:rank])
    B = np.empty((rank, regressor.shape[1]))
    B[:, pivots] = np.linalg.solve(R[:rank, :rank], R[:rank])[order]
    return pivots[:rank][order], np.where(np.abs(B) > TOLERANCE, B, 0.0)


def reduce_to_base(
    regressor: NDArray[np.float64],
    parameters: Sequence[StandardParameter],
    preference: Sequence[int],
    lengths: Mapping[str, float],
) -> BaseParameters:
    """Computes base parameters whose regressor columns come as early as possible in `preference`.

    The method is a QR decomposition. Its pivots are chosen in the order of `preference` instead of by magnitude.
    Without rounding errors, the order affects only the form of the base parameters. Reference: Gautier, "Numerical
    calculation of the base inertial parameters of robots" (1991).

    Args:
        regressor: Regressor rows (rows, p) at random states, with many more rows than columns.
        parameters: Standard parameters (p,).
        preference: Permutation of the column indices 0 to p - 1, most preferred column first.
        lengths: Name -> coefficient, such as a length [m] or a product of lengths. In the symbolic names of the
            base parameters, each coefficient is written as its key instead of its value.
    """
    scale = np.linalg.norm(regressor, axis=0).max()
    columns: list[int] = []
    basis = np.empty((len(regressor), 0))
    for column in preference:
        residual = regressor[:, column]
        for _ in range(2):  # Two passes give orthogonality to machine precision (Kahan, Parlett).
            residual = residual - basis @ (basis.T @ residual)
        norm = np.linalg.norm(residual)
        if norm > TOLERANCE * scale:
            columns.append(column)
            basis = np.column_stack([basis, residual / norm])
    columns.sort()
    in_basis = basis.T @ regressor
    combination = _snap_to_known(np.asarray(np.linalg.solve(in_basis[:, columns], in_basis)), lengths)
    names = tuple(_format_combination(row, parameters, lengths) for row in combination)
    units = tuple(parameters[column].unit for column in columns)
    return BaseParameters(tuple(columns), combination, names, units)


def _snap_to_known(combination: NDArray[np.float64], lengths: Mapping[str, float]) -> NDArray[np.float64]:
    """Corrects coefficients that differ from 0, +-1 or a named length only by rounding errors."""
    known = np.array([0.0, 1.0, -1.0, *lengths.values(), *(-v for v in lengths.values())])
    nearest = known[np.argmin(np.abs(combination[..., None] - known), axis=-1)]
    return np.where(np.abs(combination - nearest) < TOLERANCE, nearest, combination)


def _format_combination(
    row: NDArray[np.float64], parameters: Sequence[StandardParameter], lengths: Mapping[str, float]
) -> str:
    """Formats a base parameter as a sum of inertias, masses and first moments.

    Masses with a common coefficient are grouped in brackets.
    """
    groups: dict[float, list[StandardParameter]] = {}
    inertias: list[tuple[float, str]] = []
    moments: list[tuple[float, str]] = []
    for coefficient, parameter in zip(row, parameters, strict=True):
        if coefficient and parameter.is_inertia:
            inertias.append((coefficient, str(parameter)))
        elif coefficient and parameter.axis:
            moments.append((coefficient, str(parameter)))
        elif coefficient:
            # After rounding, coefficients that differ only by rounding errors have the same key.
            groups.setdefault(round(coefficient, 12), []).append(parameter)
    terms = inertias + [(coefficient, _sum_of_masses(group)) for coefficient, group in groups.items()] + moments
    text = ""
    for coefficient, term in terms:
        size = next(
            (name for name, v in lengths.items() if abs(v - abs(coefficient)) < TOLERANCE), f"{abs(coefficient):.6g}"
        )
        factor = "" if size == "1" else f"{size} "
        sign = ("- " if coefficient < 0 else "+ ") if text else ("-" if coefficient < 0 else "")
        text += f"{' ' if text else ''}{sign}{factor}{term}"
    return text


def _sum_of_masses(group: Sequence[StandardParameter]) -> str:
    """Formats a sum of masses: "(m2+...+m7)" for more than three consecutive links, otherwise e.g. "(m2+m_coupler)"."""
    if len(group) == 1:
        return str(group[0])
    numbers = [int(p.label) for p in group if p.label.isdigit()]
    others = [str(p) for p in group if not p.label.isdigit()]
    if len(numbers) > 3 and numbers == list(range(numbers[0], numbers[-1] + 1)):
        parts = [f"m{numbers[0]}", "...", f"m{numbers[-1]}"]
    else:
        parts = [f"m{number}" for number in numbers]
    return f"({'+'.join(parts + others)})"


@dataclass(frozen=True, eq=False)
class GravityParameters:
    """Base parameters beta of an arm's gravity torque tau = Y(q) beta.

    Attributes:
        arm: Arm of the links.
        standard_parameters: Mass and first moments of every link, in the frames F of `tree`.
        to_standard: Matrix (p, 10 l) that maps the ten parameters of each of the l links, in the order of
            `link_inertias`, to the standard parameters. A balanced rotor is a part of the link that carries the motor,
            see `rotor_links`.
        lengths: Name -> distance between link frames [m]. The names of the base parameters contain these names.
        base: Base parameters beta = base.combination @ standard_values, in the units `base.units`.
        tree: Links and their frames F, without the balanced rotors.
        link_rows: Index in `tree` of the link of each standard mass.
    """

    arm: Arm
    standard_parameters: tuple[StandardParameter, ...]
    to_standard: NDArray[np.float64]
    lengths: dict[str, float]
    base: BaseParameters
    tree: KinematicTree
    link_rows: NDArray[np.int64]

    @property
    def standard_values(self) -> NDArray[np.float64]:
        """Standard parameters (p,) of the SDF [kg, kg m]."""
        return self.to_standard @ np.concatenate([link.parameters for link in link_inertias(self.arm)])

    @property
    def base_values(self) -> NDArray[np.float64]:
        """Base parameters (b,) of the SDF, in `base.units`."""
        return self.base.combination @ self.standard_values

    def combination_of(self, links: Sequence[str]) -> NDArray[np.float64]:
        """Returns the matrix (b, 10 l) that maps the ten parameters of each of the l `links` to the base parameters."""
        order = [link.link for link in link_inertias(self.arm)]
        columns = [10 * order.index(link) + k for link in links for k in range(10)]
        return np.asarray(self.base.combination @ self.to_standard[:, columns])

    @cached_property
    def columns(self) -> NDArray[np.int64]:
        """Column (b,) of each base parameter in the regressor of the dynamics, which has ten columns per link."""
        kept = np.array(self.base.columns)
        return 10 * self.link_rows[kept // 4] + kept % 4

    def regressor_at(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the regressor Y (m, n, b) of the base parameters at poses q (m, n) [rad, m]."""
        return _regressor_at_rest(self.tree, self.arm.gravity, self.columns, q)

    def weights(self, beta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns masses and first moments (l, 4) of the links of `tree` that have the base parameters beta (b,)."""
        parameters = np.zeros(10 * len(self.tree.links))
        parameters[self.columns] = beta
        return parameters.reshape(-1, 10)[:, :4]


@cache
def gravity_parameters(arm: Arm) -> GravityParameters:
    """Returns the base parameters of an arm's gravity torque, expressed in the frames of `link_frames`.

    Args:
        arm: Arm whose gravity vector specifies the orientation of the base.

    Raises:
        ArmError: Gravity is less than 1 m/s^2.
    """
    if (size := float(np.linalg.norm(arm.gravity))) < 1.0:
        raise ArmError(f"{arm.name}: gravity is {size:.3g} m/s^2; it must be 1 m/s^2 or more for a gravity model")
    labels = link_frames(arm)
    of_body = {body.name(): X_BF for body, X_BF in labels.values()}
    tree = KinematicTree.from_plant(shared_plant(arm), arm).without(rotor_links(arm))
    tree = tree.in_frames([of_body[link] for link in tree.links])
    link_rows = np.array([tree.links.index(body.name()) for body, _ in labels.values()])
    parameters = [StandardParameter(label, axis) for label in labels for axis in ("", "x", "y", "z")]
    lengths = named_lengths(arm, labels)
    poses = np.random.default_rng(0).uniform(-2, 2, (4 * len(labels) + 10, arm.num_joints))
    columns = (10 * link_rows[:, None] + np.arange(4)).ravel()
    regressor = _regressor_at_rest(tree, arm.gravity / size, columns, poses).reshape(-1, len(columns))
    immobile = {label for label, row in zip(labels, link_rows, strict=True) if not np.any(tree.G[row])}
    return GravityParameters(
        arm=arm,
        standard_parameters=tuple(parameters),
        to_standard=_to_standard(arm, list(labels.values())),
        lengths={name: length for name, length in lengths.items() if name != "1"},
        base=reduce_to_base(regressor, parameters, preference_order(parameters, immobile=immobile), lengths),
        tree=tree,
        link_rows=link_rows,
    )


def _regressor_at_rest(
    tree: KinematicTree, gravity: NDArray[np.float64], columns: NDArray[np.int64], q: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns some columns (m, n, b) of the regressor of the dynamics at rest, at poses q (m, n)."""
    q = np.ascontiguousarray(q, dtype=np.float64)
    rest, num_joints = np.zeros_like(q), q.shape[1]
    Y = np.empty((*q.shape, 10 * len(tree.links)))
    fill_regressor(q, rest, rest, gravity, tree.arrays, np.empty((0, 2, num_joints)), Y)
    return Y[..., columns]


def _to_standard(arm: Arm, bodies: Sequence[tuple[RigidBody, RigidTransform]]) -> NDArray[np.float64]:
    """Returns the matrix (4 k, 10 l) that maps the parameters of all l links to mass and first moments of k bodies.

    The first moments are expressed in frame F of the body. The rotation of a balanced rotor does not change the gravity
    torque. Therefore the rotor is treated as a part of the body that carries the motor.
    """
    plant = shared_plant(arm)
    order = [link.link for link in link_inertias(arm)]
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(base_body(plant).model_instance())]
    rotors = rotor_links(arm)
    rows = np.zeros((len(bodies), 4, len(order), 10))
    for row, (body, X_BF) in zip(rows, bodies, strict=True):
        R_FB = exact_rotation(X_BF.rotation().matrix()).T
        to_F = np.block([[np.ones((1, 1)), np.zeros((1, 3))], [-R_FB @ X_BF.translation()[:, None], R_FB]])
        row[:, order.index(body.name()), :4] = to_F
        for joint in joints:
            if joint.parent_body() == body and joint.child_body().name() in rotors:
                row[:, order.index(joint.child_body().name()), :4] = to_F @ _balanced_rotor(plant, joint)
    return rows.reshape(4 * len(bodies), -1)


def _balanced_rotor(plant: MultibodyPlant, joint: Joint) -> NDArray[np.float64]:
    """Returns the matrix (4, 4) that maps mass and first moments of a rotor from its frame C to its parent frame B."""
    child = joint.child_body()
    X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    axis, p_CM = X_CM.rotation() @ joint.revolute_axis(), X_CM.translation()
    X_BC = child.body_frame().CalcPose(plant.CreateDefaultContext(), joint.parent_body().body_frame())
    along = np.outer(axis, axis)
    R_BC, p_BM = X_BC.rotation().matrix(), X_BC.multiply(p_CM)
    return np.block([[np.ones((1, 1)), np.zeros((1, 3))], [(p_BM - R_BC @ along @ p_CM)[:, None], R_BC @ along]])


def link_frames(arm: Arm) -> dict[str, tuple[RigidBody, RigidTransform]]:
    """Returns label -> (moving body B, pose X_BF of its frame F) for all links except balanced rotors.

    The parameters of the body are expressed in frame F. This is the frame dh_<number>, or dh_<name> for a link of a
    linkage. The label is <number> or <name>. If a body has several such frames, the first one in this order is F. For a
    body without such a frame, F is the frame of the link, and the label is its name without the suffix "_link".
    Numbered links come first.
    """
    plant = shared_plant(arm)
    found = {}
    for frame in arm_frames(plant):
        if frame.name().startswith(DH_PREFIX) and not plant.IsAnchored(frame.body()):
            found[frame.name().removeprefix(DH_PREFIX)] = (frame.body(), frame.GetFixedPoseInBodyFrame())
    bodies: dict[str, tuple[RigidBody, RigidTransform]] = {}
    for label in sorted(found, key=lambda label: (not label.isdigit(), int(label) if label.isdigit() else 0, label)):
        if all(found[label][0] != body for body, _ in bodies.values()):
            bodies[label] = found[label]
    named = {body.name() for body, _ in bodies.values()} | rotor_links(arm)
    for body in moving_bodies(plant):
        if body.name() not in named:
            bodies[body.name().removesuffix("_link")] = (body, RigidTransform())
    return bodies


def exact_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns R, with exact values for elements that differ from 0 or +-1 only by rounding errors."""
    return np.where(np.abs(R - np.round(R)) < 1e-12, np.round(R), R)


def named_lengths(arm: Arm, labels: Mapping[str, tuple[RigidBody, RigidTransform]]) -> dict[str, float]:
    """Returns name -> distance between the frames of neighbouring links [m], such as "L2" and "L_crank".

    The entry "1" is 1.0, the factor of terms that contain no length.
    """
    plant = shared_plant(arm)
    context = plant.CreateDefaultContext()
    lengths = {"1": 1.0}
    for label in labels:
        if label.isdigit():
            previous = plant.GetFrameByName(f"{DH_PREFIX}{int(label) - 1}")
            X = plant.GetFrameByName(f"{DH_PREFIX}{label}").CalcPose(context, previous)
            name = f"L{label}"
        else:
            parents = [plant.get_joint(j) for j in plant.GetJointIndices(base_body(plant).model_instance())]
            child = next((j for j in parents if j.parent_body() == labels[label][0] and j.num_positions()), None)
            if child is None:
                continue
            X = child.frame_on_child().CalcPose(context, labels[label][0].body_frame())
            name = f"L_{label}"
        distance = float(np.round(np.linalg.norm(X.translation()), 12))
        if distance > 0:
            lengths[name] = distance
    return lengths


def preference_order(
    parameters: Sequence[StandardParameter], hinge_axes: Mapping[str, int] | None = None, immobile: Collection[str] = ()
) -> list[int]:
    """Returns parameter indices, with the parameters that are preferred as base parameters first.

    Three parameters of a revolute link with axis u can be regrouped with the previous link. They are the mass, the
    first moment along u and one moment of inertia about an axis perpendicular to u. The order is: link parameters that
    cannot be regrouped, from tip to base; moments that can be regrouped, from base to tip; rotors; masses, from base to
    tip. With this order, masses are combined with the first moments of preceding links. Only masses that a prismatic
    joint lifts form a separate base parameter, such as "(m3+...+m7)". In each group, the links of the linkage follow
    the numbered links. Reference: Khalil and Dombre, "Modeling, Identification and Control of Robots", 9.4.2.

    Args:
        parameters: Parameters of links from base to tip, and of rotors.
        hinge_axes: Label -> axis u (0, 1, 2) of a revolute link. Moments of other links are not regrouped.
        immobile: Labels of links that do not move relative to their parents. They come last in their group, since they
            are combined with the links that carry them.
    """
    axes = hinge_axes or {}
    labels = list(dict.fromkeys(p.label for p in parameters))
    numbered = any(label.isdigit() for label in labels)

    def is_regrouped(p: StandardParameter) -> bool:
        if not p.axis:
            return True
        u = axes.get(p.label)
        perpendicular = [axis for axis in range(3) if axis != u]
        return u is not None and p.axis in ("xyz"[u], 2 * "xyz"[perpendicular[-1]])

    def key(index: int) -> tuple:
        p = parameters[index]
        regrouped = is_regrouped(p)
        number = int(p.label) if p.label.isdigit() else math.inf if numbered else labels.index(p.label)
        order = (number == math.inf, number if regrouped else -number, index)
        return (not p.axis, p.axis == "a", p.label in immobile, regrouped, *order)

    return sorted(range(len(parameters)), key=key)
