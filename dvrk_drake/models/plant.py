"""An arm as a Drake MultibodyPlant."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import LoopClosure
from dvrk_drake.models.sdf_model import DRAKE, MODELS_FOLDER, compose_sdf

#: How the loops of a linkage are held: "mimic" couples the joints of a tree, "ball" pins the cut loops.
Closure = Literal["mimic", "ball"]


def add_arm(
    plant: MultibodyPlant, arm: Arm, closure: Closure = "mimic", collision_shapes: bool = True
) -> ModelInstanceIndex:
    """Adds `arm` to a plant that is not finalized, welds its base to the world and sets gravity and limits.

    A discrete plant gets the SAP solver, which all of Drake's joint couplings and pins need. A continuous one can only
    be simulated with the integrator CENIC (its pins need drake 1.56 or newer).

    Args:
        plant: with or without a scene graph.
        arm: what to add.
        closure: how the linkage's loops are held.
        collision_shapes: without them nothing can touch the arm, and a step of a plant with a scene graph is cheaper.

    Raises:
        ArmError: no such closure, or Drake refuses the arm's SDF.
    """
    if closure not in get_args(Closure):
        raise ArmError(f'unknown closure "{closure}"; known: {", ".join(get_args(Closure))}')
    if plant.time_step() > 0:
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(MODELS_FOLDER / "package.xml"))
    model = compose_sdf(arm.sdf, arm.mirrored_links)
    if closure == "ball":
        _remove_loop_mimics(model, arm)
    if not collision_shapes:
        for link in model.iter("link"):
            for shape in link.findall("collision"):
                link.remove(shape)
    try:
        (instance,) = parser.AddModelsFromString(ElementTree.tostring(model, encoding="unicode"), "sdf")
        if closure == "ball":
            for loop in arm.loop_closures:
                _pin(plant, instance, loop)
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link", instance))
        plant.mutable_gravity_field().set_gravity_vector(arm.gravity)
        for name, lower, upper in zip(arm.joint_names, arm.position_lower, arm.position_upper, strict=True):
            plant.GetJointByName(name, instance).set_position_limits([lower], [upper])
    except RuntimeError as error:
        raise ArmError(f"{', '.join(arm.sdf)}: Drake refuses this model: {error}") from error
    return instance


def check_plant(arm: Arm) -> None:
    """Refuses an arm of which no plant can be made, whichever way its loops are closed.

    Raises:
        ArmError: Drake refuses its SDF; no joint holds a link; or the SDF lacks a frame of a loop, or one of the frames
            dh_0, dh_1, ...
    """
    for closure in get_args(Closure):
        try:
            plant = make_arm_plant(arm, closure=closure)
            _check_links_and_frames(plant, arm)
            plant.CalcMassMatrix(plant.CreateDefaultContext())
        except RuntimeError as error:
            raise ArmError(f"{', '.join(arm.sdf)}: Drake refuses this model: {error}") from error


def _check_links_and_frames(plant: MultibodyPlant, arm: Arm) -> None:
    where = ", ".join(arm.sdf)
    if floating := [plant.get_body(index).name() for index in plant.GetFloatingBaseBodies()]:
        raise ArmError(f"{where}: no joint holds {', '.join(sorted(floating))}")
    instance = plant.GetBodyByName("base_link").model_instance()
    names = [plant.get_frame(index).name() for index in plant.GetFrameIndices(instance)]
    numbers = {int(match[1]) for name in names if (match := re.fullmatch(r"dh_(\d+)", name))}
    if missing := set(range(max(numbers, default=0))) - numbers:
        raise ArmError(f"{where}: has a frame dh_{max(numbers)}, but no dh_{min(missing)}")


def make_arm_plant(arm: Arm, time_step: float = 1e-3, closure: Closure = "mimic") -> MultibodyPlant:
    """A finalized plant that holds nothing but `arm`; `time_step` [s]."""
    plant = MultibodyPlant(time_step)
    add_arm(plant, arm, closure)
    plant.Finalize()
    return plant


def set_joint_damping(plant: MultibodyPlant, arm: Arm, damping: ArrayLike) -> None:
    """Gives the independent joints viscous friction (n,) [N m s/rad; N s/m]; before the plant is finalized."""
    for name, value in zip(arm.joint_names, np.asarray(damping, float), strict=True):
        plant.GetJointByName(name).set_default_damping_vector([value])


def tree_selector(plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex | None = None) -> NDArray[np.int_]:
    """Index into the plant's q (and v: all joints have one degree of freedom) of each of `arm.tree_joint_names`."""
    joints = [plant.GetJointByName(name, instance) for name in arm.tree_joint_names]
    return np.array([joint.position_start() for joint in joints])


