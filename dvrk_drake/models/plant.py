"""Creates the Drake MultibodyPlant of an arm, with its kinematic loops closed."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Frame,
    ModelInstanceIndex,
    MultibodyForces,
    RigidBody,
    SpatialInertia,
)
from pydrake.systems.framework import Context

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm import Arm, wall_stiffness
from dvrk_drake.models.arm_schema import Gains, LoopClosure
from dvrk_drake.models.immutable import cached
from dvrk_drake.models.plant_tree import PlantTree
from dvrk_drake.models.sdf_elements import BASE_LINK, DRAKE
from dvrk_drake.models.sdf_model import MODELS_FOLDER, compose_sdf, read_sdf_facts

#: Methods of closing the loops of a linkage: "mimic" couples joints of the tree, "ball" adds constraints at the points
#: where the loops are cut in the tree.
Closure = Literal["mimic", "ball"]


def pin_loop(plant: MultibodyPlant, instance: ModelInstanceIndex, loop: LoopClosure) -> None:
    """Closes a loop with a ball constraint (pin) and a distance constraint.

    The pin joins the origins of frame_a and frame_b. The link of frame_a is a bar. The distance constraint keeps the
    distance between the parent joint of this bar and frame_b equal to the length of the bar.

    Drake's solver SAP gives each constraint the compliance (5e-10 s^2) / M at a time step of 1 ms, where M [kg] is
    the effective mass of the unconstrained tree at the pin. The three equations of the pin share one effective mass. A
    light bar that rotates freely makes the pin compliant in all directions, including the direction of the bar, in
    which the linkage is loaded. The distance constraint has the effective mass of the linkage and is stiff. With this
    constraint, the weight of the PSM moves its remote centre by 1e-8 m instead of 2e-6 m.
    """
    A, B = (plant.GetFrameByName(name, instance) for name in (loop.frame_a, loop.frame_b))
    p_AP, p_BQ = (frame.GetFixedPoseInBodyFrame().translation() for frame in (A, B))
    plant.AddBallConstraint(A.body(), p_AP, B.body(), p_BQ)
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    hinge = next((joint for joint in joints if joint.child_body() is A.body()), None)
    if hinge is None:
        raise ArmError(f"{A.body().name()}, the link of frame {loop.frame_a} in loop_closures, has no parent joint")
    p_CH = hinge.frame_on_parent().GetFixedPoseInBodyFrame().translation()
    p_AH = hinge.frame_on_child().GetFixedPoseInBodyFrame().translation()
    plant.AddDistanceConstraint(hinge.parent_body(), p_CH, B.body(), p_BQ, float(np.linalg.norm(p_AP - p_AH)))


def remove_loop_mimics(root: ElementTree.Element, arm: Arm) -> None:
    """Removes the mimic tags of the joints in a loop.

    The mimic tag of a rotor or counterweight is kept, because it represents a cable and closes no loop.
    """
    loop_joints = _loop_joints(root, arm)
    for joint in root.iter("joint"):
        for mimic in joint.findall(f"{DRAKE}mimic"):
            if joint.get("name") in loop_joints:
                joint.remove(mimic)


def _loop_joints(root: ElementTree.Element, arm: Arm) -> set[str]:
    """Returns the names of the dependent joints between the base and the two frames of each loop."""
    parent_joint = {joint.findtext("child"): joint for joint in root.iter("joint")}
    frame_link = {frame.get("name"): frame.get("attached_to") for frame in root.iter("frame")}
    names = set()
    for loop in arm.loop_closures:
        for frame in (loop.frame_a, loop.frame_b):
            if frame not in frame_link:
                raise ArmError(f"{', '.join(arm.sdf)}: <frame> {frame} of loop_closures is missing")
            link = frame_link[frame]
            while link in parent_joint:
                names.add(parent_joint[link].get("name", ""))
                link = parent_joint[link].findtext("parent")
    return names - set(arm.joint_names)


#: Bandwidth [rad/s] of derived gains, and ratio ki / kp [1/s]: within the 16 to 30 rad/s and 1.2 to 1.5 1/s of the
#: gains of the MTM, which were tuned in simulation.
_BANDWIDTH, _INTEGRAL_RATE = 20.0, 1.2
#: Largest bandwidth [rad/s] of derived gains. A delay of three control periods of 1 ms then costs 10 deg of phase.
_MAX_BANDWIDTH = 60.0
#: Largest ratio kd / inertia [1/s] in any pose. A control period of 1 ms then removes half of the velocity. More than
#: twice this ratio would reverse it.
_MAX_DAMPING_RATE = 500.0
#: Largest share of the range of a joint for the soft wall of the guard at each end, since a motion does not enter the
#: walls. It is twice the margin of a designed motion.
_WALL_SHARE = 0.1
#: Prefix of the names of the frames of the dVRK's DH convention: dh_0, dh_1, ..., and those of the linkage.
DH_PREFIX = "dh_"


def package_map() -> PackageMap:
    """Returns a map with Drake's own packages and `dvrk_drake`, for URLs such as package://dvrk_drake/sdf/mtml.sdf.

    Call `Parser(plant).package_map().AddMap(package_map())`, so that Drake's parser finds the models.
    """
    packages = PackageMap()
    packages.AddPackageXml(str(MODELS_FOLDER / "package.xml"))
    return packages


def add_arm(
    plant: MultibodyPlant,
    arm: Arm,
    parent_frame: Frame | None = None,
    X_PB: RigidTransform | None = None,
    *,
    closure: Closure = "mimic",
    collision_shapes: bool = True,
) -> ModelInstanceIndex:
    """Adds an arm to a plant that is not finalized, e.g. beside other arms and objects, and welds its base.

    The default pose of the arm is zero, or the nearest pose inside its limits.
    Gravity and contact settings of the plant remain. Models and controllers use `arm.gravity`, in the base frame:
    choose `arm.with_gravity(...)` for a base that is tilted, see `add_arm_drive`. The loop closures require Drake's SAP
    solver, i.e. the contact approximation `sap`, `similar` or `lagged` (the default). A continuous plant can be
    simulated only with the integrator CENIC; for it, the closure "ball" requires drake 1.56 or newer.

    Args:
        plant: Plant, with or without a scene graph.
        arm: Arm to add. Drake appends a number to the name of its model instance if the name exists.
        parent_frame: Frame P to which the base is welded. None: the world frame.
        X_PB: Pose of the base frame (`base_link`) in P. None: identity.
        closure: Method of closing the loops of the linkage, see `Closure`.
        collision_shapes: Whether to add collision shapes. Without collision shapes, the arm has no contact, and a plant
            with a scene graph needs less time per step.

    Returns:
        Model instance of the arm.

    Raises:
        ArmError: The closure is unknown, the contact approximation of a discrete plant is `tamsi`, or Drake cannot load
            the SDF.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pydrake.math import RigidTransform
        >>> from pydrake.multibody.plant import MultibodyPlant
        >>> plant, arm = MultibodyPlant(1e-3), dvrk.load_arm("psm")
        >>> arms = [dvrk.add_arm(plant, arm, X_PB=RigidTransform([0.0, y, 0.5])) for y in (-0.2, 0.2)]
        >>> plant.Finalize()
        >>> [plant.GetModelInstanceName(arm) for arm in arms]
        ['psm', 'psm_1']
    """
    if closure not in get_args(Closure):
        raise ArmError(f'unknown closure "{closure}"; allowed: {", ".join(get_args(Closure))}')
    # The approximation is compared by its name, because newer versions of drake have no tamsi.
    if plant.time_step() > 0 and plant.get_discrete_contact_approximation().name == "kTamsi":
        raise ArmError("the discrete contact approximation is tamsi; a linkage needs sap, similar or lagged")
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    parser.package_map().AddMap(package_map())
    model = compose_sdf(arm.sdf)
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
        base = base_body(plant, instance).body_frame()
        plant.WeldFrames(parent_frame or plant.world_frame(), base, X_PB or RigidTransform())
        lower, upper = arm.position_lower, arm.position_upper
        positions = map(arm.linkage.position, (lower, np.clip(0.0, lower, upper), upper))
        for name, low, home, high in zip(arm.tree_joint_names, *positions, strict=True):
            joint = plant.GetJointByName(name, instance)
            if name in arm.joint_names:
                joint.set_position_limits([low], [high])
            joint.set_default_positions([home])
    except RuntimeError as error:
        raise ArmError(f"{', '.join(arm.sdf)}: Drake cannot load this model: {error}") from error
    return instance


def check_plant(arm: Arm) -> None:
    """Checks that a plant of the arm can be created with each method of loop closure.

    Raises:
        ArmError: Drake cannot load the SDF, a link is not connected to the base by joints, a frame of a loop closure is
            missing, or the numbers of the frames dh_0, dh_1, ... have a gap.
    """
    for closure in get_args(Closure):
        try:
            plant = make_arm_plant(arm, closure=closure)
            _check_links_and_frames(plant, arm)
            plant.CalcMassMatrix(plant.CreateDefaultContext())
        except RuntimeError as error:
            raise ArmError(f"{', '.join(arm.sdf)}: Drake cannot load this model: {error}") from error


def _check_links_and_frames(plant: MultibodyPlant, arm: Arm) -> None:
    where = ", ".join(arm.sdf)
    if floating := [plant.get_body(index).name() for index in plant.GetFloatingBaseBodies()]:
        raise ArmError(f"{where}: no joint connects {', '.join(sorted(floating))} to the base")
    numbers = dh_frames(plant).keys()
    if missing := set(range(max(numbers, default=0))) - numbers:
        raise ArmError(f"{where}: frame dh_{min(missing)} is missing, but there is a frame dh_{max(numbers)}")


def base_body(plant: MultibodyPlant, instance: ModelInstanceIndex | None = None) -> RigidBody:
    """Returns the base of an arm: the link that none of its joints moves.

    Args:
        plant: Plant with the arm.
        instance: Model instance that `add_arm` returned. None: the plant contains one arm.
    """
    return plant.GetBodyByName(BASE_LINK) if instance is None else plant.GetBodyByName(BASE_LINK, instance)


def arm_frames(plant: MultibodyPlant) -> list[Frame]:
    """Returns the frames of the arm in a plant with one arm, including those of its links."""
    return [plant.get_frame(index) for index in plant.GetFrameIndices(base_body(plant).model_instance())]


def dh_frames(plant: MultibodyPlant) -> dict[int, Frame]:
    """Returns number -> frame of the frames dh_0, dh_1, ... of the dVRK's DH convention, in ascending order."""
    frames = (frame for frame in arm_frames(plant) if re.fullmatch(rf"{DH_PREFIX}\d+", frame.name()))
    return dict(sorted((int(frame.name().removeprefix(DH_PREFIX)), frame) for frame in frames))


