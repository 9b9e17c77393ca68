"""Model-based design of gains from the mass matrix, friction, encoders, motors and delay."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.errors import ControllerError
from dvrk_drake.experiments.tuning_bench import band, effort_limits, rounded_gains
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.plant import holding_torques, make_arm_plant, set_arm_positions, tree_selector


@dataclass(frozen=True)
class Sampling:
    """Sampling and delay of the control loop.

    Attributes:
        period: Sample period of measurements and controller [s].
        ticks: Number of periods between a measurement and its effort.
        cut_off: Cut-off frequency of the low-pass filter of the velocity [Hz]; infinite for no filter.
    """

    period: float = 1e-3
    ticks: int = 2
    cut_off: float = 30.0

    @property
    def decay(self) -> float:
        """Weight of the previous value in the low-pass filter of the velocity."""
        return math.exp(-2.0 * math.pi * self.cut_off * self.period)

    @property
    def position_lag(self) -> float:
        """Mean delay between a position and its effort, including the zero-order hold [s]."""
        return (self.ticks + 0.5) * self.period

    @property
    def velocity_lag(self) -> float:
        """Mean delay between a velocity and its effort, including difference quotient and low-pass filter [s]."""
        return self.position_lag + (0.5 + self.decay / (1.0 - self.decay)) * self.period


@dataclass(frozen=True)
class Margins:
    """Stability margins of the control loop of one joint, opened at the motor.

    Attributes:
        phase: Smallest phase margin over all crossover frequencies [rad]; 0 for an unstable loop.
        crossover: Crossover frequency of the smallest phase margin [rad/s].
        gain: Gain margin: factor of the loop gain at which the loop becomes unstable.
    """

    phase: float
    crossover: float
    gain: float


class SampledLoop:
    """Linear closed loop of n joints with mass matrix M, viscous friction b and a PID controller.

    Between two samples M vd = u - b v. The effort is u = -Kp q - Kd v_e - Ki h sum(q) with the velocity estimate
    v_e and the sample period h, as in GravityPidController for the desired position 0. u is computed from the
    measurement `ticks` periods earlier, and is constant for one period. Gravity is compensated exactly. v_e is computed
    as in `systems.arm_effects.drive_step.DriveStep`.
    """

    def __init__(self, M: ArrayLike, sampling: Sampling, viscous: ArrayLike = 0.0) -> None:
        """Discretises the joints with mass matrix M (n, n) [kg m^2; kg] and `viscous` (n,) [N m s/rad; N s/m]."""
        from scipy.signal import cont2discrete  # takes 0.3 s

        self._M = np.atleast_2d(np.asarray(M, float))
        n = self._n = len(self._M)
        self._sampling = sampling
        M_inverse = np.linalg.inv(self._M)
        b = np.diag(np.broadcast_to(np.asarray(viscous, float), n))
        zero, eye = np.zeros((n, n)), np.eye(n)
        A = np.block([[zero, eye], [zero, -M_inverse @ b]])
        self._plant = cont2discrete((A, np.vstack([zero, M_inverse]), np.eye(2 * n), 0), sampling.period)[:2]

    def closed_loop(self, gains: Gains) -> NDArray[np.float64]:
        """Returns the matrix A of the closed loop, x[k+1] = A x[k].

        The state x (n (5 + 2 ticks),) consists of q and v, the last measured position and velocity estimate, the
        delayed measurements (oldest first), and the integral as an effort.
        """
        size = self._n * (5 + 2 * self._sampling.ticks)
        return np.column_stack([self._advance(x, gains) for x in np.eye(size)])

    def at_rest(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the state of the loop for joints at rest at q (n,) [rad, m]."""
        still = np.concatenate([np.broadcast_to(np.asarray(q, float), self._n), np.zeros(self._n)])
        return np.concatenate([np.tile(still, 2 + self._sampling.ticks), np.zeros(self._n)])

    def _advance(self, x: NDArray[np.float64], gains: Gains) -> NDArray[np.float64]:
        n, h, decay = self._n, self._sampling.period, self._sampling.decay
        plant, memory, queue, integral = np.split(x, [2 * n, 4 * n, len(x) - n])
        reading = plant[:n]
        velocity = decay * memory[n:] + (1.0 - decay) * (reading - memory[:n]) / h
        measured = np.concatenate([reading, velocity])
        queue = np.concatenate([queue, measured])
        q, v = queue[:n], queue[n : 2 * n]
        integral = integral - h * np.asarray(gains.ki) * q
        effort = integral - np.asarray(gains.kp) * q - np.asarray(gains.kd) * v
        A, B = self._plant
        return np.concatenate([A @ plant + B @ effort, measured, queue[2 * n :], integral])

    def is_stable(self, gains: Gains) -> bool:
        """Returns whether the closed loop is asymptotically stable."""
        return bool(np.max(np.abs(np.linalg.eigvals(self.closed_loop(gains)))) < 1.0)

    def least_damped_mode(self, gains: Gains) -> tuple[float, NDArray[np.float64]]:
        """Returns the growth factor per period of the least damped mode, and each joint's share (n,) of its energy.

        The energy is the kinetic energy without the coupling terms of the mass matrix.
        """
        z, modes = np.linalg.eig(self.closed_loop(gains))
        worst = int(np.argmax(np.abs(z)))
        v = np.abs(modes[self._n : 2 * self._n, worst])
        energy = np.diag(self._M) * v**2
        return float(np.abs(z[worst])), energy / max(energy.sum(), np.finfo(float).tiny)

    def margins(self, gains: Gains) -> Margins:
        """Computes the stability margins. The loop must have one joint."""
        assert self._n == 1
        h, decay = self._sampling.period, self._sampling.decay
        w = np.geomspace(1e-2, np.pi / h, 4000)
        z = np.exp(1j * w * h)
        (A, B), eye = self._plant, np.eye(2)
        plant = np.linalg.solve(z[:, None, None] * eye - A, np.broadcast_to(B, (len(z), 2, 1)))[:, 0, 0]
        velocity = (1 - decay) / (1 - decay / z) * (1 - 1 / z) / h
        law = gains.kp[0] + gains.kd[0] * velocity + gains.ki[0] * h / (1 - 1 / z)
        loop = law * plant / z**self._sampling.ticks
        stable = self.is_stable(gains)
        size, phase = np.abs(loop), np.unwrap(np.angle(loop))
        crossings = np.flatnonzero((size[:-1] >= 1) & (size[1:] < 1))
        # At low frequency, the phase of a double integrator is -pi. With an integral term, it is -3 pi / 2.
        margins = [abs((phase[i] + 2 * np.pi) % (2 * np.pi) - np.pi) for i in crossings]
        turns = np.flatnonzero(np.diff(np.sign(np.imag(loop))) * (np.real(loop[:-1]) < 0))
        amplify = [1 / size[i] for i in turns if size[i] < 1]
        if not stable or not margins:
            return Margins(0.0, float(w[crossings[-1]]) if len(crossings) else 0.0, 1.0)
        least = int(np.argmin(margins))
        return Margins(float(margins[least]), float(w[crossings[least]]), float(min(amplify, default=np.inf)))


