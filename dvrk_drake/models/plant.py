"""An arm as a Drake MultibodyPlant."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from functools import cache
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.loop_closure import Closure, pin_loop, remove_loop_mimics
from dvrk_drake.models.sdf_model import MODELS_FOLDER, compose_sdf


def package_map() -> PackageMap:
    """Returns a map with Drake's own packages and `dvrk_drake`, for URLs such as package://dvrk_drake/sdf/mtml.sdf.

    With it Drake's parser finds the models: `Parser(plant).package_map().AddMap(package_map())`.
    """
    packages = PackageMap()
    packages.AddPackageXml(str(MODELS_FOLDER / "package.xml"))
    return packages


def add_arm(
    plant: MultibodyPlant, arm: Arm, closure: Closure = "mimic", collision_shapes: bool = True
) -> ModelInstanceIndex:
    """Adds `arm` to a plant that is not finalized, welds its base to the world and sets gravity and limits.

    Drake's joint couplings and pins need the SAP solver, that of the contact approximations sap, similar and lagged. A
    discrete plant with tamsi gets sap. A continuous one can only be simulated with the integrator CENIC (its pins need
    drake 1.56 or newer).

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
    # By its name, since newer versions of drake have no tamsi.
    if plant.time_step() > 0 and plant.get_discrete_contact_approximation().name == "kTamsi":
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    parser = Parser(plant)
    parser.package_map().AddMap(package_map())
    model = compose_sdf(arm.sdf, arm.mirrored_links)
    if closure == "ball":
        remove_loop_mimics(model, arm)
    if not collision_shapes:
        for link in model.iter("link"):
            for shape in link.findall("collision"):
                link.remove(shape)
    try:
        (instance,) = parser.AddModelsFromString(ElementTree.tostring(model, encoding="unicode"), "sdf")
        if closure == "ball":
            for loop in arm.loop_closures:
                pin_loop(plant, instance, loop)
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


@cache
def shared_plant(arm: Arm) -> MultibodyPlant:
    """The finalized plant of an arm for those who only read it: made once for each Arm object."""
    return make_arm_plant(arm)


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
