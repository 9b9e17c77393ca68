"""Where the joints and motors of an arm are among those of its plant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuator, ModelInstanceIndex

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import tree_selector


class PlantJoints:
    """The independent joints of an arm in a finalized plant, in the arm's order.

    Attributes:
        index: (n,) into the plant's q and v.
        selection: (nv, n) efforts on the joints to efforts on the plant; its transpose picks their positions.
        actuators: of the arm's instance, in Drake's order.
        actuation: (len(actuators), n) efforts of the joints' motors to those of all actuators. Others, massless rotors
            that ride on a linkage, get zero: their inertia is all they are for.
        effort_limits: (n,) of the joints' motors [N m, N].
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex) -> None:
        """Of the `arm` that `add_arm` added to `plant` as `instance`.

        Raises:
            StationError: a floating body, or a joint without a motor.
        """
        if plant.num_positions() != plant.num_velocities():
            raise StationError("modify_plant must not add floating bodies: weld them to the arm")
        names = list(arm.tree_joint_names)
        tree, n = tree_selector(plant, arm, instance), arm.num_joints
        self.index: NDArray[np.int_] = tree[[names.index(joint) for joint in arm.joint_names]]
        self.selection = np.zeros((plant.num_velocities(), n))
        self.selection[self.index, range(n)] = 1.0
        self.actuators: list[JointActuator] = [
            plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)
        ]
        driven = [actuator.joint().name() for actuator in self.actuators]
        if undriven := [joint for joint in arm.joint_names if joint not in driven]:
            raise StationError(f"{' '.join(arm.sdf)}: joint {', '.join(undriven)} has no <effort>, so no motor")
        columns = [driven.index(joint) for joint in arm.joint_names]
        self.actuation = np.zeros((len(self.actuators), n))
        self.actuation[columns, range(n)] = 1.0
        self.effort_limits = np.array([self.actuators[i].effort_limit() for i in columns])
