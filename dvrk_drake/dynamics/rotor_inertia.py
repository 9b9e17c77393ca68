"""What the motors' rotors add to an arm's inertia, in actuator coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.dynamics.inertial_parameters import moving_bodies
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant


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
        """Such as "rotor.wrist_yaw", "rotor.wrist_pitch*wrist_yaw"."""
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
    J_inverse = arm.transmission.inverse().matrix
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
    plant = make_arm_plant(arm)
    frames = [plant.get_frame(i) for i in plant.GetFrameIndices(plant.GetBodyByName("base_link").model_instance())]
    framed = {frame.body().name() for frame in frames if frame.name().startswith("dh_")}
    return {body.name() for body in moving_bodies(plant)} - framed
