"""Friction along the coordinates of an arm's drive, as elements of Drake's own solver."""

from __future__ import annotations

from dataclasses import dataclass

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, JointActuator, PdControllerGains

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault, joint_row
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import FRICTION_KINDS, DriveEffect
from dvrk_drake.systems.real_arm.drive_joints import DriveJoints

#: Of the springs of presliding [s]: their damping over their stiffness. An arm that is hit rings for a moment, not for
#: minutes. Drake limits the sum of spring and damper to the element's coefficient, so sliding is the same.
RELAXATION = 0.02


@dataclass(frozen=True)
class Slider:
    """An elasto-plastic element in the plant: an actuator with a position gain and an effort limit.

    Attributes:
        actuator: of the plant.
        travel: of the actuator's joint until it slips [rad, m].
    """

    actuator: JointActuator
    travel: float


def add_friction(
    plant: MultibodyPlant, arm: Arm, drive: DriveJoints, friction: list[DriveEffect]
) -> tuple[Slider, ...]:
    """Adds friction to a plant that is not finalized; the sliders need a `SlipFollower`.

    The solver takes each element at the end of the step, so it takes energy in every step, whatever its stiffness:

    - "presliding" with coefficient c and scale s: effort -c clip((x - x_s + T v) / s, +-1), where x_s is what the
      `SlipFollower` says and T = `RELAXATION`: a spring that gives way. Below c it holds without creep.
    - "coulomb": -c clip(v / s, +-1); the smoothed sign of an identification. It creeps below c, at a speed up to s.
    - "viscous": -c v.

    Raises:
        StationError: an effect that the arm cannot have.
    """
    sliders = []
    for i, effect in enumerate(friction):
        law = ActuatorEffect(effect.coordinate, effect.kind, effect.scale)
        if fault := effect_fault(arm, law, FRICTION_KINDS):
            raise StationError(f"{arm.name}: effects.friction[{i}]: {fault}")
        if effect.coefficient == 0:
            continue
        joint, ratio = drive.joint(joint_row(arm, effect.coordinate))
        if effect.kind == "viscous":
            _add_damping(joint, effect.coefficient * ratio**2)
            continue
        limit, slope = effect.coefficient * abs(ratio), effect.coefficient / effect.scale * ratio**2
        actuator = plant.AddJointActuator(f"friction_{i}", joint, limit)
        _copy_rotor(plant, actuator)
        if effect.kind == "coulomb":
            actuator.set_controller_gains(PdControllerGains(p=0.0, d=slope))
        else:
            actuator.set_controller_gains(PdControllerGains(p=slope, d=RELAXATION * slope))
            sliders.append(Slider(actuator, effect.scale / abs(ratio)))
    return tuple(sliders)


def _copy_rotor(plant: MultibodyPlant, actuator: JointActuator) -> None:
    """Of several actuators on a joint Drake takes only the last one's rotor inertia (1.51 to 1.58): say it again."""
    for index in plant.GetJointActuatorIndices():
        motor = plant.get_joint_actuator(index)
        if motor.joint().index() == actuator.joint().index() and motor.default_rotor_inertia() > 0:
            actuator.set_default_rotor_inertia(motor.default_rotor_inertia())
            actuator.set_default_gear_ratio(motor.default_gear_ratio())


def _add_damping(joint: Joint, damping: float) -> None:
    joint.set_default_damping_vector(joint.default_damping_vector() + damping)
