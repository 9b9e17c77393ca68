"""Computes the base parameters of an arm's gravity torque numerically."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from dvrk_drake.models.plant import set_arm_positions, shared_plant, tree_selector


@dataclass(frozen=True, eq=False)
class GravityParameters:
    """Base parameters beta of the links, with the holding torque tau = Y(q) beta.

    Attributes:
        arm: whose links these are.
        standard_parameters: mass and first moments of every link, in the named frames of the SDF.
        to_standard: (p, 10 l) the standard parameters from the ten of each link in the order of `link_inertias`. A
            rotor without a frame of its own is part of the link that carries it, and balanced about its axis.
        lengths: named distances between the links' frames [m], as they stand in the base parameters' names.
        base: the base parameters beta = base.combination standard_values, in base.units.
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
        """(b, 10 l) the base parameters from the ten parameters of each of the arm's links, in the order of `links`."""
        order = [link.link for link in link_inertias(self.arm)]
        columns = [10 * order.index(link) + k for link in links for k in range(10)]
        return np.asarray(self.base.combination @ self.to_standard[:, columns])


@cache
def gravity_parameters(arm: Arm, frames: str = "dh", serial: bool = False) -> GravityParameters:
    """Returns the base parameters of an arm's gravity torque.

    Args:
        arm: the arm; its gravity vector sets the mounting.
        frames: prefix of the SDF frames in which the parameters are written: "dh" (dVRK) or, on the MTM, "paper".
        serial: leaves out the links of the linkage (crank, coupler), as the paper does.

    Raises:
        ArmError: the arm's SDF has no frames of that prefix, gravity is (almost) zero, or `serial` of an arm whose
            joints move other links than the numbered ones, as a PSM's jaw does.
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
    regressor = _regressor_at_random_poses(plant, arm, list(kept.values()))
    return GravityParameters(
        arm=arm,
        standard_parameters=tuple(parameters),
        to_standard=_to_standard(plant, arm, list(kept.values())),
        lengths={name: length for name, length in lengths.items() if name != "1"},
        base=reduce_to_base(regressor, parameters, _readable_preference(parameters), lengths),
    )


def _regressor_at_random_poses(
    plant: MultibodyPlant, arm: Arm, bodies: Sequence[tuple[RigidBody, RigidTransform]]
) -> NDArray[np.float64]:
    """(rows, p) of a unit of gravity: the height's derivative of the origin of each frame F, and of its unit vectors.

    The potential energy of a link is linear in its mass m and first moment m c: m times the height of Fo, and m c times
    the part of F's axes that points upwards.
    """
    up = -arm.gravity / np.linalg.norm(arm.gravity)
    points = [X_BF.multiply(np.hstack([np.zeros((3, 1)), np.eye(3)])) for _, X_BF in bodies]
    context, world, selector = plant.CreateDefaultContext(), plant.world_frame(), tree_selector(plant, arm)
    rows = []
    for q in np.random.default_rng(0).uniform(-2, 2, (4 * len(bodies) + 10, arm.num_joints)):
        set_arm_positions(plant, context, arm, q)
        columns = []
        for (body, _), p_BoP in zip(bodies, points, strict=True):
            J = plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(), p_BoP, world, world
            )
            rise = np.tensordot(J.reshape(4, 3, -1)[..., selector], up, axes=(1, 0))
            rise[1:] -= rise[0]
            columns.append(rise @ arm.linkage.matrix)
        rows.append(np.concatenate(columns).T)
    return np.concatenate(rows)


def _to_standard(
    plant: MultibodyPlant, arm: Arm, bodies: Sequence[tuple[RigidBody, RigidTransform]]
) -> NDArray[np.float64]:
    """(4 bodies, 10 l) [m, m c in F] of each body and the rotors on it, from the ten parameters of all links.

    Turning a rotor that is balanced about its axis moves no mass, so for gravity it is part of the link.
    """
    order = [link.link for link in link_inertias(arm)]
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(arm_instance(plant))]
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
    """(4, 4) [m, m c] of a joint's child C, about Bo and along B of the parent, from those about Co along C.

    Raises:
        ArmError: C is no rotor: it does not turn, or its centre of mass is off the axis.
    """
    child = joint.child_body()
    if joint.type_name() != "revolute":
        raise ArmError(f"{child.name()} needs a frame dh_<name>, because its joint is not revolute")
    X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    axis, p_CM = X_CM.rotation() @ joint.revolute_axis(), X_CM.translation()
    if np.linalg.norm(np.cross(child.default_com() - p_CM, axis)) > 1e-9:
        raise ArmError(f"{child.name()} needs a frame dh_<name>, because its centre of mass is not on its joint axis")
    X_BC = child.body_frame().CalcPose(plant.CreateDefaultContext(), joint.parent_body().body_frame())
    along = np.outer(axis, axis)
    R_BC, p_BM = X_BC.rotation().matrix(), X_BC.multiply(p_CM)
    return np.block([[np.ones((1, 1)), np.zeros((1, 3))], [(p_BM - R_BC @ along @ p_CM)[:, None], R_BC @ along]])


def labelled_bodies(plant: MultibodyPlant, frames: str) -> dict[str, tuple[RigidBody, RigidTransform]]:
    """Bodies by label with the frame F that their parameters are written in, X_BF; numbered links first.

    The links are those with a frame <frames>_<number>, the base's 0 left out, or dh_<name> for links of a linkage.
    """
    bodies = {}
    for index in plant.GetFrameIndices(arm_instance(plant)):
        frame = plant.get_frame(index)
        prefix, _, label = frame.name().partition("_")
        if (prefix == frames or (prefix == "dh" and not label.isdigit())) and not plant.IsAnchored(frame.body()):
            bodies[label] = (frame.body(), frame.GetFixedPoseInBodyFrame())
    if not any(label.isdigit() for label in bodies):
        raise ArmError(f'the SDF has no frames "{frames}_1", "{frames}_2", ...; use the prefix "dh"')
    return dict(sorted(bodies.items(), key=lambda item: (not item[0].isdigit(), item[0])))


def arm_instance(plant: MultibodyPlant) -> ModelInstanceIndex:
    """Returns the model instance of the arm in a plant with one arm."""
    return plant.GetBodyByName("base_link").model_instance()


def exact_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns R with elements within rounding error of 0 or +-1 replaced by the exact values."""
    return np.where(np.abs(R - np.round(R)) < 1e-12, np.round(R), R)


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


def _readable_preference(parameters: Sequence[StandardParameter]) -> list[int]:
    """First moments of numbered links from the hand inward, then those of the linkage, masses last and from the base.

    So a link's mass is read as a first moment of the links before it, and where masses do have a column of their own
    (those that a prismatic joint lifts) it is that of the first: "(m3+...+m7)".
    """

    def key(index: int) -> tuple:
        p = parameters[index]
        number = int(p.label) if p.label.isdigit() else 0
        return (not p.axis, -number if p.axis else number or math.inf, p.label, p.axis)

    return sorted(range(len(parameters)), key=key)
