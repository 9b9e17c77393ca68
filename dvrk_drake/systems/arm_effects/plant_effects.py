"""The effects of a real arm that are parts of its plant: friction, hard stops and cables that stretch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.systems.arm_effects.drive_joints import DriveJoints
from dvrk_drake.systems.arm_effects.dry_friction import Slider, add_friction
from dvrk_drake.systems.plant_joints import PlantJoints


class PlantEffects:
    """Adds them to a plant that is not finalized, and says afterwards where they are in it.

    Attributes:
        drive: the joints that were added for coordinates of the drive.
        to_actuators: (n, nq) positions of the plant to those of the arm's actuators; after `finish`.
        from_motors: (nv, n) efforts of the motors to those on the plant; after `finish`.
        joint_index: (n,) of the joints in the plant's q and v; after `finish`.
        sliders: friction that follows; after `finish`.
        num_actuators: of the plant's instance; after `finish`.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex, effects: ArmEffects) -> None:
        """Of the `arm` that `add_arm` added to `plant` as `instance`; `friction`, `stops` and `stretch` count.

        Raises:
            StationError: an effect that the arm cannot have.
        """
        self._plant, self._arm = plant, arm
        self.drive = DriveJoints(plant, arm, instance)
        for actuator, cable in effects.stretch.items():
            self.drive.add_motor(actuator, cable)
        self._elements = add_friction(plant, arm, self.drive, effects.friction)
        # Drake disarms the gains of all of an instance's actuators while their desired state is not connected.
        self.needs_desired_state = any(effect.kind != "viscous" for effect in effects.friction)
        if effects.stops:
            rows, lower, upper = arm.limit_matrix()
            for i in range(arm.num_joints, len(rows)):
                joint, ratio = self.drive.joint(rows[i])
                ends = np.sort([lower[i] / ratio, upper[i] / ratio])
                joint.set_position_limits(ends[:1], ends[1:])

    @property
    def time_step(self) -> float:
        """Of the plant [s]."""
        step: float = self._plant.time_step()
        return step

    def finish(self, joints: PlantJoints) -> None:
        """To be called when the plant is finalized."""
        order = [actuator.index() for actuator in joints.actuators]
        self.num_actuators = len(order)
        self.sliders = [Slider.of(element, order) for element in self._elements]
        J = self._arm.transmission.matrix
        self.to_actuators: NDArray[np.float64] = np.ascontiguousarray(J @ joints.selection.T)
        self.from_motors: NDArray[np.float64] = np.ascontiguousarray(joints.selection @ J.T)
        self.joint_index = joints.index
        for i, name in enumerate(self._arm.joint_names):
            if (motor := self.drive.motors.get(name)) is not None:
                own = np.eye(self._plant.num_positions())[motor.joint().position_start()]
                self.to_actuators[i] = self.from_motors[:, i] = own
