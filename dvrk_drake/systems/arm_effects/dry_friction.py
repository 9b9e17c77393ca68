"""Effects that Drake's solver computes, mainly dry friction, and the joints of a plant on which they act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Joint,
    JointActuator,
    ModelInstanceIndex,
    PdControllerGains,
    RevoluteJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
)

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault, joint_row
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_KINDS, FRICTION_KINDS, ArmEffects, FrictionEffect
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions, tree_selector
from dvrk_drake.systems.ideal_drive import PlantJoints, plant_config_fault

#: Inertia of each added body, as a fraction of the arm's inertia along the coordinate. Mass of each added body [kg].
#: Drake limits the stiffness of a constraint. The limit depends on the lighter body and on the time step. At the
#: parallelogram of an MTM, an effort of 3 N m therefore causes a deflection of 1 mrad.
SHARE, MASS = 2e-3, 1e-6
#: Distance from the axis at which coupled bodies are constrained [m].
RADIUS = 0.1


class DriveJoints:
    """Finds or creates the joint for a coordinate of the drive, in a plant before Finalize.

    The coordinate is x = row @ q with a constant `row` (n,) and the joint positions q (n,). If x is proportional to the
    position of one joint, that joint is used. If x depends on several joints, a body with its own joint is added. The
    position of this joint is x. The body is coupled in one of two ways:

    - to a link that rotates by x about the same axis, e.g. the crank of the parallelogram relative to the yaw link,
    - otherwise to the last body of a chain that begins at the world. Each body of the chain rotates relative to the
      previous body by the contribution of one joint to x.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex) -> None:
        """Creates the object for the `arm` that `add_arm` added to `plant` as `instance`."""
        self._plant, self._arm, self._instance = plant, arm, instance
        self._added: list[tuple[Joint, NDArray[np.float64]]] = []

    def joint_of_coordinate(self, coordinate: str) -> tuple[Joint, float]:
        """Returns the joint of a named coordinate of the drive, and the factor from joint position to coordinate."""
        return self.joint(joint_row(self._arm, coordinate))

    def joint(self, row: NDArray[np.float64]) -> tuple[Joint, float]:
        """Returns the joint of x = row @ q, and the factor that converts the position of the joint to x."""
        terms = np.flatnonzero(np.abs(row) > 1e-12)
        if len(terms) == 1:
            (i,) = terms
            return self._plant.GetJointByName(self._arm.joint_names[i], self._instance), float(row[i])
        for joint, known in self._added:
            if np.allclose(known, row, atol=1e-12):
                return joint, 1.0
        joint = self._coaxial(row) or self._chain(row)
        self._added.append((joint, row))
        return joint, 1.0

    def set_positions(self, q_plant: NDArray[np.float64], q: ArrayLike) -> None:
        """Writes the positions of the added joints at the pose q (n,) into `q_plant` (nq,)."""
        q = np.asarray(q, float)
        for i, (joint, row) in enumerate(self._added):
            q_plant[joint.position_start()] = row @ q
            for k in np.flatnonzero(row):
                name = _chain_name(i, self._arm.joint_names[k])
                if self._plant.HasJointNamed(name, self._instance):
                    q_plant[self._plant.GetJointByName(name, self._instance).position_start()] = row[k] * q[k]

    def _coaxial(self, row: NDArray[np.float64]) -> Joint | None:
        """Returns a new joint for x = row @ q if x is the sum of the angles of coaxial joints, otherwise None."""
        plant, names = self._plant, self._arm.tree_joint_names
        above = {plant.GetJointByName(name, self._instance).child_body().index(): name for name in names}
        for name in names:
            last = joint = plant.GetJointByName(name, self._instance)
            total, along = np.zeros_like(row), np.zeros(3)
            while isinstance(joint, RevoluteJoint):
                sign = float(joint.revolute_axis() @ last.revolute_axis())
                if abs(abs(sign) - 1.0) > 1e-12:
                    break
                total = total + sign * self._arm.linkage.matrix[names.index(joint.name())]
                if np.allclose(total, row, atol=1e-12):
                    origin = _offset(joint.frame_on_parent()) + along
                    return self._add_coaxial_joint(row, joint.parent_body(), origin, last)
                parent = joint.parent_body()
                if parent.index() not in above:
                    break
                upper = plant.GetJointByName(above[parent.index()], self._instance)
                step = _offset(joint.frame_on_parent()) - _offset(upper.frame_on_child())
                if np.linalg.norm(np.cross(step, last.revolute_axis())) > 1e-9:
                    break
                along, joint = along + step, upper
        return None

    def _add_coaxial_joint(
        self,
        row: NDArray[np.float64],
        parent: RigidBody,
        p_PR: NDArray[np.float64],
        last: RevoluteJoint,
    ) -> Joint:
        """Adds a body and its joint about the axis of `last`. Returns the joint.

        Args:
            row: Row (n,) of the coordinate.
            parent: Parent body P of the joint.
            p_PR: Position (3,) of the joint in P [m].
            last: Last of the coaxial joints.
        """
        plant, name = self._plant, f"drive_{len(self._added)}"
        body = self._body(name, row)
        frame = plant.AddFrame(FixedOffsetFrame(f"{name}_base", parent, RigidTransform(p_PR)))
        joint = plant.AddJoint(RevoluteJoint(name, frame, body.body_frame(), last.revolute_axis()))
        self._couple_rotation(last.child_body(), _offset(last.frame_on_child()), body, last.revolute_axis())
        return joint

    def _chain(self, row: NDArray[np.float64]) -> Joint:
        plant, i = self._plant, len(self._added)
        axis, end = np.array([0.0, 0.0, 1.0]), plant.world_body()
        for k in np.flatnonzero(row):
            leader = self._arm.joint_names[k]
            body = self._body(_chain_name(i, leader), row)
            link = RevoluteJoint(_chain_name(i, leader), end.body_frame(), body.body_frame(), axis)
            follower = plant.AddJoint(link)
            plant.AddCouplerConstraint(follower, plant.GetJointByName(leader, self._instance), float(row[k]))
            end = body
        body = self._body(f"drive_{i}", row)
        joint = plant.AddJoint(RevoluteJoint(f"drive_{i}", plant.world_frame(), body.body_frame(), axis))
        self._couple_rotation(end, np.zeros(3), body, axis)
        return joint

    def _couple_rotation(
        self, A: RigidBody, p_AAxis: NDArray[np.float64], B: RigidBody, axis: NDArray[np.float64]
    ) -> None:
        """Couples the rotations of A and B about a common axis by a rigid rod between them.

        Seen along the axis, the ends of the rod on A and B are 90 degrees apart. Only the compliance of Drake's solver
        remains.
        """
        e = np.eye(3)[np.argmin(np.abs(axis))]
        f = np.cross(axis, e)
        p_AP, p_BQ = p_AAxis + RADIUS * e, RADIUS * f
        self._plant.AddDistanceConstraint(A, p_AP, B, p_BQ, float(np.sqrt(2.0)) * RADIUS)

    def _body(self, name: str, row: NDArray[np.float64]) -> RigidBody:
        about_axis = SHARE / float(row @ np.linalg.solve(_mass_matrix(self._arm), row))
        M_BBo_B = SpatialInertia.MakeFromCentralInertia(MASS, np.zeros(3), RotationalInertia(*np.full(3, about_axis)))
        return self._plant.AddRigidBody(name, self._instance, M_BBo_B)


@cache
def _mass_matrix(arm: Arm) -> NDArray[np.float64]:
    """Returns the mass matrix (n, n) with all joints in the middle of their ranges."""
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, 0.5 * (arm.position_lower + arm.position_upper))
    tree = tree_selector(plant, arm)
    M: NDArray[np.float64] = plant.CalcMassMatrix(context)[np.ix_(tree, tree)]
    G = arm.linkage.matrix
    return G.T @ M @ G


def _chain_name(i: int, leader: str) -> str:
    return f"drive_{i}_{leader}"


def _offset(frame: FixedOffsetFrame) -> NDArray[np.float64]:
    p: NDArray[np.float64] = frame.GetFixedPoseInBodyFrame().translation()
    return p


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
