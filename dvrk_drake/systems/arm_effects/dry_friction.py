"""Effects that Drake's solver computes, mainly dry friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import Joint, JointActuator, ModelInstanceIndex, PdControllerGains

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, FRICTION_KINDS, ArmEffects, FrictionEffect
from dvrk_drake.systems.arm_effects.drive_joints import DriveJoints
from dvrk_drake.systems.ideal_drive import PlantJoints, plant_config_fault

#: Relaxation time of the presliding springs [s], i.e. damping divided by stiffness. The damping reduces oscillations
#: after an impact. Drake limits the sum of spring effort and damper effort to the friction coefficient. The damping
#: therefore does not change sliding friction.
RELAXATION = 0.02


@dataclass(frozen=True)
class Slider:
    """Elasto-plastic friction element in a finalized plant. It is an actuator with a gain and an effort limit.

    Attributes:
        code: Code of the kind of friction, for `effect_step`.
        actuator: Index of the actuator in the model instance.
        position: Index of the joint's position in the q of the model instance.
        travel: Travel of the joint until the element slips [rad, m].
        fall_speed: Speed at which the slip limit is 1/e of the slip limit at rest [rad/s, m/s]; 0 for a constant slip
            limit.
        side: -1 if the directions +x and -x are exchanged, otherwise 1.
    """

    code: int
    actuator: int
    position: int
    travel: float
    fall_speed: float
    side: float

    @staticmethod
    def from_element(element: tuple[JointActuator, FrictionEffect, float], joints: PlantJoints) -> Slider:
        """Creates the slider of an element that `add_friction` returned.

        Args:
            element: Actuator, effect, and ratio of the coordinate to the position of the actuator's joint.
            joints: Joints of the arm in the plant.
        """
        actuator, effect, ratio = element
        side = 1.0 if effect.coefficient * ratio > 0 else -1.0
        return Slider(
            EFFECT_KINDS[effect.kind].code,
            [other.index() for other in joints.actuators].index(actuator.index()),
            joints.position_index(actuator.joint()),
            effect.scale / abs(ratio),
            effect.fall_speed / abs(ratio),
            side,
        )


def add_friction(
    plant: MultibodyPlant, arm: Arm, drive: DriveJoints, friction: Sequence[FrictionEffect]
) -> list[tuple[JointActuator, FrictionEffect, float]]:
    """Adds friction to a plant that is not finalized.

    The solver evaluates each element at the end of the step. The element therefore dissipates energy in every step, for
    any stiffness. The kinds of friction are listed below, where c is the coefficient, s the scale, x the value of the
    coordinate, and v the rate of x.

    - "presliding": effort -c clip((x - x_s + T v) / s, -1, 1). x_s is the anchor from `DriveStep`, and T is
      `RELAXATION`. If the applied effort is below c, the joint sticks without creep. With a fall speed w, the limit of
      the effort is c exp(-(v/w)^2) (Stribeck friction). T is then 0, because this limit applies only to the spring.
    - "presliding forward": as "presliding" with the limits 0 and 1 and T = 0. It represents the additional friction in
      the direction +x, compared with -x. A negative coefficient exchanges the directions.
    - "coulomb": effort -c clip(v / s, -1, 1). The clip is a smoothed sign function, as in the identification. If the
      applied effort is below c, the joint creeps with a speed of up to s.
    - "viscous": effort -c v.

    While the limit of a presliding element is below c, its anchor has a delay of two time steps h. This delay acts like
    viscous friction with the coefficient 2 h c / s. Choose a scale s well above 2 h v, where v is the sliding speed.

    Returns:
        Elements that need a `DriveStep`: actuator in the plant, effect, and ratio of the coordinate to the position of
        the actuator's joint.

    Raises:
        StationError: An effect is not valid for this arm.
    """
    followed = []
    for i, effect in enumerate(friction):
        law = ActuatorEffect.of(effect)
        if fault := effect_fault(arm, law, FRICTION_KINDS):
            raise StationError(f"{arm.name}: effects.friction[{i}]: {fault}")
        if effect.coefficient == 0:
            continue
        joint, ratio = drive.joint_of_coordinate(effect.coordinate)
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
    """Copies the rotor inertia of the joint to a new actuator.

    Drake uses only the rotor inertia of the last actuator of a joint (1.51 to 1.58).
    """
    for index in plant.GetJointActuatorIndices():
        motor = plant.get_joint_actuator(index)
        if motor.joint().index() == actuator.joint().index() and motor.default_rotor_inertia() > 0:
            actuator.set_default_rotor_inertia(motor.default_rotor_inertia())
            actuator.set_default_gear_ratio(motor.default_gear_ratio())


def _add_damping(joint: Joint, damping: float) -> None:
    joint.set_default_damping_vector(joint.default_damping_vector() + damping)


class PlantEffects:
    """Friction and stops of an arm in a plant, which may contain other arms and objects.

    Create it before the plant is finalized, and give it to `add_arm_drive`, which adds the other effects.

    Attributes:
        plant: Plant with the arm.
        arm: The arm.
        instance: Model instance of the arm.
        effects: All effects of the arm.
        drive: Joints of the coordinates of the drive.
        home: Pose (n,) [rad, m] of the arm before a pose is set; after `finish`.
        to_actuators: Matrix (n, nq) from positions of the instance to positions of the arm's actuators; after `finish`.
        from_motors: Matrix (nv, n) from motor efforts to generalized forces of the plant; after `finish`.
        sliders: Friction elements with a moving anchor; after `finish`.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
        >>> from pydrake.systems.framework import DiagramBuilder
        >>> builder, arm = DiagramBuilder(), dvrk.load_arm("mtml")
        >>> config = MultibodyPlantConfig(time_step=1e-3, use_sampled_output_ports=False)
        >>> plant, scene_graph = AddMultibodyPlant(config, builder)
        >>> mtml = dvrk.add_arm(plant, arm)
        >>> effects = dvrk.PlantEffects(plant, arm, mtml, arm.effects.only(["friction", "encoder"]))
        >>> plant.Finalize()
        >>> drive = dvrk.add_arm_drive(builder, plant, arm, mtml, effects)
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex, effects: ArmEffects) -> None:
        """Adds the effects `friction` and `stops` to the plant.

        Args:
            plant: Plant that is not finalized. A command acts after its measurement only if the sampled output ports of
                the plant are disabled.
            arm: Arm that `add_arm` added to the plant.
            instance: Model instance that `add_arm` returned.
            effects: Effects of the arm, e.g. `arm.effects` or `arm.effects.only(["friction"])`.

        Raises:
            StationError: An effect is not valid for this arm, or the plant has no discrete time step of up to 10 ms, or
                sampled output ports.
        """
        sampled = plant.has_sampled_output_ports()
        if fault := plant_config_fault(
            MultibodyPlantConfig(time_step=plant.time_step(), use_sampled_output_ports=sampled)
        ):
            raise StationError(fault)
        self.plant, self.arm, self.instance, self.effects = plant, arm, instance, effects
        self.drive = DriveJoints(plant, arm, instance)
        self._elements = add_friction(plant, arm, self.drive, effects.friction)
        # Drake disables the gains of all actuators of an instance while their desired state is not connected.
        self.needs_desired_state = any(effect.kind != "viscous" for effect in effects.friction)
        if effects.stops:
            rows, lower, upper = arm.limit_matrix()
            for i in range(arm.num_joints, len(rows)):
                joint, ratio = self.drive.joint(rows[i])
                ends = np.sort([lower[i] / ratio, upper[i] / ratio])
                joint.set_position_limits(ends[:1], ends[1:])

    def finish(self, joints: PlantJoints) -> None:
        """Computes the matrices and the default pose. Must be called after the plant is finalized."""
        plant, J = self.plant, self.arm.transmission.matrix
        self.sliders = [Slider.from_element(element, joints) for element in self._elements]
        self.home: NDArray[np.float64] = plant.GetDefaultPositions(self.instance)[joints.index]
        q_plant = plant.GetDefaultPositions()
        self.drive.set_positions(q_plant, self.home)
        plant.SetDefaultPositions(q_plant)
        self.to_actuators: NDArray[np.float64] = np.ascontiguousarray(J @ joints.selection.T)
        self.from_motors: NDArray[np.float64] = np.zeros((plant.num_velocities(), self.arm.num_joints))
        self.from_motors[joints.velocity_index] = J.T
