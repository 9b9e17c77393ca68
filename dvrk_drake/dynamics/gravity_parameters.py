"""Computes the base parameters of an arm's gravity torque numerically."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, Joint, ModelInstanceIndex, RigidBody

from dvrk_drake.dynamics.base_parameters import BaseParameters, StandardParameter, reduce_to_base
from dvrk_drake.dynamics.inertial_parameters import link_inertias, rotor_links
from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import holding_torques, set_arm_positions, shared_plant, tree_selector


@dataclass(frozen=True, eq=False)
class GravityParameters:
    """Base parameters beta of an arm's gravity torque tau = Y(q) beta.

    Attributes:
        arm: Arm of the links.
        standard_parameters: Mass and first moments of every link, in the link frames of the SDF.
        to_standard: Matrix (p, 10 l) that maps the ten parameters of each of the l links, in the order of
            `link_inertias`, to the standard parameters. A rotor without a frame dh_<name> is balanced about its axis.
            Such a rotor is treated as a part of the link that carries the motor.
        lengths: Name -> distance between link frames [m]. The names of the base parameters contain these names.
        base: Base parameters beta = base.combination @ standard_values, in the units `base.units`.
    """

    arm: Arm
    standard_parameters: tuple[StandardParameter, ...]
    to_standard: NDArray[np.float64]
    lengths: dict[str, float]
    base: BaseParameters

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


@cache
def gravity_parameters(arm: Arm, frames: str = "dh", serial: bool = False) -> GravityParameters:
    """Returns the base parameters of an arm's gravity torque.

    Args:
        arm: Arm whose gravity vector specifies the orientation of the base.
        frames: Prefix of the SDF frames in which the parameters are expressed: "dh" for the DH frames of the dVRK or,
            for an MTM, "paper" for the frames of Rutfield et al. (2015).
        serial: True to omit the links of the linkage (crank, coupler), as in Rutfield et al. (2015).

    Raises:
        ArmError: The SDF has no frames with this prefix, gravity is less than 1 m/s^2, or `serial` is True and a joint
            moves a link without a numbered frame, such as the jaw of a PSM.
    """
    if (size := float(np.linalg.norm(arm.gravity))) < 1.0:
        raise ArmError(f"{arm.name}: gravity is {size:.3g} m/s^2; it must be 1 m/s^2 or more for a gravity model")
    plant = shared_plant(arm)
    bodies = labelled_bodies(plant, frames)
    kept = {label: body for label, body in bodies.items() if label.isdigit() or not serial}
    driven = {plant.GetJointByName(name).child_body().index() for name in arm.joint_names}
    if serial and not driven <= {body.index() for body, _ in kept.values()}:
        raise ArmError(
            f"{arm.name}: serial is not possible, because a joint moves a link that has no frame {frames}_<number>"
        )
    parameters = [StandardParameter(label, axis) for label in kept for axis in ("", "x", "y", "z")]
    lengths = named_lengths(plant, bodies, frames)
    poses = np.random.default_rng(0).uniform(-2, 2, (4 * len(kept) + 10, arm.num_joints))
    regressor = _regressor_at_poses(plant, arm, list(kept.values()), poses)
    order = _preference_order(parameters, _locked_labels(plant, arm, kept))
    result = GravityParameters(
        arm=arm,
        standard_parameters=tuple(parameters),
        to_standard=_to_standard(plant, arm, list(kept.values())),
        lengths={name: length for name, length in lengths.items() if name != "1"},
        base=reduce_to_base(regressor, parameters, order, lengths),
    )
    if not serial:
        tau = size * regressor[:, result.base.columns] @ result.base_values
        _check_torque(arm, tau, holding_torques(arm, poses))
    return result


def _check_torque(arm: Arm, tau: NDArray[np.float64], expected: NDArray[np.float64]) -> None:
    """Raises ArmError if the torques of the base parameters (m n,) differ from those of Drake (m, n).

    A check of the arm's structure would repeat the assumptions of this module about frames and rotors.
    """
    difference = np.abs(tau.reshape(expected.shape) - expected).max(axis=0)
    # Sums of some hundred terms, each with a relative rounding error of 2e-16, differ by less than 1e-12.
    if np.any(difference > 1e-12 * (1.0 + np.abs(expected).max())):
        j = int(np.argmax(difference))
        unit = "N" if arm.prismatic[j] else "N m"
        raise ArmError(
            f"{arm.name}: the gravity torque of {arm.joint_names[j]} differs by {difference[j]:.3g} {unit} from "
            "Drake's for the same SDF. Give each moving link a frame dh_<name>"
        )


def _regressor_at_poses(
    plant: MultibodyPlant,
    arm: Arm,
    bodies: Sequence[tuple[RigidBody, RigidTransform]],
    poses: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns regressor rows (m n, p) at poses (m, n) for gravity of 1 m/s^2.

    The potential energy of a link is linear in mass and first moments. The factor of the mass is the height of the
    origin of frame F. The factors of the first moments are the upward components of the axes of F. The regressor
    contains the derivatives of these factors with respect to the joint positions.
    """
    up = -arm.gravity / np.linalg.norm(arm.gravity)
    points = [X_BF.multiply(np.hstack([np.zeros((3, 1)), np.eye(3)])) for _, X_BF in bodies]
    context, world, selector = plant.CreateDefaultContext(), plant.world_frame(), tree_selector(plant, arm)
    rows = []
    for q in poses:
        set_arm_positions(plant, context, arm, q)
        columns = []
        for (body, _), p_BoP in zip(bodies, points, strict=True):
            J = plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(), p_BoP, world, world
            )
            height_rates = np.tensordot(J.reshape(4, 3, -1)[..., selector], up, axes=(1, 0))
            height_rates[1:] -= height_rates[0]
            columns.append(height_rates @ arm.linkage.matrix)
        rows.append(np.concatenate(columns).T)
    return np.concatenate(rows)