def place(
    inertia: float, frequency: float, damping_ratio: float, sampling: Sampling, viscous: float = 0.0
) -> tuple[float, float]:
    """Computes kp and kd for a given natural frequency and damping ratio of one joint, including the delays.

    To second order in s, a lag T of the position reduces the damping by Kp T, and a lag T_v of the velocity reduces
    the inertia by Kd T_v: (M - Kd T_v + Kp T^2 / 2) s^2 + (b + Kd - Kp T) s + Kp = 0. The left side equals
    m (s^2 + 2 z w s + w^2) if m (1 + (2 z w + w^2 T) T_v - w^2 T^2 / 2) = M + b T_v, Kp = m w^2, and
    Kd = 2 z w m + Kp T - b. A negative kd is replaced by zero.

    Args:
        inertia: Inertia M [kg m^2; kg].
        frequency: Natural frequency w [rad/s]. The result is accurate if w is far below the inverse of the lags.
        damping_ratio: Damping ratio z.
        sampling: Sampling that determines the lags.
        viscous: Viscous friction b of the joint [N m s/rad; N s/m].

    Returns:
        kp and kd.
    """
    w, z, T, T_v = frequency, damping_ratio, sampling.position_lag, sampling.velocity_lag
    m = (inertia + viscous * T_v) / (1.0 + (2.0 * z * w + w**2 * T) * T_v - 0.5 * (w * T) ** 2)
    kp = m * w**2
    return kp, max(2.0 * z * w * m + kp * T - viscous, 0.0)


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
