"""Gravity-compensation file of the dVRK's controller for a PSM.

The file models the linkage as a serial chain with seven links. The controller sets the joint positions of the chain to
[q1, 0, q2, -q2, q2, q3/2, q3/2], where q1, q2 and q3 are yaw, pitch and insertion. The controller computes the holding
torques t1..t7 of the chain, and applies [t1, t3 - t4 + t5, t7] to yaw, pitch and insertion.

Link 3 is the back crank, link 4 is the bottom bar and link 5 is the end link. The chain has no links for the other bars
of the parallelograms and for the counterweight. The first moments of links 1, 3, 4 and 5 therefore include these parts.
The mass of link 7 is the mass that moves with the insertion joint, minus the mass that the counterweight balances.
Link 6 moves at half of the insertion speed, and t7 does not include its weight. It has a mass only if the feedforward
of insertion is disabled. Link 7 then has none, so the torque of insertion is 0. Both have none if the net mass is
negative, because the controller requires masses of at least 0.

The controller computes the direction of gravity in the base frame from the angle `mounting_pitch`, which is not part of
the file but of the arm's configuration beside it. This angle describes a rotation about the x axis of the base only.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia
from dvrk_drake.dynamics.model_links import model_bodies
from dvrk_drake.errors import ModelError
from dvrk_drake.export.gravity_compensation_loss import CompensationLoss, accepted_differences, make_loss
from dvrk_drake.models.arm import Arm, mount_gravity
from dvrk_drake.models.files import atomic_write, read_json_input
from dvrk_drake.models.plant import shared_plant

ARM_JOINTS = ("yaw", "pitch", "insertion")
NAMES = ("yaw", "intermediate yaw", "pitch 1", "pitch 2", "pitch 3", "insertion 1", "insertion 2")
#: Matrix from yaw, pitch and insertion to the joint positions of the chain.
CHAIN_FROM_ARM = np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [0, -1, 0], [0, 1, 0], [0, 0, 0.5], [0, 0, 0.5]])
#: Matrix from the joint torques of the chain to those of yaw, pitch and insertion.
ARM_FROM_CHAIN = np.array([[1, 0, 0, 0, 0, 0, 0], [0, 0, 1, -1, 1, 0, 0], [0, 0, 0, 0, 0, 0, 1]])
PRISMATIC = np.array([False] * 5 + [True] * 2)
#: Sideways tilt [rad] above which it is named as the cause of a difference. It is below the last digit of a gravity
#: vector that is given with six digits.
_LEAST_TILT = 1e-6
#: Keys of an arm's configuration for the compensation file and for the angle: since dVRK 2.4, and before.
_FILE_KEYS, _PITCH_KEYS = ("kinematic_gc", "kinematic-gc"), ("mounting_pitch", "mounting-pitch")
#: Index of a link of the chain -> bodies of the arm that it represents.
_BODIES = {
    0: ("yaw_link",),
    2: ("back_crank_link", "front_crank_link"),
    3: ("bottom_bar_link", "top_bar_link"),
    4: ("end_link",),
}
#: Indices of the links whose first moments are fitted. The first moments of the last link are computed from the bodies
#: that move with the insertion joint.
_FITTED = tuple(_BODIES)
_LAST = 6


@dataclass(frozen=True, eq=False)
class KinematicCompensation:
    """Chain of seven links for the dVRK's controller, in the modified Denavit-Hartenberg (DH) convention.

    The pose of the frame of link i in the frame of link i - 1 is Rx(alpha) Tx(A) Rz(theta) Tz(D).

    Attributes:
        alpha, A, theta, D: DH parameters (7,) at zero joint positions [rad, m].
        mass: Masses (7,) [kg].
        center: Centres of mass (7, 3) in the DH frames of the links [m].
        mounting_pitch: Angle [rad] that the arm's configuration must contain, see `controller_gravity`.
        configured_pitch: Angle [rad] in the arm's configuration, None if no configuration is known.
        loss: Largest differences between the torques of file and model on yaw, pitch and insertion. The torques of the
            file are computed with the controller's gravity for `configured_pitch`, or else for `mounting_pitch`, with a
            straight instrument (all instrument joints at zero) or with the instrument joints at their locked positions.
        wrist: Largest changes (3,) of the model's torques on these joints due to the positions of the instrument
            joints [N m, N m, N]. The file does not represent these changes. Not meaningful if the instrument joints are
            locked.
    """

    alpha: NDArray[np.float64]
    A: NDArray[np.float64]
    theta: NDArray[np.float64]
    D: NDArray[np.float64]
    mass: NDArray[np.float64]
    center: NDArray[np.float64]
    mounting_pitch: float
    loss: CompensationLoss
    wrist: NDArray[np.float64]
    configured_pitch: float | None = None

    def save(self, path: str | Path) -> None:
        """Writes the file atomically."""
        joints = [
            {
                "name": name,
                "alpha": self.alpha[i],
                "A": self.A[i],
                "theta": self.theta[i],
                "D": self.D[i],
                "type": "prismatic" if PRISMATIC[i] else "revolute",
                "mode": "passive" if i == 1 else "active",
                "mass": self.mass[i],
                **dict(zip(("cx", "cy", "cz"), self.center[i].tolist(), strict=True)),
            }
            for i, name in enumerate(NAMES)
        ]
        with atomic_write(path) as stream:
            json.dump({"DH": {"convention": "modified", "joints": joints}}, stream, indent=2)
            stream.write("\n")


def mounting_pitch(gravity: NDArray[np.float64]) -> float:
    """Returns the angle [rad] whose `controller_gravity` is closest in direction to a gravity vector (3,)."""
    return float(np.arctan2(-gravity[1], -gravity[2])) + 0.0


def controller_gravity(pitch: float) -> NDArray[np.float64]:
    """Returns the gravity vector (3,) in the base frame [m/s^2] that the controller computes from `mounting_pitch`.

    A positive pitch [rad] rotates the base about its x axis, so that gravity points to -y. PSM1 and PSM2 of a da Vinci
    Si have a pitch of -45 degrees. Source: mtsIntuitiveResearchKitArm.cpp of sawIntuitiveResearchKit 2.4.0, which
    computes the opposite vector (0, sin(pitch), cos(pitch)) * 9.81.
    """
    return np.array(mount_gravity(pitch))


def configuration_beside(path: str | Path) -> Path | None:
    """Returns the arm's configuration in the folder of a compensation file. Its key `kinematic_gc` names the file."""
    for other in sorted(Path(path).parent.glob("*.json")):
        with suppress(ModelError):
            content = read_json_input(other, ModelError)
            names = [content.get(key) for key in _FILE_KEYS] if isinstance(content, dict) else []
            if any(isinstance(name, str) and Path(name).name == Path(path).name for name in names):
                return other
    return None


