"""Inertial parameters of links and rotors. The equations of motion are linear in these parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, RigidBody, SpatialInertia, UnitInertia

from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import DH_PREFIX, arm_frames, base_body, shared_plant

#: Names of the ten inertial parameters of a link [kg, kg m, kg m^2], in the order of all parameter vectors.
PARAMETER_NAMES = ("m", "mcx", "mcy", "mcz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")


@dataclass(frozen=True, eq=False)
class LinkInertia:
    """Spatial inertia M_LLo_L of a link L about the origin Lo of its SDF frame, expressed in L.

    Attributes:
        link: Name of the link in the SDF.
        parameters: Parameters (10,): mass m [kg], first moments m p_LoLcm_L [kg m], and Ixx, Iyy, Izz, Ixy, Ixz, Iyz
            about Lo [kg m^2]. Products of inertia are elements of the inertia matrix: Ixy = -integral x y dm.
    """

    link: str
    parameters: NDArray[np.float64]

    def pseudo_inertia(self) -> NDArray[np.float64]:
        """Returns the pseudo-inertia (4, 4), the integral of (p, 1)(p, 1)' dm over points p of the link.

        The pseudo-inertia of every body with a volume is positive definite.

        Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
        identification" (2018), equation 10.
        """
        return pseudo_inertia(self.parameters)

    @classmethod
    def from_spatial_inertia(cls, link: str, M_LLo_L: SpatialInertia) -> LinkInertia:
        """Converts Drake's spatial inertia of a link about the origin of its frame."""
        mass, I_LLo_L = M_LLo_L.get_mass(), M_LLo_L.CalcRotationalInertia()
        moments, products = I_LLo_L.get_moments(), I_LLo_L.get_products()
        return cls(link, np.concatenate([[mass], mass * M_LLo_L.get_com(), moments, products]))

    def to_spatial_inertia(self) -> SpatialInertia:
        """Returns M_LLo_L as Drake's spatial inertia.

        Raises:
            ModelError: The mass is not positive, or the inertia is not physically consistent.
        """
        mass, moment, inertia = self.parameters[0], self.parameters[1:4], self.parameters[4:]
        if not mass > 0:
            raise ModelError(f"{self.link}: mass {mass:.6g} kg must be positive")
        try:
            return SpatialInertia(mass, moment / mass, UnitInertia(*(inertia / mass)))
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            raise ModelError(f"{self.link}: the inertia is not physically consistent: {reason}") from error


def link_inertias(arm: Arm) -> tuple[LinkInertia, ...]:
    """Returns the inertias of all moving links in the SDF, including linkage and instrument."""
    return tuple(
        LinkInertia.from_spatial_inertia(body.name(), body.default_spatial_inertia())
        for body in moving_bodies(shared_plant(arm))
    )


def moving_bodies(plant: MultibodyPlant) -> Iterator[RigidBody]:
    """Yields the bodies of a finalized plant that are not anchored to the world, in the order of the SDF."""
    bodies = map(plant.get_body, plant.GetBodyIndices(base_body(plant).model_instance()))
    return (body for body in bodies if not plant.IsAnchored(body))


def parameter_axis(name: str) -> str:
    """Returns the axes in a name of `PARAMETER_NAMES`: "" for "m", "x" for "mcx", "xy" for "Ixy"."""
    return name.removeprefix("mc").removeprefix("m").removeprefix("I")


def pseudo_inertia(parameters: ArrayLike) -> NDArray[np.float64]:
    """Returns the pseudo-inertia (4, 4), a linear function of the inertial parameters (10,)."""
    m, hx, hy, hz, Ixx, Iyy, Izz, Ixy, Ixz, Iyz = np.asarray(parameters, float)
    half_trace = (Ixx + Iyy + Izz) / 2
    return np.array(
        [
            [half_trace - Ixx, -Ixy, -Ixz, hx],
            [-Ixy, half_trace - Iyy, -Iyz, hy],
            [-Ixz, -Iyz, half_trace - Izz, hz],
            [hx, hy, hz, m],
        ]
    )


