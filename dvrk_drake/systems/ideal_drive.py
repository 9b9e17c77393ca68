"""Ideal drive of an arm in a plant: the commanded effort acts without friction, and measurements are exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import Joint, JointActuator, ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import Adder, MatrixGain, PassThrough, Saturation
from scipy.linalg import block_diag

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm


def plant_config_fault(config: MultibodyPlantConfig) -> str:
    """Returns the reason why a configuration is not valid for the plant of an arm with effects, or ""."""
    if not 0 < config.time_step <= 0.01:
        return (
            f"time_step must be above 0 and at most 0.01 s (the wrist is unstable with larger steps); "
            f"got {config.time_step}"
        )
    if config.discrete_contact_approximation == "tamsi":
        return 'discrete_contact_approximation is "tamsi"; a linkage needs sap, similar or lagged'
    # Drake ends the process for some of these values.
    if min(config.penetration_allowance, config.stiction_tolerance) <= 0 or config.sap_near_rigid_threshold < 0:
        return "penetration_allowance and stiction_tolerance must be above 0, sap_near_rigid_threshold at least 0"
    if config.use_sampled_output_ports:
        # With sampled output ports, Drake steps the plant before all discrete updates. The discrete updates would then
        # use measurements from after the step.
        return "use_sampled_output_ports must be false, so that a command acts after its measurement"
    return ""


class PlantJoints:
    """Independent joints of an arm in a finalized plant, in the arm's order.

    The plant may contain other arms and objects. q and v of the arm's model instance have the same order.

    Attributes:
        index: Indices (n,) of the joints in the q and the v of the instance.
        velocity_index: Indices (n,) of the joints in the v of the plant.
        selection: Matrix (nq, n), whose transpose selects the joints from the q or the v of the instance.
        actuators: Actuators of the instance, in Drake's order.
        actuation: Matrix (len(actuators), n) from joint efforts to efforts of all actuators. Actuators that do not
            drive an independent joint only represent rotor inertia. Their effort is zero.
        effort_limits: Effort limits (n,) [N m, N] of the joints' motors.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex) -> None:
        """Finds the joints of `arm` in `plant`. `add_arm` added the arm as the model instance `instance`.

        Raises:
            StationError: A joint has no motor, or the instance has a floating body.
        """
        if plant.num_positions(instance) != plant.num_velocities(instance):
            name = plant.GetModelInstanceName(instance)
            raise StationError(f"{name}: the model instance of an arm has a floating body. Weld it, or use another one")
        self._instance_positions = plant.GetPositionsFromArray(instance, np.arange(plant.num_positions())).tolist()
        joints = [plant.GetJointByName(joint, instance) for joint in arm.joint_names]
        self.index = np.array([self.position_index(joint) for joint in joints])
        self.velocity_index = np.array([joint.velocity_start() for joint in joints])
        self.selection = np.eye(len(self._instance_positions))[:, self.index]
        self.actuators: list[JointActuator] = [
            plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)
        ]
        driven = [actuator.joint().name() for actuator in self.actuators]
        if without_motor := [joint for joint in arm.joint_names if joint not in driven]:
            raise StationError(
                f"{' '.join(arm.sdf)}: joint {', '.join(without_motor)} has no <effort> and therefore no motor"
            )
        columns = [driven.index(joint) for joint in arm.joint_names]
        self.actuation = np.zeros((len(self.actuators), arm.num_joints))
        self.actuation[columns, range(arm.num_joints)] = 1.0
        self.effort_limits = np.array([self.actuators[i].effort_limit() for i in columns])

    def position_index(self, joint: Joint) -> int:
        """Returns the index of a joint of the instance in the q and the v of the instance."""
        return self._instance_positions.index(joint.position_start())


