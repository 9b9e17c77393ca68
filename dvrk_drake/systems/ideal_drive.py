"""Ideal drive of an arm. It applies the commanded effort without friction, and its measurements are exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuator, ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import MatrixGain, PassThrough, Saturation

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import tree_selector


class PlantJoints:
    """Independent joints of an arm in a finalized plant, in the arm's order.

    Attributes:
        index: Indices (n,) of the joints in the plant's q and v.
        selection: Matrix (nv, n) from joint efforts to generalized forces. The transpose selects the joint positions.
        actuators: Actuators of the arm's instance, in Drake's order.
        actuation: Matrix (len(actuators), n) from joint efforts to efforts of all actuators. Actuators that do not
            drive an independent joint only represent rotor inertia. Their effort is zero.
        effort_limits: Effort limits (n,) [N m, N] of the joints' motors.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex) -> None:
        """Finds the joints of `arm` in `plant`. `add_arm` added the arm as the model instance `instance`.

        Raises:
            StationError: The plant has a floating body, or a joint has no motor.
        """
        if plant.num_positions() != plant.num_velocities():
            raise StationError("modify_plant must not add floating bodies. Weld them to the arm")
        names = list(arm.tree_joint_names)
        tree, n = tree_selector(plant, arm, instance), arm.num_joints
        self.index: NDArray[np.int_] = tree[[names.index(joint) for joint in arm.joint_names]]
        self.selection = np.zeros((plant.num_velocities(), n))
        self.selection[self.index, range(n)] = 1.0
        self.actuators: list[JointActuator] = [
            plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)
        ]
        driven = [actuator.joint().name() for actuator in self.actuators]
        if without_motor := [joint for joint in arm.joint_names if joint not in driven]:
            raise StationError(
                f"{' '.join(arm.sdf)}: joint {', '.join(without_motor)} has no <effort> and therefore no motor"
            )
        columns = [driven.index(joint) for joint in arm.joint_names]
        self.actuation = np.zeros((len(self.actuators), n))
        self.actuation[columns, range(n)] = 1.0
        self.effort_limits = np.array([self.actuators[i].effort_limit() for i in columns])


@dataclass(frozen=True)
class DrivePorts:
    """Ports of a drive that its station exports; see `ArmStation`. Vectors are in the arm's order of joints."""

    effort_commanded: InputPort
    effort_disturbance: InputPort
    effort_measured: OutputPort
    state_true: OutputPort
    state_estimated: OutputPort


def add_ideal_drive(
    builder: DiagramBuilder, plant: MultibodyPlant, joints: PlantJoints, instance: ModelInstanceIndex
) -> DrivePorts:
    """Connects the inputs of a finalized plant and returns the ports. All added systems are C++ without state."""
    n = len(joints.index)
    commanded = builder.AddNamedSystem("effort_commanded", PassThrough(n))
    # The plant clamps the effort as well, but does not output the clamped effort. Therefore the effort is clamped here
    # for the port effort_measured.
    limits = joints.effort_limits
    clamp = builder.AddNamedSystem("effort_clamp", Saturation(min_value=-limits, max_value=limits))
    to_actuators = builder.AddNamedSystem("to_actuators", MatrixGain(D=joints.actuation))
    builder.Connect(commanded.get_output_port(), clamp.get_input_port())
    builder.Connect(clamp.get_output_port(), to_actuators.get_input_port())
    builder.Connect(to_actuators.get_output_port(), plant.get_actuation_input_port(instance))
    state = add_true_state(builder, plant, joints)
    disturbance = builder.AddNamedSystem("effort_disturbance", PassThrough(n))
    to_tree = builder.AddNamedSystem("to_tree", MatrixGain(D=joints.selection))
    builder.Connect(disturbance.get_output_port(), to_tree.get_input_port())
    builder.Connect(to_tree.get_output_port(), plant.get_applied_generalized_force_input_port())
    return DrivePorts(commanded.get_input_port(), disturbance.get_input_port(), clamp.get_output_port(), state, state)


def add_true_state(builder: DiagramBuilder, plant: MultibodyPlant, joints: PlantJoints) -> OutputPort:
    """Adds a system that outputs the state (2n) of the independent joints, q, then v; returns the output port."""
    S = joints.selection.T
    true = builder.AddNamedSystem("state_true", MatrixGain(D=np.kron(np.eye(2), S)))
    builder.Connect(plant.get_state_output_port(), true.get_input_port())
    return true.get_output_port()
