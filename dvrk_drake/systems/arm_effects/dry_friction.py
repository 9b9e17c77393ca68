"""Effects of a real arm that are parts of its plant, first of all dry friction: elements of Drake's own solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, JointActuator, ModelInstanceIndex, PdControllerGains

from dvrk_drake.dynamics.actuator_effects import EFFECT_KINDS, ActuatorEffect, effect_fault
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import FRICTION_KINDS, ArmEffects, FrictionEffect
from dvrk_drake.systems.arm_effects.drive_joints import DriveJoints
from dvrk_drake.systems.ideal_drive import PlantJoints

#: Of the springs of presliding [s]: their damping over their stiffness. An arm that is hit rings for a moment, not for
#: minutes. Drake limits the sum of spring and damper to the element's coefficient, so sliding is the same.
RELAXATION = 0.02


@dataclass(frozen=True)
class Slider:
    """An elasto-plastic element in a finalized plant, a spring that gives way: an actuator with a gain and a limit.

    Attributes:
        code: of its kind, for `effect_step`.
        actuator: index among those of the instance.
        position: index of its joint's position in the plant.
        travel: of that joint until it slips [rad, m].
        fall_speed: at which it holds 1/e of that [rad/s, m/s]; 0 if it holds the same at all speeds.
        side: -1 if what its kind says of motion towards +x is of motion towards -x, else 1.
    """

    code: int
    actuator: int
    position: int
    travel: float
    fall_speed: float
    side: float

    @staticmethod
    def of(element: tuple[JointActuator, FrictionEffect, float], order: Sequence[object]) -> Slider:
        """Of one of `add_friction`'s elements, `order` being the indices of the instance's actuators."""
        actuator, effect, ratio = element
        side = 1.0 if effect.coefficient * ratio > 0 else -1.0
        return Slider(
            EFFECT_KINDS[effect.kind].code,
            order.index(actuator.index()),
            actuator.joint().position_start(),
            effect.scale / abs(ratio),
            effect.fall_speed / abs(ratio),
            side,
        )


def add_friction(
    plant: MultibodyPlant, arm: Arm, drive: DriveJoints, friction: Sequence[FrictionEffect]
) -> list[tuple[JointActuator, FrictionEffect, float]]:
    """Adds friction to a plant that is not finalized.

    The solver takes each element at the end of the step, so it takes energy in every step, whatever its stiffness:

    - "presliding" with coefficient c and scale s: effort -c clip((x - x_s + T v) / s, +-1), where x_s is what
      `DriveStep` says and T = `RELAXATION`: a spring that gives way. Below c it holds without creep. With a fall speed
      w it holds c exp(-(v/w)^2): Stribeck's, lost when it slides; T is 0, as its spring's force is all that it has.
    - "presliding forward": the same with 0 instead of -1: what friction towards +x has more than towards -x; with a
      negative coefficient the other way round. T is 0.
    - Where these two hold less than c, the hook comes two time steps h late and they act like viscous friction of
      2 h c / s, so give them a travel s well above 2 h v.
    - "coulomb": -c clip(v / s, +-1); the smoothed sign of an identification. It creeps below c, at a speed up to s.
    - "viscous": -c v.

    Returns:
        what needs a `DriveStep`: actuator of the plant, its effect, and coordinate over the actuator's joint.

    Raises:
        StationError: an effect that the arm cannot have.
    """
    followed = []
    for i, effect in enumerate(friction):
        law = ActuatorEffect.of(effect)
        if fault := effect_fault(arm, law, FRICTION_KINDS):
            raise StationError(f"{arm.name}: effects.friction[{i}]: {fault}")
        if effect.coefficient == 0:
            continue
        joint, ratio = drive.along(effect.coordinate)
        size = abs(effect.coefficient)
        if effect.kind == "viscous":
            _add_damping(joint, size * ratio**2)
            continue
        actuator = plant.AddJointActuator(f"friction_{i}", joint, size * abs(ratio))
        _copy_rotor(plant, actuator)
        slope = size / effect.scale * ratio**2
        if effect.kind == "coulomb":
            actuator.set_controller_gains(PdControllerGains(p=0.0, d=slope))
            continue
        plain = effect.kind == "presliding" and not effect.fall_speed
        actuator.set_controller_gains(PdControllerGains(p=slope, d=RELAXATION * slope if plain else 0.0))
        followed.append((actuator, effect, ratio))
    return followed


def _copy_rotor(plant: MultibodyPlant, actuator: JointActuator) -> None:
    """Of several actuators on a joint Drake takes only the last one's rotor inertia (1.51 to 1.58): say it again."""
    for index in plant.GetJointActuatorIndices():
        motor = plant.get_joint_actuator(index)
        if motor.joint().index() == actuator.joint().index() and motor.default_rotor_inertia() > 0:
            actuator.set_default_rotor_inertia(motor.default_rotor_inertia())
            actuator.set_default_gear_ratio(motor.default_gear_ratio())


def _add_damping(joint: Joint, damping: float) -> None:
    joint.set_default_damping_vector(joint.default_damping_vector() + damping)


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