def configured_pitch(path: str | Path) -> float:
    """Returns `mounting_pitch` [rad] of an arm's configuration. The controller uses 0 if the key is missing.

    Raises:
        ModelError: The file is missing or not a JSON object, or the value is not an angle in rad.
    """
    content = read_json_input(path, ModelError)
    if not isinstance(content, dict):
        raise ModelError(f"{path}: is not a configuration of an arm, because it is not a JSON object")
    given = [(key, content[key]) for key in _PITCH_KEYS if key in content]
    for key, value in given:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (is_number and abs(value) <= np.pi):
            raise ModelError(f"{path}: {key} is {json.dumps(value)[:30]}; allowed: a number from -pi to pi [rad]")
    return float(given[0][1]) if given else 0.0


def _sideways_tilt(gravity: NDArray[np.float64]) -> float:
    """Returns the angle [rad] between a gravity vector (3,) and the y-z plane of the base."""
    return float(np.arcsin(abs(gravity[0]) / np.linalg.norm(gravity)))


def is_psm(arm: Arm) -> bool:
    """Returns whether the format supports the arm: a PSM with the links of this package."""
    return arm.joint_names[:3] == ARM_JOINTS and shared_plant(arm).HasBodyNamed("counterweight_link")


def kinematic_compensation(
    model: IdentifiedModel, tolerance: float | None = None, configuration: str | Path | None = None
) -> KinematicCompensation:
    """Converts the gravity torque of yaw, pitch and insertion to the controller's chain, for a straight instrument.

    If the instrument joints of the model are locked, the chain represents the instrument at the locked positions.

    Args:
        model: Model of a PSM.
        tolerance: Largest accepted difference between the torques of the file and of the model on any joint [N m, N].
            Joint effects, feedforward scales below 1 and a sideways tilt of the base cause differences. None: the dry
            friction of each joint, see `gravity_compensation_loss.accepted_differences`.
        configuration: Configuration of the arm in the dVRK, whose `mounting_pitch` the controller uses. None: the
            configuration will contain the `mounting_pitch` of the result.

    Raises:
        ModelError: The model is not of a PSM, the net mass on the insertion joint is negative and its weight exceeds
            `tolerance`, a torque difference exceeds `tolerance`, or the configuration is invalid.
    """
    arm = model.arm
    plant = shared_plant(arm)
    if not is_psm(arm):
        raise ModelError(
            f"{arm.name} is not a PSM. The format dvrk-kinematic-gc supports only a PSM; for an MTM, use dvrk-gc"
        )
    accepted = accepted_differences(arm, tolerance)[: len(ARM_JOINTS)]
    _refuse_disabled_joints(model)
    alpha, A, theta, D = _chain(plant)
    q = arm.sample_poses(600, np.random.default_rng(0))
    straight = np.where(np.arange(arm.num_joints) < 3, q, 0.0)
    beta = np.array([p.value for p in model.base_parameters])
    gravity = (model.static_model.regressor(straight)[:, :, : len(beta)] @ beta)[:, :3]
    tau = model.feedforward_scale[:3] * gravity
    # (m, 3, 7, 4): torque of yaw, pitch and insertion per unit of the mass and of the first moments of each link.
    frames = [_frames(alpha, A, theta, D, pose) for pose in straight[:, :3]]
    pitch = mounting_pitch(arm.gravity)
    Y = np.array([_regressor(X, controller_gravity(pitch)) for X in frames])
    mass, moment = _initial_links(model_bodies(model).links, plant, _frames(alpha, A, theta, D, np.zeros(3)))
    mass_column = Y[:, 2, _LAST, 0]
    is_off = model.feedforward_scale[2] == 0
    net = float(mass_column @ (gravity if is_off else tau)[:, 2] / (mass_column @ mass_column))
    if not is_off and -net * np.abs(mass_column).max() > accepted[2]:
        raise ModelError(
            f"{arm.name}: the net mass on the insertion joint is {net:.3g} kg because of the counterweight. The "
            "controller's file requires a positive mass; check the base parameters of the model"
        )
    if is_off or net <= 0:
        # Link 6 moves at half of the insertion speed, and its weight does not act on the insertion joint of the file.
        mass[_LAST], mass[_LAST - 1], moment[_LAST] = 0.0, 2 * max(net, 0.0), 0.0
    else:
        moment[_LAST] *= net / mass[_LAST]
        mass[_LAST] = net
    known = np.concatenate([mass[:, None], moment], axis=1)
    unknown = Y[:, :, _FITTED, 1:].reshape(tau.size, -1)
    step = np.linalg.lstsq(unknown, (tau - np.einsum("mjlk,lk->mj", Y, known)).ravel(), rcond=1e-9)[0]
    known[_FITTED, 1:] += step.reshape(-1, 3)
    tau_model = model.holding_torque(straight)[:, :3]
    installed = None if configuration is None else configured_pitch(configuration)
    tau_pitch = tau_file = np.einsum("mjlk,lk->mj", Y, known)
    if installed is not None:
        Y = np.array([_regressor(X, controller_gravity(installed)) for X in frames])
        tau_file = np.einsum("mjlk,lk->mj", Y, known)
    tilt = _sideways_tilt(arm.gravity)
    if tilt > _LEAST_TILT:
        cause = f"sideways base tilt of {np.rad2deg(tilt):.2g} deg, which mounting_pitch cannot express"
    else:
        cause = "feedforward scale other than 1" if net > 0 else "negative net mass on the insertion joint"
    causes = {cause: tau_pitch - tau, **_omitted_effects(model, straight)}
    if installed is not None:
        setting = f"mounting_pitch is {installed:.6g} rad, but the gravity vector of the model requires {pitch:.6g} rad"
        causes[setting] = tau_file - tau_pitch
        if np.any((wrong := np.abs(tau_file - tau_pitch).max(axis=0)) > accepted):
            j = int(np.argmax(wrong / accepted))
            raise ModelError(
                f"{configuration}: {setting}. The controller's torque of {ARM_JOINTS[j]} would be wrong by up to "
                f"{wrong[j]:.2g} {'N' if arm.prismatic[j] else 'N m'}. Correct the configuration, or identify again "
                "with the gravity vector of this mounting (--gravity)"
            )
    loss = make_loss(arm, straight, tau_file - tau_model, causes)
    loss.check(accepted)
    center = np.divide(known[:, 1:], mass[:, None], out=np.zeros((7, 3)), where=mass[:, None] > 0)
    wrist = np.abs(model.holding_torque(q)[:, :3] - tau_model).max(axis=0)
    return KinematicCompensation(alpha, A, theta, D, mass, center, pitch, loss, wrist, installed)


