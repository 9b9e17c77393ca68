"""Model-based design of gains from the mass matrix, friction, encoders, motors and delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.errors import ControllerError
from dvrk_drake.experiments.tuning.bench import band, effort_limits, rounded_gains
from dvrk_drake.experiments.tuning.sampled_loop import Margins, SampledLoop, Sampling, place
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.plant import holding_torques, make_arm_plant, set_arm_positions, tree_selector

#: Damping ratio of a joint at its largest inertia, without the additional damping of dry friction.
DAMPING_RATIO = 0.8
#: Minimum phase margin [rad] and minimum gain margin, at the smallest and the largest inertia of the joint.
PHASE_MARGIN, GAIN_MARGIN = np.pi / 6, 2.0
#: Maximum change of the effort due to one encoder count, as a share of the maximum effort. A change up to the dry
#: friction is always allowed.
MAX_COUNT_EFFORT = 0.05
#: Maximum time until the integral term moves a joint that sticks at the edge of its settling band [s].
BREAK_AWAY_TIME = 0.25
#: Assumed gravity error, as a share of the largest gravity torque; upper bound of Ki / (Kp w) with the natural
#: frequency w.
GRAVITY_ERROR, INTEGRAL_SHARE = 0.2, 0.15
#: Tested natural frequencies, in descending order [rad/s].
FREQUENCIES = np.geomspace(300.0, 1.0, 400)
#: Number of poses for the mass matrix, and number of poses for checking the stability of all joints together.
POSES, NUM_STABILITY_POSES = 200, 20


@dataclass(frozen=True)
class JointProperties:
    """Properties of one joint that determine its gains.

    Attributes:
        inertia: Smallest inertia (other joints free) and largest inertia (other joints locked)
            [kg m^2, kg].
        dry_friction: Dry friction [N m, N].
        viscous: Coefficient of viscous friction [N m s/rad, N s/m].
        gravity: Largest gravity torque [N m, N].
        count: Resolution of the encoder in joint coordinates [rad, m].
        band: Settling band [rad, m].
        effort_limit: Maximum effort [N m, N].
    """

    inertia: tuple[float, float]
    dry_friction: float
    viscous: float
    gravity: float
    count: float
    band: float
    effort_limit: float


@dataclass(frozen=True)
class JointDesign:
    """Gains of one joint and their derivation.

    Attributes:
        kp, kd, ki: Gains [N m/rad, N m s/rad, N m/(rad s)], with N/m instead of N m/rad for a prismatic joint.
        frequency: Natural frequency of the closed loop at the largest inertia [rad/s].
        margins: Stability margins at the smallest and at the largest inertia.
        limited_by: Requirement that the next higher frequency violates.
    """

    kp: float
    kd: float
    ki: float
    frequency: float
    margins: tuple[Margins, Margins]
    limited_by: str


@dataclass(frozen=True)
class ArmDesign:
    """Gains of an arm and their derivation.

    Attributes:
        gains: Gains of all joints.
        properties: Properties of each joint.
        joints: Design of each joint.
    """

    gains: Gains
    properties: tuple[JointProperties, ...]
    joints: tuple[JointDesign, ...]


def design_arm(arm: Arm) -> ArmDesign:
    """Designs the gains of each joint separately, then checks the stability of all joints together.

    The closed loop of all joints must be stable at all checked poses, with one additional period of delay and 20 % less
    inertia. While it is unstable at a pose, the function reduces the natural frequency of one joint by 10 %: the joint
    with the largest share of the unstable mode's energy.

    Raises:
        ControllerError: No gains satisfy the requirements, for one joint or for all joints together.
    """
    sampling = sampling_of(arm)
    masses = mass_matrices(arm, arm.sample_poses(POSES, np.random.default_rng(1)))
    properties = joint_properties(arm, masses)
    joints = [
        _design_named_joint(arm, name, joint, sampling) for name, joint in zip(arm.joint_names, properties, strict=True)
    ]
    frequency_scales = np.ones(arm.num_joints)
    more_delay = Sampling(sampling.period, sampling.ticks + 1, sampling.cut_off)
    viscous = [joint.viscous for joint in properties]
    loops = [SampledLoop(0.8 * M, more_delay, viscous) for M in masses[:: POSES // NUM_STABILITY_POSES]]
    while np.min(frequency_scales) > 0.1:
        gains = rounded_gains((joint.kp, joint.kd, joint.ki) for joint in joints)
        growth, shares = max((loop.least_damped_mode(gains) for loop in loops), key=lambda mode: mode[0])
        if growth < 1.0:
            return ArmDesign(gains, properties, tuple(joints))
        j = int(np.argmax(shares))
        frequency_scales[j] *= 0.9
        joints[j] = design_joint(properties[j], sampling, frequency_scales[j])
    raise ControllerError(
        f"{arm.name}: no gains stabilise all joints together. Check the inertias, delays and encoders of the arm."
    )


def _design_named_joint(arm: Arm, name: str, joint: JointProperties, sampling: Sampling) -> JointDesign:
    try:
        return design_joint(joint, sampling)
    except ControllerError as error:
        raise ControllerError(f"{arm.name}, {name}: {error}") from error


def design_joint(joint: JointProperties, sampling: Sampling, frequency_scale: float = 1.0) -> JointDesign:
    """Returns the gains for the highest natural frequency that satisfies all requirements.

    If `frequency_scale` is below 1, the gains are those for this frequency times `frequency_scale`.

    Raises:
        ControllerError: No gains satisfy the requirements.
    """
    limited_by = "highest tested frequency"
    for w in FREQUENCIES:
        design = _joint_gains(joint, sampling, w)
        if reason := _violated_requirement(joint, sampling, design):
            limited_by = reason
            continue
        if frequency_scale < 1.0:
            limited_by = "other joints"
            design = _joint_gains(joint, sampling, frequency_scale * w)
        kp, kd, ki = design
        low, high = (SampledLoop(M, sampling, joint.viscous).margins(Gains([kp], [kd], [ki])) for M in joint.inertia)
        return JointDesign(kp, kd, ki, float(frequency_scale * w), (low, high), limited_by)
    raise ControllerError(
        f"no gains with a natural frequency of {FREQUENCIES[-1]:g} rad/s or more satisfy the requirements "
        f"(limited by {limited_by})"
    )


def _joint_gains(joint: JointProperties, sampling: Sampling, w: float) -> tuple[float, float, float]:
    """Returns kp, kd and ki for the natural frequency w [rad/s] at the largest inertia."""
    kp, kd = place(joint.inertia[1], w, DAMPING_RATIO, sampling, joint.viscous)
    disturbance = joint.dry_friction + GRAVITY_ERROR * joint.gravity
    return kp, kd, min(disturbance / (joint.band * BREAK_AWAY_TIME), INTEGRAL_SHARE * w * kp)


def _violated_requirement(joint: JointProperties, sampling: Sampling, design: tuple[float, float, float]) -> str:
    """Returns the first requirement that the gains violate, or "" if they satisfy all."""
    kp, kd, ki = design
    # Change of the effort in one period if the measured position changes by one count.
    count_effort = joint.count * (kp + kd * (1.0 - sampling.decay) / sampling.period)
    if count_effort > max(joint.dry_friction, MAX_COUNT_EFFORT * joint.effort_limit):
        return "encoder count"
    for M in joint.inertia:
        margins = SampledLoop(M, sampling, joint.viscous).margins(Gains([kp], [kd], [ki]))
        if margins.phase < PHASE_MARGIN:
            return "phase margin"
        if margins.gain < GAIN_MARGIN:
            return "gain margin"
    return ""


def sampling_of(arm: Arm, period: float = 1e-3) -> Sampling:
    """Returns the sampling of an arm. The delay includes one period for the computing time of the controller."""
    delay, encoder = arm.effects.delay, arm.effects.encoder
    arm_delay = delay.measurement + delay.command if delay else 0
    return Sampling(period, arm_delay + 1, encoder.velocity_cut_off if encoder else np.inf)


def mass_matrices(arm: Arm, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the mass matrices (m, n, n) at poses (m, n), including the linkage and the rotors.

    They are G' M G with the mass matrix M of the joints `arm.tree_joint_names` and G = `arm.linkage.matrix`.
    """
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    tree, G = tree_selector(plant, arm), arm.linkage.matrix
    masses = []
    for q in poses:
        set_arm_positions(plant, context, arm, q)
        masses.append(G.T @ plant.CalcMassMatrix(context)[np.ix_(tree, tree)] @ G)
    return np.array(masses)