def set_arm_positions(plant: MultibodyPlant, context: Context, arm: Arm, q: ArrayLike) -> None:
    """Sets the whole tree, linkage included, to the pose of the independent joints q (n,)."""
    q_plant = plant.GetPositions(context)
    q_plant[tree_selector(plant, arm)] = arm.linkage.position(q)
    plant.SetPositions(context, q_plant)


def holding_torque(plant: MultibodyPlant, context: Context, arm: Arm) -> NDArray[np.float64]:
    """Torque (n,) on the independent joints that holds the arm against gravity at the context's pose.

    Drake's gravity forces ignore constraints, so they are projected through the linkage: tau = -G' tau_g.
    """
    tau_g = plant.CalcGravityGeneralizedForces(context)[tree_selector(plant, arm)]
    return -arm.linkage.pull_back_effort(tau_g)


def holding_torques(arm: Arm, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, n) torques that hold the arm, as its SDF states it, at poses (m, n) of the independent joints [N m, N]."""
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    tau = np.empty(poses.shape)
    for row, q in enumerate(poses):
        set_arm_positions(plant, context, arm, q)
        tau[row] = holding_torque(plant, context, arm)
    return tau


def _pin(plant: MultibodyPlant, instance: ModelInstanceIndex, loop: LoopClosure) -> None:
    """Pins frame_a of the closing bar to frame_b, and holds the bar's length once more as an equation of its own.

    SAP gives each constraint the compliance 5e-10 s^2 / m at 1 ms, m being the mass that the tree without constraints
    shows at the pin. The pin's three equations share one, and a light bar that is free to swing makes it soft in all
    directions, also along the bar, where the linkage's load goes. The length alone shows the linkage behind it and
    is stiff: the PSM's remote centre gives by 1e-8 m under its weight, instead of 2e-6 m.
    """
    A, B = (plant.GetFrameByName(name, instance) for name in (loop.frame_a, loop.frame_b))
    p_AP, p_BQ = (frame.GetFixedPoseInBodyFrame().translation() for frame in (A, B))
    plant.AddBallConstraint(A.body(), p_AP, B.body(), p_BQ)
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    hinge = next((joint for joint in joints if joint.child_body() is A.body()), None)
    if hinge is None:
        raise ArmError(f"{A.body().name()}, which carries the frame {loop.frame_a} of a loop, hangs on no joint")
    p_CH = hinge.frame_on_parent().GetFixedPoseInBodyFrame().translation()
    p_AH = hinge.frame_on_child().GetFixedPoseInBodyFrame().translation()
    plant.AddDistanceConstraint(hinge.parent_body(), p_CH, B.body(), p_BQ, float(np.linalg.norm(p_AP - p_AH)))


def _remove_loop_mimics(root: ElementTree.Element, arm: Arm) -> None:
    """Only those on a loop: a rotor or counterweight that follows another joint closes none, its mimic is its cable."""
    loop_joints = _loop_joints(root, arm)
    for joint in root.iter("joint"):
        for mimic in joint.findall(f"{DRAKE}mimic"):
            if joint.get("name") in loop_joints:
                joint.remove(mimic)


def _loop_joints(root: ElementTree.Element, arm: Arm) -> set[str]:
    """Dependent joints on the way from the base to a loop's cut."""
    parent_joint = {joint.findtext("child"): joint for joint in root.iter("joint")}
    frame_link = {frame.get("name"): frame.get("attached_to") for frame in root.iter("frame")}
    names = set()
    for loop in arm.loop_closures:
        for frame in (loop.frame_a, loop.frame_b):
            if frame not in frame_link:
                raise ArmError(f"{', '.join(arm.sdf)}: has no <frame> {frame}, which loop_closures names")
            link = frame_link[frame]
            while link in parent_joint:
                names.add(parent_joint[link].get("name", ""))
                link = parent_joint[link].findtext("parent")
    return names - set(arm.joint_names)
