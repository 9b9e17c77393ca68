"""Inertial parameters of links and rotors, in which the equations of motion are linear."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody, SpatialInertia, UnitInertia

from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import shared_plant

#: In this order everywhere; units kg, kg m, kg m^2.
PARAMETER_NAMES = ("m", "mcx", "mcy", "mcz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")


@dataclass(frozen=True, eq=False)
class LinkInertia:
    """M_LLo_L: the inertia of one link L about the origin Lo of its frame in the SDF, expressed in L.

    Attributes:
        link: name of the body in the SDF.
        parameters: (10,) m [kg], m c = m p_LoLcm_L [kg m], then Ixx, Iyy, Izz, Ixy, Ixz, Iyz about Lo [kg m^2], the
            products with the sign of the rotational inertia matrix: Ixy = -integral x y dm.
    """

    link: str
    parameters: NDArray[np.float64]

    def pseudo_inertia(self) -> NDArray[np.float64]:
        """(4, 4) integral of (p, 1)(p, 1)' dm, positive definite for every body that has a volume.

        Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
        identification" (2018), equation 10.
        """
        return pseudo_inertia(self.parameters)

    @classmethod
    def from_spatial_inertia(cls, link: str, M_LLo_L: SpatialInertia) -> LinkInertia:
        """The parameters of Drake's spatial inertia of a link about its own origin."""
        mass, I_LLo_L = M_LLo_L.get_mass(), M_LLo_L.CalcRotationalInertia()
        moments, products = I_LLo_L.get_moments(), I_LLo_L.get_products()
        return cls(link, np.concatenate([[mass], mass * M_LLo_L.get_com(), moments, products]))

    def to_spatial_inertia(self) -> SpatialInertia:
        """M_LLo_L for Drake.

        Raises:
            ModelError: the mass is not positive, or Drake finds that no body has this inertia.
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
    """Returns all moving links of the arm, including linkage and instrument, with the inertias of the SDF."""
    return tuple(
        LinkInertia.from_spatial_inertia(body.name(), body.default_spatial_inertia())
        for body in moving_bodies(shared_plant(arm))
    )


def moving_bodies(plant: MultibodyPlant) -> Iterator[RigidBody]:
    """Returns the bodies of a finalized plant that are not anchored to the world, in the order of the SDF."""
    bodies = (
        plant.get_body(index) for index in plant.GetBodyIndices(plant.GetBodyByName("base_link").model_instance())
    )
    return (body for body in bodies if not plant.IsAnchored(body))


def parameter_axis(name: str) -> str:
    """The axes in a name of `PARAMETER_NAMES`: "" of m, "x" of mcx, "xy" of Ixy."""
    return name.removeprefix("mc").removeprefix("m").removeprefix("I")


def pseudo_inertia(parameters: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) pseudo-inertia of ten inertial parameters (10,), linear in them."""
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
    """(10,) inertial parameters of a symmetric (4, 4) pseudo-inertia: the inverse of `pseudo_inertia`."""
    J = np.asarray(J, float)
    moments = np.trace(J[:3, :3]) - np.diag(J)[:3]
    return np.array([J[3, 3], *J[:3, 3], *moments, -J[0, 1], -J[0, 2], -J[1, 2]])


def change_of_frame(X_LF: RigidTransform) -> NDArray[np.float64]:
    """(10, 10) T with parameters_L = T parameters_F: those of a body in frame F, re-expressed in L about Lo.

    A point of the body is (p_L, 1) = X_LF (p_F, 1), so its pseudo-inertia is X_LF J_F X_LF'.
    """
    X = X_LF.GetAsMatrix4()
    return np.column_stack([parameters_from_pseudo_inertia(X @ pseudo_inertia(unit) @ X.T) for unit in np.eye(10)])


@dataclass(frozen=True)
class RotorInertia:
    """One entry of the symmetric matrix D with tau = J' D J vd, where a = J q are the actuators' positions.

    Attributes:
        actuators: (a, b), a the name of the joint that the actuator has its own row in `arm.transmission`; b = a for
            the inertia that rotor a has [kg m^2 per rad of the actuator; kg of a prismatic one]. Motors have no entry
            with b != a: it is there because an SDF can only state rotors joint by joint (see `rotor_inertias`).
        value: what the SDF states.
    """

    actuators: tuple[str, str]
    value: float

    @property
    def name(self) -> str:
        """Name of the parameter, such as "rotor.wrist_yaw", "rotor.wrist_pitch*wrist_yaw"."""
        a, b = self.actuators
        return f"rotor.{a}" if a == b else f"rotor.{a}*{b}"


def rotor_inertias(plant: MultibodyPlant, arm: Arm) -> tuple[RotorInertia, ...]:
    """The rotors as the SDF's `drake:rotor_inertia` and `drake:gear_ratio` state them: one for every actuator.

    Drake adds gear^2 * inertia to the diagonal of the mass matrix, in joint coordinates. Where the transmission couples
    joints that have rotors (the PSM's wrist), that is no diagonal in actuator coordinates, and the entries that couple
    two actuators follow: without them the sum of all columns would not be the plant's. An identification leaves their
    columns out. A rotor that the SDF models as a link is among the links, and its value here is 0.
    """
    D_tree = np.zeros((len(arm.tree_joint_names),) * 2)
    for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        row = arm.tree_joint_names.index(actuator.joint().name())
        D_tree[row, row] += actuator.default_rotor_inertia() * actuator.default_gear_ratio() ** 2
    J_inverse = arm.transmission.inverse.matrix
    G = arm.linkage.matrix
    D = J_inverse.T @ (G.T @ D_tree @ G) @ J_inverse
    names = arm.joint_names
    alone = [RotorInertia((name, name), float(D[i, i])) for i, name in enumerate(names)]
    coupled = [
        RotorInertia((names[i], names[k]), float(D[i, k]))
        for i in range(len(names))
        for k in range(i + 1, len(names))
        if abs(D[i, k]) > 1e-12 * np.abs(D).max()
    ]
    return (*alone, *coupled)


def rotor_links(arm: Arm) -> set[str]:
    """Links of the SDF that are rotors, balanced about their own axis: those that have no frame dh_<name>."""
    plant = shared_plant(arm)
    frames = [plant.get_frame(i) for i in plant.GetFrameIndices(plant.GetBodyByName("base_link").model_instance())]
    framed = {frame.body().name() for frame in frames if frame.name().startswith("dh_")}
    return {body.name() for body in moving_bodies(plant)} - framed