def main_frames(arm: Arm) -> list[str]:
    """Returns the frames that 3D views show: the DH frames, or else the base and the links of independent joints."""
    plant = shared_plant(arm)
    joints = map(plant.GetJointByName, arm.joint_names)
    dh = [frame.name() for frame in dh_frames(plant).values()]
    return dh or [BASE_LINK, *(joint.child_body().name() for joint in joints)]


def make_arm_plant(arm: Arm, time_step: float = 1e-3, closure: Closure = "mimic") -> MultibodyPlant:
    """Returns a finalized plant that contains only `arm`. The unit of `time_step` is s."""
    plant = MultibodyPlant(time_step)
    plant.mutable_gravity_field().set_gravity_vector(arm.gravity)
    add_arm(plant, arm, closure=closure)
    plant.Finalize()
    return plant


@cached
def shared_plant(arm: Arm) -> MultibodyPlant:
    """Returns the finalized plant of an arm, which is created once per Arm object. Do not modify the plant."""
    return make_arm_plant(arm)


def arm_sdf(arm: Arm, inertias: Mapping[str, SpatialInertia] | None = None) -> ElementTree.Element:
    """Returns an arm with its linkage and instrument as SDF, see `plant_tree`.

    Args:
        arm: The arm.
        inertias: Body -> spatial inertia about its origin, which replaces that of the arm's model.

    Raises:
        ArmError: Drake cannot load the model, e.g. because a mesh is missing.
    """
    plant, scene_graph = MultibodyPlant(1e-3), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    add_arm(plant, arm)
    plant.Finalize()
    efforts = dict.fromkeys(arm.tree_joint_names, 0.0)
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        efforts[actuator.joint().name()] = actuator.effort_limit()
    for name in arm.locked_joints:
        position = arm.linkage.offset[arm.tree_joint_names.index(name)]
        plant.GetJointByName(name).set_position_limits([position], [position])
    tree = PlantTree(plant, scene_graph)
    return tree.to_sdf(tree.inertias(inertias or {}), read_sdf_facts(compose_sdf(arm.sdf)).mimics, efforts)