def _to_standard(
    plant: MultibodyPlant, arm: Arm, bodies: Sequence[tuple[RigidBody, RigidTransform]]
) -> NDArray[np.float64]:
    """Returns the matrix (4 k, 10 l) that maps the parameters of all l links to mass and first moments of k bodies.

    The first moments are expressed in frame F of the body. The rotation of a balanced rotor does not change the gravity
    torque. Therefore the rotor is treated as a part of the body that carries the motor.
    """
    order = [link.link for link in link_inertias(arm)]
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(arm_instance(plant))]
    rotors = rotor_links(arm)
    for joint in joints:
        carrier, link = joint.parent_body().name(), joint.child_body().name()
        if {carrier, link} <= rotors:
            raise ArmError(
                f"link {link} needs a frame dh_<name>, because {carrier}, which carries it, has no such frame"
            )
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
    """Returns the matrix (4, 4) that maps mass and first moments of a rotor from its frame C to its parent frame B.

    Raises:
        ArmError: The joint is not revolute, or the centre of mass of the rotor is not on the joint axis.
    """
    child = joint.child_body()
    if joint.type_name() != "revolute":
        raise ArmError(f"link {child.name()} needs a frame dh_<name>, because its joint is not revolute")
    X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    axis, p_CM = X_CM.rotation() @ joint.revolute_axis(), X_CM.translation()
    if np.linalg.norm(np.cross(child.default_com() - p_CM, axis)) > 1e-9:
        raise ArmError(
            f"link {child.name()} needs a frame dh_<name>, because its centre of mass is not on its joint axis"
        )
    X_BC = child.body_frame().CalcPose(plant.CreateDefaultContext(), joint.parent_body().body_frame())
    along = np.outer(axis, axis)
    R_BC, p_BM = X_BC.rotation().matrix(), X_BC.multiply(p_CM)
    return np.block([[np.ones((1, 1)), np.zeros((1, 3))], [(p_BM - R_BC @ along @ p_CM)[:, None], R_BC @ along]])


def labelled_bodies(plant: MultibodyPlant, frames: str) -> dict[str, tuple[RigidBody, RigidTransform]]:
    """Returns label -> (moving body B, pose X_BF of its frame F). Numbered links come first.

    The parameters of the body are expressed in frame F. This is the frame <frames>_<number>, or dh_<name> for a link of
    a linkage. The label is <number> or <name>. If a body has several such frames, the first one in this order is F.

    Raises:
        ArmError: The SDF has no numbered frames with the prefix `frames`.
    """
    found = {}
    for index in plant.GetFrameIndices(arm_instance(plant)):
        frame = plant.get_frame(index)
        prefix, _, label = frame.name().partition("_")
        if (prefix == frames or (prefix == "dh" and not label.isdigit())) and not plant.IsAnchored(frame.body()):
            found[label] = (frame.body(), frame.GetFixedPoseInBodyFrame())
    if not any(label.isdigit() for label in found):
        raise ArmError(f'the SDF has no frames "{frames}_1", "{frames}_2", ...; use the prefix "dh"')
    bodies: dict[str, tuple[RigidBody, RigidTransform]] = {}
    for label in sorted(found, key=lambda label: (not label.isdigit(), int(label) if label.isdigit() else 0, label)):
        if all(found[label][0] != body for body, _ in bodies.values()):
            bodies[label] = found[label]
    return bodies


def arm_instance(plant: MultibodyPlant) -> ModelInstanceIndex:
    """Returns the model instance of the arm in a plant with one arm."""
    return plant.GetBodyByName("base_link").model_instance()


def exact_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns R, with exact values for elements that differ from 0 or +-1 only by rounding errors."""
    return np.where(np.abs(R - np.round(R)) < 1e-12, np.round(R), R)


def named_lengths(
    plant: MultibodyPlant, labels: Mapping[str, tuple[RigidBody, RigidTransform]], frames: str = "dh"
) -> dict[str, float]:
    """Returns name -> distance between the frames of neighbouring links [m], such as "L2" and "L_crank".

    The entry "1" is 1.0, the factor of terms that contain no length.
    """
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


def _locked_labels(plant: MultibodyPlant, arm: Arm, bodies: Mapping[str, tuple[RigidBody, RigidTransform]]) -> set[str]:
    """Returns the labels of the links that do not move relative to their parents, because their joints are locked."""
    rows = zip(arm.tree_joint_names, arm.linkage.matrix, strict=True)
    locked = {plant.GetJointByName(name).child_body().index() for name, row in rows if not np.any(row)}
    return {label for label, (body, _) in bodies.items() if body.index() in locked}


def _preference_order(parameters: Sequence[StandardParameter], locked: Collection[str] = ()) -> list[int]:
    """Returns parameter indices, with the parameters that are preferred as base parameters first.

    The order is: first moments of numbered links from tip to base, first moments of the linkage, masses from base to
    tip. With this order, masses are combined with the first moments of preceding links. Only masses that a prismatic
    joint lifts form a separate base parameter, such as "(m3+...+m7)". The parameters of links behind a locked joint
    are combined with those of the link that carries them, so they come last.
    """

    def key(index: int) -> tuple:
        p = parameters[index]
        number = int(p.label) if p.label.isdigit() else 0
        is_locked = p.label in locked
        return (not p.axis, is_locked, -number if p.axis else number or math.inf, p.label, p.axis)

    return sorted(range(len(parameters)), key=key)