def parameters_from_pseudo_inertia(J: ArrayLike) -> NDArray[np.float64]:
    """Returns the inertial parameters (10,) of a pseudo-inertia J (4, 4). This is the inverse of `pseudo_inertia`."""
    J = np.asarray(J, float)
    moments = np.trace(J[:3, :3]) - np.diag(J)[:3]
    return np.array([J[3, 3], *J[:3, 3], *moments, -J[0, 1], -J[0, 2], -J[1, 2]])


def change_of_frame(X_LF: RigidTransform) -> NDArray[np.float64]:
    """Returns the matrix (10, 10) that maps a body's parameters about Fo in frame F to those about Lo in frame L.

    A point of the body is (p_L, 1) = X_LF (p_F, 1), so the pseudo-inertia is J_L = X_LF J_F X_LF'.
    """
    X = X_LF.GetAsMatrix4()
    return np.column_stack([parameters_from_pseudo_inertia(X @ pseudo_inertia(unit) @ X.T) for unit in np.eye(10)])


@dataclass(frozen=True)
class RotorInertia:
    """Element of the rotor inertia matrix D in actuator coordinates.

    The joint torque due to the rotors is tau = J' D J vd, where J is the matrix of `arm.transmission`.

    Attributes:
        actuators: Names of the actuators of the row and the column of D. An actuator has the name of the joint in the
            same row of the transmission. Elements of D for two different actuators are artefacts of the SDF format,
            see `rotor_inertias`.
        value: Value according to the SDF [kg m^2; kg for a prismatic actuator].
    """

    actuators: tuple[str, str]
    value: float

    @property
    def name(self) -> str:
        """Name of the parameter, such as "rotor.wrist_yaw" or "rotor.wrist_pitch*wrist_yaw"."""
        a, b = self.actuators
        return f"rotor.{a}" if a == b else f"rotor.{a}*{b}"


def rotor_inertias(plant: MultibodyPlant, arm: Arm) -> tuple[RotorInertia, ...]:
    """Returns the rotor inertias according to `drake:rotor_inertia` and `drake:gear_ratio` in the SDF.

    The diagonal elements of all actuators come first, then the nonzero elements that couple two actuators. Drake adds
    gear^2 * inertia to the diagonal of the mass matrix in joint coordinates. If the transmission couples joints that
    have rotors, as in the wrist of an instrument, D is not diagonal. Real motors do not cause such coupling elements,
    so identification omits these elements. The value is 0 for a rotor that the SDF models as a link.
    """
    D_tree = np.zeros((len(arm.tree_joint_names),) * 2)
    for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        row = arm.tree_joint_names.index(actuator.joint().name())
        D_tree[row, row] += actuator.default_rotor_inertia() * actuator.default_gear_ratio() ** 2
    J_inverse = arm.transmission.inverse.matrix
    G = arm.linkage.matrix
    D = J_inverse.T @ (G.T @ D_tree @ G) @ J_inverse
    names = arm.joint_names
    diagonal = [RotorInertia((name, name), float(D[i, i])) for i, name in enumerate(names)]
    coupled = [
        RotorInertia((names[i], names[k]), float(D[i, k]))
        for i in range(len(names))
        for k in range(i + 1, len(names))
        if abs(D[i, k]) > 1e-12 * np.abs(D).max()
    ]
    return (*diagonal, *coupled)


def rotor_links(arm: Arm) -> set[str]:
    """Returns the links that represent balanced rotors: they carry nothing, and no DH frame marks them as a link.

    Only an SDF with DH frames can have such links. Their joint is revolute, and their centre of mass is on its axis, so
    their rotation does not change the torque of gravity.
    """
    plant = shared_plant(arm)
    framed = {frame.body().name() for frame in arm_frames(plant) if frame.name().startswith(DH_PREFIX)}
    if not framed:
        return set()
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    carriers = {joint.parent_body().name() for joint in joints}
    bodies = {body.name() for body in moving_bodies(plant)} - framed - carriers
    return {
        joint.child_body().name() for joint in joints if joint.child_body().name() in bodies and _is_balanced(joint)
    }


def _is_balanced(joint: Joint) -> bool:
    """Returns whether the centre of mass of the child is on the axis of a revolute joint, to 1e-9 m (rounding)."""
    if joint.type_name() != "revolute":
        return False
    X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    lever = joint.child_body().default_com() - X_CM.translation()
    return bool(np.linalg.norm(np.cross(lever, X_CM.rotation() @ joint.revolute_axis())) < 1e-9)