@dataclass(frozen=True)
class DrivePorts:
    """Ports of the drive of an arm; see `ArmStation`.

    Vectors are in the arm's order of joints [rad, rad/s, N m; m, m/s, N on a prismatic joint].

    Attributes:
        effort_commanded: Commanded effort (n,). Unconnected: zero.
        effort_disturbance: Additional effort (n,), e.g. of a hand. Unconnected: zero.
        effort_measured: Measured effort (n,).
        state_estimated: Measured state (2n,), q, then v.
        state_true: True state (2n,), q, then v.
    """

    effort_commanded: InputPort
    effort_disturbance: InputPort
    effort_measured: OutputPort
    state_estimated: OutputPort
    state_true: OutputPort


def add_ideal_drive(
    builder: DiagramBuilder, plant: MultibodyPlant, joints: PlantJoints, instance: ModelInstanceIndex
) -> DrivePorts:
    """Connects the inputs of the plant for an arm and returns the ports. All added systems are C++ without state."""
    n, prefix = len(joints.index), plant.GetModelInstanceName(instance)
    commanded = builder.AddNamedSystem(f"{prefix}_effort_commanded", PassThrough(n))
    # The plant clamps the effort as well, but does not output the clamped effort. Therefore the effort is clamped here
    # for the port effort_measured.
    limits = joints.effort_limits
    clamp = builder.AddNamedSystem(f"{prefix}_effort_clamp", Saturation(min_value=-limits, max_value=limits))
    to_actuators = builder.AddNamedSystem(f"{prefix}_to_actuators", MatrixGain(D=joints.actuation))
    builder.Connect(commanded.get_output_port(), clamp.get_input_port())
    builder.Connect(clamp.get_output_port(), to_actuators.get_input_port())
    builder.Connect(to_actuators.get_output_port(), plant.get_actuation_input_port(instance))
    disturbance = builder.AddNamedSystem(f"{prefix}_effort_disturbance", PassThrough(n))
    to_tree = np.eye(plant.num_velocities())[:, joints.velocity_index]
    force = builder.AddNamedSystem(f"{prefix}_to_tree", MatrixGain(D=to_tree))
    builder.Connect(disturbance.get_output_port(), force.get_input_port())
    add_generalized_force(builder, plant, instance, force.get_output_port())
    state = add_true_state(builder, plant, joints, instance)
    return DrivePorts(commanded.get_input_port(), disturbance.get_input_port(), clamp.get_output_port(), state, state)


def add_generalized_force(
    builder: DiagramBuilder, plant: MultibodyPlant, instance: ModelInstanceIndex, force: OutputPort
) -> None:
    """Adds the force (nv,) of an arm to those that are already connected to `applied_generalized_force` of the plant.

    Raises:
        StationError: The port of the plant is an input of the Diagram, so no other force can be added.
    """
    total = plant.get_applied_generalized_force_input_port()
    if builder.IsConnectedOrExported(total):
        if (source := builder.connection_map().get((plant, total.get_index()))) is None:
            raise StationError("applied_generalized_force of the plant is exported, so an arm cannot add its efforts")
        others = source[0].get_output_port(source[1])
        builder.Disconnect(others, total)
        name = f"{plant.GetModelInstanceName(instance)}_and_other_forces"
        adder = builder.AddNamedSystem(name, Adder(2, plant.num_velocities()))
        builder.Connect(others, adder.get_input_port(0))
        builder.Connect(force, adder.get_input_port(1))
        force = adder.get_output_port()
    builder.Connect(force, total)


def add_true_state(
    builder: DiagramBuilder, plant: MultibodyPlant, joints: PlantJoints, instance: ModelInstanceIndex
) -> OutputPort:
    """Adds a system that outputs the state (2n) of the independent joints, q, then v; returns the output port."""
    select = block_diag(joints.selection.T, joints.selection.T)
    true = builder.AddNamedSystem(f"{plant.GetModelInstanceName(instance)}_state_true", MatrixGain(D=select))
    builder.Connect(plant.get_state_output_port(instance), true.get_input_port())
    return true.get_output_port()
