"""The effects of a real arm that are parts of its plant: friction and hard stops."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.systems.real_arm.drive_joints import DriveJoints
from dvrk_drake.systems.real_arm.dry_friction import add_friction
from dvrk_drake.systems.real_arm.slip_follower import SlipFollower


class PlantEffects:
    """Adds them to a plant that is not finalized, and afterwards what they need beside it.

    Attributes:
        drive: the joints that were added for coordinates of the drive.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex, effects: ArmEffects) -> None:
        """Of the `arm` that `add_arm` added to `plant` as `instance`; `friction` and `stops` count.

        Raises:
            StationError: a coordinate that the arm's drive has not.
        """
        self.drive = DriveJoints(plant, arm, instance)
        self._plant, self._instance = plant, instance
        self._sliders = add_friction(plant, arm, self.drive, effects.friction)
        # Drake disarms the gains of all of an instance's actuators while their desired state is not connected.
        self._rubs = any(effect.kind != "viscous" for effect in effects.friction)
        if effects.stops:
            rows, lower, upper = arm.limit_matrix()
            for i in range(arm.num_joints, len(rows)):
                joint, ratio = self.drive.joint(rows[i])
                ends = np.sort([lower[i] / ratio, upper[i] / ratio])
                joint.set_position_limits(ends[:1], ends[1:])

    def connect(self, builder: DiagramBuilder) -> None:
        """Adds what the sliders need to the diagram of the plant, which is finalized by now."""
        if not self._rubs:
            return
        plant = self._plant
        follower = SlipFollower(plant, self._instance, self._sliders, plant.time_step())
        builder.AddNamedSystem("slip_follower", follower)
        builder.Connect(plant.get_state_output_port(), follower.get_input_port())
        builder.Connect(follower.get_output_port(), plant.get_desired_state_input_port(self._instance))