def joint_properties(arm: Arm, masses: NDArray[np.float64]) -> tuple[JointProperties, ...]:
    """Returns the properties of each joint. `masses` (m, n, n) are mass matrices at poses of the whole joint box."""
    least = 1.0 / np.max(np.diagonal(np.linalg.inv(masses), axis1=1, axis2=2), axis=0)
    largest = np.max(np.diagonal(masses, axis1=1, axis2=2), axis=0)
    columns = (
        least,
        largest,
        *friction(arm),
        largest_gravity(arm),
        arm.encoder_counts(),
        band(arm),
        effort_limits(arm),
    )
    rows = zip(*columns, strict=True)
    return tuple(JointProperties((float(row[0]), float(row[1])), *map(float, row[2:])) for row in rows)


def friction(arm: Arm) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Computes the friction of each joint when only this joint moves.

    Returns:
        Dry friction (n,) that acts in both directions [N m, N], and viscous friction (n,) [N m s/rad, N s/m].
    """
    dry, viscous = np.zeros(arm.num_joints), np.zeros(arm.num_joints)
    for effect in arm.effects.friction:
        row = np.abs(joint_row(arm, effect.coordinate))
        if effect.kind == "viscous":
            viscous += effect.coefficient * row**2
        elif effect.kind != "presliding forward":  # this kind acts in one direction only
            dry += effect.coefficient * row
    return dry, viscous


def largest_gravity(arm: Arm) -> NDArray[np.float64]:
    """Returns the largest gravity torque (n,) of each joint over poses of the joint box [N m, N]."""
    poses = arm.sample_poses(POSES, np.random.default_rng(1))
    return np.asarray(np.abs(holding_torques(arm, poses)).max(axis=0))