def set_joint_damping(plant: MultibodyPlant, arm: Arm, damping: ArrayLike) -> None:
    """Sets the viscous friction (n,) of the independent joints [N m s/rad; N s/m] of a plant that is not finalized."""
    for name, value in zip(arm.joint_names, np.asarray(damping, float), strict=True):
        plant.GetJointByName(name).set_default_damping_vector([value])


def tree_selector(plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex | None = None) -> NDArray[np.int_]:
    """Returns the indices of the joints `arm.tree_joint_names` in the position vector of the plant.

    In a plant without floating bodies, the indices are also valid for the velocity vector, because all joints of arms
    have one degree of freedom.
    """
    joints = [plant.GetJointByName(name, instance) for name in arm.tree_joint_names]
    return np.array([joint.position_start() for joint in joints])


def set_arm_positions(
    plant: MultibodyPlant, context: Context, arm: Arm, q: ArrayLike, instance: ModelInstanceIndex | None = None
) -> None:
    """Sets the positions of all joints of an arm, including those of its linkage.

    Args:
        plant: Finalized plant with the arm.
        context: Context of the plant.
        arm: The arm.
        q: Positions (n,) of the independent joints [rad, m].
        instance: Model instance that `add_arm` returned. None: the plant contains no joints with the same names.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pydrake.multibody.plant import MultibodyPlant
        >>> plant, arm = MultibodyPlant(1e-3), dvrk.load_arm("mtml")
        >>> mtml = dvrk.add_arm(plant, arm)
        >>> plant.Finalize()
        >>> context = plant.CreateDefaultContext()
        >>> dvrk.set_arm_positions(plant, context, arm, [0, 0.1, 0.2, 0, 0, 0, 0], mtml)
        >>> plant.GetJointByName("elbow_pitch", mtml).GetOnePosition(context)
        0.2
    """
    q_plant = plant.GetPositions(context)
    q_plant[tree_selector(plant, arm, instance)] = arm.linkage.position(q)
    plant.SetPositions(context, q_plant)


