"""Ideal drive of an arm in a plant: the commanded effort acts without friction, and measurements are exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuator, ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import MatrixGain, PassThrough, Saturation
from scipy.linalg import block_diag

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import tree_selector

#: Largest difference [m/s^2] of the gravity vectors of a plant and of an arm in it: the range of gravity on the surface
#: of the earth is 9.76 to 9.83 m/s^2.
GRAVITY_TOLERANCE = 0.1


class PlantJoints:
    """Independent joints of an arm in a finalized plant, in the arm's order.

    Attributes:
        index: Indices (n,) of the joints in the plant's q.
        position_selection: Matrix (n, nq) that selects the joint positions from the plant's q.
        selection: Matrix (nv, n) from joint efforts to generalized forces. The transpose selects the joint velocities.
        actuators: Actuators of the arm's instance, in Drake's order.
        actuation: Matrix (len(actuators), n) from joint efforts to efforts of all actuators. Actuators that do not
            drive an independent joint only represent rotor inertia. Their effort is zero.
        effort_limits: Effort limits (n,) [N m, N] of the joints' motors.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex) -> None:
        """Finds the joints of `arm` in `plant`. `add_arm` added the arm as the model instance `instance`.

        Raises:
            StationError: A joint has no motor.
        """
        names = list(arm.tree_joint_names)
        tree, n = tree_selector(plant, arm, instance), arm.num_joints
        self.index: NDArray[np.int_] = tree[[names.index(joint) for joint in arm.joint_names]]
        self.position_selection = np.eye(plant.num_positions())[self.index]
        self.selection = np.zeros((plant.num_velocities(), n))
        velocities = [plant.GetJointByName(joint, instance).velocity_start() for joint in arm.joint_names]
        self.selection[velocities, range(n)] = 1.0
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
class ArmPorts:
    """Ports of an arm in a plant: commanded and measured effort (n,), and measured state (2n,), q, then v.

    Vectors are in the arm's order of joints [rad, rad/s, N m; m, m/s, N on a prismatic joint].
    """

    effort_commanded: InputPort
    effort_measured: OutputPort
    state_estimated: OutputPort


@dataclass(frozen=True)
class DrivePorts(ArmPorts):
    """Ports of a drive that its station exports; see `ArmStation`."""

    effort_disturbance: InputPort
    state_true: OutputPort


def add_arm_drive(builder: DiagramBuilder, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex) -> ArmPorts:
    """Adds the ideal drive of one arm of a finalized plant, which may hold other arms and objects, to a Diagram.

    The ports fit to a `GravityPidController` of the same arm. Friction and the other effects of a real arm are
    simulated only by `ArmStation`, which holds one arm.

    Args:
        builder: Builder of the Diagram that contains the plant.
        plant: Plant to which `add_arm` added the arm.
        arm: The arm. Its gravity vector is that of the plant, in the frame of its base.
        instance: Model instance that `add_arm` returned.

    Raises:
        ArmError: The arm has locked joints.
        StationError: The gravity vector of the arm is not that of the plant, so that a controller would compensate a
            wrong gravity; or a joint has no motor.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
        >>> from pydrake.systems.framework import DiagramBuilder
        >>> builder, arm = DiagramBuilder(), dvrk.load_arm("mtml")
        >>> plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        >>> mtml = dvrk.add_arm(plant, arm)
        >>> plant.Finalize()
        >>> drive = dvrk.add_arm_drive(builder, plant, arm, mtml)
        >>> controller = builder.AddSystem(dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm)))
        >>> builder.Connect(drive.state_estimated, controller.GetInputPort("state_estimated"))
        >>> builder.Connect(controller.GetOutputPort("effort"), drive.effort_commanded)
    """
    arm.refuse_locked_joints("a drive")
    base = plant.GetFrameByName("base_link", instance)
    if plant.IsAnchored(base.body()):
        R_WB = base.CalcPoseInWorld(plant.CreateDefaultContext()).rotation()
        gravity = R_WB.inverse() @ plant.gravity_field().gravity_vector()
        if np.linalg.norm(gravity - arm.gravity) > GRAVITY_TOLERANCE:
            expected, found = (", ".join(f"{g:.3f}" for g in vector) for vector in (gravity, arm.gravity))
            raise StationError(
                f"{arm.name}: gravity in the frame of the base is [{expected}] m/s^2 in this plant, but [{found}] in "
                f"the arm, so a controller would compensate a wrong gravity; use arm.with_gravity([{expected}])"
            )
    joints = PlantJoints(plant, arm, instance)
    return add_ideal_drive(builder, plant, joints, instance, f"{plant.GetModelInstanceName(instance)}_")


def add_ideal_drive(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    joints: PlantJoints,
    instance: ModelInstanceIndex,
    prefix: str = "",
) -> ArmPorts:
    """Connects the actuation input of an arm and returns the ports. All added systems are C++ without state.

    The names of the systems begin with `prefix`.
    """
    commanded = builder.AddNamedSystem(f"{prefix}effort_commanded", PassThrough(len(joints.index)))
    # The plant clamps the effort as well, but does not output the clamped effort. Therefore the effort is clamped here
    # for the port effort_measured.
    limits = joints.effort_limits
    clamp = builder.AddNamedSystem(f"{prefix}effort_clamp", Saturation(min_value=-limits, max_value=limits))
    to_actuators = builder.AddNamedSystem(f"{prefix}to_actuators", MatrixGain(D=joints.actuation))
    builder.Connect(commanded.get_output_port(), clamp.get_input_port())
    builder.Connect(clamp.get_output_port(), to_actuators.get_input_port())
    builder.Connect(to_actuators.get_output_port(), plant.get_actuation_input_port(instance))
    state = add_true_state(builder, plant, joints, prefix)
    return ArmPorts(commanded.get_input_port(), clamp.get_output_port(), state)


def add_disturbance(builder: DiagramBuilder, plant: MultibodyPlant, joints: PlantJoints) -> InputPort:
    """Adds an input of additional efforts (n,) of the joints. It uses the plant's port of generalized forces."""
    disturbance = builder.AddNamedSystem("effort_disturbance", PassThrough(len(joints.index)))
    to_tree = builder.AddNamedSystem("to_tree", MatrixGain(D=joints.selection))
    builder.Connect(disturbance.get_output_port(), to_tree.get_input_port())
    builder.Connect(to_tree.get_output_port(), plant.get_applied_generalized_force_input_port())
    return disturbance.get_input_port()


def add_true_state(builder: DiagramBuilder, plant: MultibodyPlant, joints: PlantJoints, prefix: str = "") -> OutputPort:
    """Adds a system that outputs the state (2n) of the independent joints, q, then v; returns the output port."""
    select = block_diag(joints.position_selection, joints.selection.T)
    true = builder.AddNamedSystem(f"{prefix}state_true", MatrixGain(D=select))
    builder.Connect(plant.get_state_output_port(), true.get_input_port())
    return true.get_output_port()