def _refuse_disabled_joints(model: IdentifiedModel) -> None:
    """Raises ModelError if yaw or pitch has no feedforward. The file can omit the torque of insertion only."""
    scale = model.feedforward_scale[:2]
    if off := [name for name, s in zip(ARM_JOINTS, scale, strict=False) if s == 0]:
        raise ModelError(
            f"{model.arm.name}: the feedforward is disabled for {', '.join(off)}, but the controller's file always "
            "compensates gravity on yaw and pitch. Identify a model from a recording in which they move"
        )


def _omitted_effects(model: IdentifiedModel, q: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Returns the difference (m, 3) that the omission of each effect causes at the poses q (m, n)."""
    gravity = len(model.base_parameters)
    torque = model.feedforward_scale[:, None] * model.static_model.regressor(q)[:, :, gravity:] * model.theta[gravity:]
    return {f"effect {ActuatorEffect.of(e)}": -torque[:, :3, i] for i, e in enumerate(model.holding_effects)}


def _chain(plant: MultibodyPlant) -> tuple[NDArray[np.float64], ...]:
    """Returns alpha, A, theta and D (7,) from the joint frames of the SDF at zero positions.

    The linkage moves in the plane x = 0 of the base frame.
    """
    context = plant.CreateDefaultContext()
    p_A, p_B, p_E = (
        plant.GetJointByName(name).frame_on_child().CalcPoseInWorld(context).translation()
        for name in ("pitch", "bottom_bar", "end")
    )
    p_3 = plant.GetFrameByName("dh_3").CalcPoseInWorld(context).translation()
    crank, bar = p_B - p_A, p_E - p_B
    # Frame 2 has its origin at the remote centre of motion. Its x, y and z axes are -y, z and -x of the base frame.
    crank_angle, bar_angle = (np.arctan2(v[2], -v[1]) for v in (crank, bar))
    half, whole = np.pi / 2, np.pi
    alpha = np.array([half, -half, 0, 0, 0, -half, 0])
    A = np.array([0, 0, -p_A[1], np.linalg.norm(crank), np.linalg.norm(bar), -p_E[1], 0])
    theta = np.array([half, -half, crank_angle, bar_angle - crank_angle, whole - bar_angle, 0, 0])
    D = np.array([0, 0, 0, 0, 0, 0, p_E[2] - p_3[2]])
    return alpha, A, theta, D


def _frames(
    alpha: NDArray[np.float64],
    A: NDArray[np.float64],
    theta: NDArray[np.float64],
    D: NDArray[np.float64],
    q: ArrayLike,
) -> NDArray[np.float64]:
    """Returns the poses X_0i (7, 4, 4) of the link frames at the positions q (3,) of yaw, pitch and insertion."""
    chain = CHAIN_FROM_ARM @ np.asarray(q, dtype=np.float64)
    X, frames = np.eye(4), []
    for i in range(len(NAMES)):
        angle, distance = (theta[i], D[i] + chain[i]) if PRISMATIC[i] else (theta[i] + chain[i], D[i])
        (sa, ca), (st, ct) = ((np.sin(x), np.cos(x)) for x in (alpha[i], angle))
        X = X @ np.array(
            [
                [ct, -st, 0, A[i]],
                [st * ca, ct * ca, -sa, -sa * distance],
                [st * sa, ct * sa, ca, ca * distance],
                [0, 0, 0, 1],
            ]
        )
        frames.append(X)
    return np.array(frames)


def _regressor(X: NDArray[np.float64], gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the holding torques (3, 7, 4) of yaw, pitch and insertion for unit masses and unit first moments.

    The second index is the link. The third index is the mass or one of three first moments. X (7, 4, 4) are the poses
    of the link frames, and `gravity` (3,) is in the base frame [m/s^2].
    """
    chain = np.zeros((len(NAMES), len(NAMES), 4))
    for joint in range(len(NAMES)):
        z, origin = X[joint, :3, 2], X[joint, :3, 3]
        for link in range(joint, len(NAMES)):
            R, p = X[link, :3, :3], X[link, :3, 3]
            if PRISMATIC[joint]:
                chain[joint, link, 0] = -z @ gravity
            else:
                # The torque of a unit mass at r = p - origin is -z . (r x g) = -(g x z) . r, which is linear in r.
                lever = -np.cross(gravity, z)
                chain[joint, link] = lever @ (p - origin), *(lever @ R)
    return np.einsum("jk,klm->jlm", ARM_FROM_CHAIN, chain)


def _initial_links(
    links: tuple[LinkInertia, ...], plant: MultibodyPlant, home: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns masses (7,) [kg] and first moments (7, 3) [kg m] of the links of the chain, before the fit.

    Each link has the mass of the bodies that it represents. The last link represents all bodies that move with the
    insertion joint. First moments are computed at zero joint positions and expressed in the DH frames, whose poses are
    `home` (7, 4, 4).
    """
    context = plant.CreateDefaultContext()
    by_name = {link.link: link.parameters for link in links}
    if missing := {name for names in _BODIES.values() for name in names} - set(by_name):
        raise ModelError(f"the SDF has no link {', '.join(sorted(missing))}, which a PSM must have")
    others = set(by_name) - {name for names in _BODIES.values() for name in names} - {"counterweight_link"}
    mass, moment = np.zeros(7), np.zeros((7, 3))
    for i, names in {**_BODIES, _LAST: tuple(others)}.items():
        X_0i = home[i]
        for name in names:
            m, h = by_name[name][0], by_name[name][1:4]
            X_0L = plant.GetBodyByName(name).EvalPoseInWorld(context)
            moment_0 = X_0L.rotation().matrix() @ h + m * (X_0L.translation() - X_0i[:3, 3])
            mass[i] += m
            moment[i] += X_0i[:3, :3].T @ moment_0
    return mass, moment