def link_poses(arm: Arm, q: ArrayLike) -> dict[str, RigidTransform]:
    """Returns the pose X_WL of each link in the world frame, at the pose q (n,) [rad, m]."""
    plant = shared_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    bodies = map(plant.get_body, map(BodyIndex, range(plant.num_bodies())))
    return {body.name(): body.EvalPoseInWorld(context) for body in bodies}


def holding_torque(plant: MultibodyPlant, context: Context, arm: Arm) -> NDArray[np.float64]:
    """Returns the torque (n,) on the independent joints that compensates gravity at the context's pose.

    Drake's gravity forces tau_g do not include the forces of constraints. Therefore tau_g is projected onto the
    independent joints with the matrix G of the linkage: tau = -G' tau_g.
    """
    tau_g = plant.CalcGravityGeneralizedForces(context)[tree_selector(plant, arm)]
    return -arm.linkage.pull_back_effort(tau_g)


def holding_torques(arm: Arm, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the torques (m, n) that compensate gravity at poses (m, n) of the independent joints [N m, N].

    The inertial parameters are those of the SDF files.
    """
    plant = shared_plant(arm)
    context = plant.CreateDefaultContext()
    tau = np.empty(poses.shape)
    for row, q in enumerate(poses):
        set_arm_positions(plant, context, arm, q)
        tau[row] = holding_torque(plant, context, arm)
    return tau


def critically_damped_gains(arm: Arm) -> Gains:
    """Returns gains with which each joint, moving alone, is critically damped.

    The bandwidth is `_BANDWIDTH`, or larger if the soft wall of the guard would otherwise cover more than `_WALL_SHARE`
    of the range (`SoftWalls.width`). The inertia of a joint is the largest one in random poses, with the rotors of the
    model. The gains are within the ranges of `Arm.gain_range`.
    """
    plant = shared_plant(arm)
    context, selector = plant.CreateDefaultContext(), tree_selector(plant, arm)
    inertias = []
    for q in arm.sample_poses(50, np.random.default_rng(0)):
        set_arm_positions(plant, context, arm, q)
        M = plant.CalcMassMatrix(context)[np.ix_(selector, selector)]
        inertias.append(np.diag(arm.linkage.matrix.T @ M @ arm.linkage.matrix))
    least, inertia = np.min(inertias, axis=0), np.max(inertias, axis=0)
    _, lower, upper = arm.limit_matrix()
    widest = _WALL_SHARE * (upper - lower)
    kp_of_walls = np.max(wall_stiffness(arm) / widest[:, None], axis=0)
    largest = np.clip(_MAX_DAMPING_RATE * least / (2 * inertia), _BANDWIDTH, _MAX_BANDWIDTH)
    bandwidth = np.clip(np.sqrt(kp_of_walls / inertia), _BANDWIDTH, largest)
    kp = bandwidth**2 * inertia
    gains = {"kp": kp, "kd": 2 * bandwidth * inertia, "ki": _INTEGRAL_RATE * kp}
    return Gains(**{name: np.clip(values, *arm.gain_range(name)).tolist() for name, values in gains.items()})


def inverse_dynamics(
    arm: Arm,
    q: NDArray[np.float64],
    v: NDArray[np.float64],
    vd: NDArray[np.float64],
    inertias: Mapping[str, SpatialInertia] | None = None,
) -> NDArray[np.float64]:
    """Returns the efforts (m, n) of the independent joints for a motion (m, n), from Drake's inverse dynamics [N m, N].

    The inertial parameters are those of the SDF files. The efforts of the tree are projected as in `holding_torque`.

    Args:
        arm: Arm that moves.
        q, v, vd: Positions [rad, m], velocities and accelerations (m, n) of the independent joints.
        inertias: Link -> spatial inertia about the origin of its frame, which replaces that of the SDF. If it is given,
            the rotors of the SDF have no inertia.
    """
    plant = make_arm_plant(arm)
    context, forces, selector = plant.CreateDefaultContext(), MultibodyForces(plant), tree_selector(plant, arm)
    if inertias is not None:
        for link, inertia in inertias.items():
            plant.GetBodyByName(link).SetSpatialInertiaInBodyFrame(context, inertia)
        for index in plant.GetJointActuatorIndices():
            plant.get_joint_actuator(index).SetRotorInertia(context, 0.0)
    tau = np.empty(q.shape)
    tree = np.zeros((3, len(q), plant.num_positions()))
    for k, x in enumerate((arm.linkage.position(q), arm.linkage.velocity(v), arm.linkage.velocity(vd))):
        tree[k][:, selector] = x
    for i in range(len(q)):
        plant.SetPositions(context, tree[0, i])
        plant.SetVelocities(context, tree[1, i])
        plant.CalcForceElementsContribution(context, forces)
        tau[i] = arm.linkage.pull_back_effort(plant.CalcInverseDynamics(context, tree[2, i], forces)[selector])
    return tau
