"""The JSON file of the dVRK's gravity compensation of a master arm, and its comparison with a model."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.export.dvrk_mtm_gravity_compensation import (
    MTM_JOINTS,
    NUM_GRAVITY,
    controller_regressor,
    controller_torque,
    unclipped_torque,
)
from dvrk_drake.models.arm import known_arms
from dvrk_drake.models.files import atomic_write, read_json_input
from dvrk_drake.models.schema_fault import number_fault, within

VERSION = "2.0"
NUM_JOINTS = 7
#: Ten terms of gravity, then 1, q, q^2, q^3, q^4 of each of the first six joints.
NUM_PARAMETERS = 40
_CONTROLLER = "GC_controller"
#: For people: the controller does not read it.
_ARM_NAME = "ARM_NAME"
#: Our names -> the file's, one of which is misspelled in the controller's source.
_KEYS = {
    "positive": "gc_dynamic_params_pos",
    "negative": "gc_dynamic_params_neg",
    "torque_upper": "safe_upper_torque_limit",
    "torque_lower": "safe_lower_torque_limit",
    "dead_band": "db_vel_vec",
    "saturation": "sat_vec_vec",
    "friction_ratio": "fric_comp_ratio_vec",
}
_LENGTHS = {"positive": NUM_PARAMETERS, "negative": NUM_PARAMETERS}
#: Not read by the controller: the sweep in which the file's data were collected [deg].
_SWEEP_KEYS = ("joint_position_lower_limit", "joint_position_upper_limit")

#: An MTM's are up to 24 N m: of the polynomials in the joint positions.
_PARAMETERS = within(-1e4, 1e4, "N m")


@dataclass(frozen=True, eq=False)
class GravityCompensationFile:
    """What the file holds; `export.dvrk_mtm_gravity_compensation` has the controller's formula.

    Attributes:
        positive, negative: (40,) parameters for positive and negative joint velocity.
        torque_lower, torque_upper: (7,) clip of the torque [N m].
        dead_band: (7,) speed [rad/s] up to which positive and negative count alike.
        saturation: (7,) speed [rad/s] from which they differ by the full `friction_ratio`.
        friction_ratio: (7,) share 0..1 of the friction that is compensated in motion.
        sweep: (2, 7) lower and upper joint positions [rad] between which the file's data were collected, if it says so.
        arm_name: the arm that the file states (ARM_NAME), or else that its file name contains; "" if neither names one.
    """

    positive: NDArray[np.float64] = field(metadata=_PARAMETERS)
    negative: NDArray[np.float64] = field(metadata=_PARAMETERS)
    torque_lower: NDArray[np.float64] = field(metadata=within(-100.0, 100.0, "N m"))
    torque_upper: NDArray[np.float64] = field(metadata=within(-100.0, 100.0, "N m"))
    dead_band: NDArray[np.float64] = field(metadata=within(0.0, 10.0, "rad/s"))
    saturation: NDArray[np.float64] = field(metadata=within(1e-6, 100.0, "rad/s"))
    friction_ratio: NDArray[np.float64] = field(metadata=within(0.0, 1.0))
    sweep: NDArray[np.float64] | None = field(default=None, metadata=within(-12.6, 12.6, "rad"))
    arm_name: str = ""

    def check(self) -> None:
        """What the controller does not check before it commands motors: lengths, finite numbers, order.

        Raises:
            ModelError: names the file's field, and what is allowed.
        """
        for name, key in _KEYS.items():
            length = _LENGTHS.get(name, NUM_JOINTS)
            value = getattr(self, name)
            if value.shape != (length,) or not np.all(np.isfinite(value)):
                raise ModelError(f"{key} must be {length} finite numbers")
        if fault := number_fault(self):
            name = fault.split("[")[0]
            raise ModelError(fault.replace(name, _KEYS.get(name, name), 1))
        if not np.all(self.torque_lower <= self.torque_upper):
            raise ModelError("safe_lower_torque_limit must not exceed safe_upper_torque_limit")
        if not np.all(self.dead_band < self.saturation):
            raise ModelError("db_vel_vec must be below sat_vec_vec [rad/s]")

    @classmethod
    def load(cls, path: str | Path) -> GravityCompensationFile:
        """Reads a file of the controller.

        Raises:
            ModelError: no such file, not JSON, another version, or a field that is missing or wrong.
        """
        content = read_json_input(path, ModelError)
        controller = content.get(_CONTROLLER) if isinstance(content, dict) else None
        if not isinstance(controller, dict):
            raise ModelError(f"{path}: has no {_CONTROLLER}: not a gravity-compensation file of the dVRK")
        if content.get("version") != VERSION:
            raise ModelError(f'{path}: version is {content.get("version")!r}, this reads "{VERSION}"')
        if missing := [key for key in _KEYS.values() if key not in controller]:
            raise ModelError(f"{path}: {_CONTROLLER} lacks {', '.join(missing)}")
        file = cls(
            **{name: _numbers(controller[key]) for name, key in _KEYS.items()},
            sweep=_sweep(controller),
            arm_name=_arm_name(content.get(_ARM_NAME), Path(path).name),
        )
        try:
            file.check()
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
        return file

    def save(self, path: str | Path, arm_name: str, origin: str) -> None:
        """Writes the file at once or not at all.

        Args:
            path: where to.
            arm_name: as the dVRK names the arm, e.g. "MTML"; for people, the controller does not read it.
            origin: what the numbers come from, likewise.

        Raises:
            ModelError: the numbers are not what the controller needs.
        """
        self.check()
        lines = [f'    "{key}": {json.dumps(getattr(self, name).tolist())}' for name, key in _KEYS.items()]
        with atomic_write(path) as stream:
            stream.write(
                f'{{\n  "version": "{VERSION}",\n  "{_ARM_NAME}": {json.dumps(arm_name)},\n'
                f'  "origin": {json.dumps(origin)},\n  "{_CONTROLLER}": {{\n' + ",\n".join(lines) + "\n  }\n}\n"
            )


def _numbers(value: object) -> NDArray[np.float64]:
    try:
        return np.atleast_1d(np.array(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)  # refused by check(), which names the field


def _arm_name(stated: object, file_name: str) -> str:
    """Returns the stated name, or that of an arm of this project in the name of the file."""
    if isinstance(stated, str) and stated:
        return stated
    return next((name.upper() for name in known_arms() if name in file_name.lower()), "")


def _sweep(controller: dict) -> NDArray[np.float64] | None:
    bounds = [_numbers(controller.get(key)) for key in _SWEEP_KEYS]
    if any(b.shape != (NUM_JOINTS,) or not np.all(np.isfinite(b)) for b in bounds):
        return None
    return np.deg2rad(np.array(bounds))


#: Signs of the joints, and of their torques, in the mirror image of an arm: a left MTM's wrist is a right one's.
_MIRROR = np.array([-1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0])
#: Joints whose torque tells the side: shoulder_pitch, elbow_pitch and wrist_platform carry the wrist's brackets.
_TELLS_SIDE = slice(1, 4)
#: The mirror image fits clearly better if its error is below this share; of the four public files the wrong
#: side has 1.8 to 2.1 times the error of the right one.
_CLEARLY_BETTER = 0.8
_LEAST_POSES = 200
#: A torque below this share of the model's largest on that joint has no sign that matters.
SIGN_SHARE = 0.1
POSES = 20000


@dataclass(frozen=True)
class JointComparison:
    """One joint over the joint box, at rest; torques in N m, shares 0..1 of the poses.

    Attributes:
        name: of the joint.
        model_lower, model_upper: range of the model's torque.
        file_lower, file_upper: range of the file's torque before its clip.
        clip_lower, clip_upper: the file's limits.
        clipped: share of poses at which the clip is active: there the file's torque is a constant.
        opposed: share of poses at which file (clipped) and model push opposite ways, both by more than a tenth of the
            model's largest torque.
        runaway: share of poses at which the file (unclipped) lies outside the model's range widened by half of it on
            both sides: a torque that the model has nowhere on this joint. Not of the last joint, which no file has.
        polynomial: largest |torque| of the file's polynomial in the joint's own position, constant left out.
        rms_inside, rms_outside: RMS of file (clipped) less model inside and outside of the sweep that the file says
            its data are from; if it does not say, all poses are outside. NaN where there are no such poses.
    """

    name: str
    model_lower: float
    model_upper: float
    file_lower: float
    file_upper: float
    clip_lower: float
    clip_upper: float
    clipped: float
    opposed: float
    runaway: float
    polynomial: float
    rms_inside: float
    rms_outside: float


@dataclass(frozen=True, eq=False)
class CompensationComparison:
    """A file and a model at the same random poses of the joint box.

    Attributes:
        file, model: what was compared.
        joints: one a joint.
        q: (m, 7) poses [rad], inside the joint box and the coupled limits.
        model_torque, file_torque, clipped_torque: (m, 7) [N m] at rest; `file_torque` before the clip.
        clipped, opposed, runaway: (m, 7) True where `JointComparison` counts the pose.
        in_sweep: (m,) True where all of the first six joints are inside the file's sweep.
        other_side: the mirror image of the model fits the file clearly better: the file is one of the other side's arm.
    """

    file: GravityCompensationFile
    model: IdentifiedModel
    joints: list[JointComparison]
    q: NDArray[np.float64]
    model_torque: NDArray[np.float64]
    file_torque: NDArray[np.float64]
    clipped_torque: NDArray[np.float64]
    clipped: NDArray[np.bool_]
    opposed: NDArray[np.bool_]
    runaway: NDArray[np.bool_]
    in_sweep: NDArray[np.bool_]
    other_side: bool

    def as_dict(self) -> dict:
        """For JSON; NaN becomes None."""
        joints = [{k: None if v != v else v for k, v in asdict(j).items()} for j in self.joints]
        return {
            "poses": len(self.q),
            "other_side": self.other_side,
            "share_in_sweep": float(self.in_sweep.mean()),
            "joints": joints,
        }


def compare_compensation(file: GravityCompensationFile, model: IdentifiedModel) -> CompensationComparison:
    """Compares at random poses, uniform in the joint box and inside the coupled limits.

    Raises:
        ModelError: the model is not of an MTM, or the file is named as one of another arm of this project.
    """
    arm = model.load_arm()
    if arm.joint_names != MTM_JOINTS:
        raise ModelError(f"{arm.name}: a gravity-compensation file of the dVRK is one of an MTM; joints differ")
    known = [name.upper() for name in known_arms()]
    if file.arm_name.upper() != arm.name.upper() and {file.arm_name.upper(), arm.name.upper()} <= set(known):
        raise ModelError(
            f"the file is of {file.arm_name}, by its ARM_NAME or its file name, but the model is of {arm.name}, and "
            f"their torques differ. Use a model of {file.arm_name}; if the name is wrong, correct it in the file"
        )
    q = arm.sample_poses(POSES, np.random.default_rng(0))
    tau_model, tau_raw, tau_clipped = model.holding_torque(q), unclipped_torque(file, q), controller_torque(file, q)
    half_range = 0.5 * np.ptp(tau_model, axis=0)
    least = SIGN_SHARE * np.abs(tau_model).max(axis=0)
    clipped = tau_raw != tau_clipped
    opposed = (tau_model * tau_clipped < 0) & (np.abs(tau_model) > least) & (np.abs(tau_clipped) > least)
    runaway = (tau_raw < tau_model.min(axis=0) - half_range) | (tau_raw > tau_model.max(axis=0) + half_range)
    # A joint without gravity has no range to leave, and for the last joint the file says nothing.
    judged = (half_range > 1e-9) & (np.arange(NUM_JOINTS) < NUM_JOINTS - 1)
    runaway, opposed = runaway & judged, opposed & judged
    in_sweep = np.zeros(len(q), dtype=bool)
    if file.sweep is not None:
        # The last joint does not enter the file's torque.
        in_sweep = np.all(
            (q >= file.sweep[0]) & (q <= file.sweep[1]), axis=1, where=np.arange(NUM_JOINTS) < NUM_JOINTS - 1
        )
    polynomial = _polynomial_torque(file, q)
    error = tau_clipped - tau_model
    joints = [
        JointComparison(
            name=name,
            model_lower=float(tau_model[:, j].min()),
            model_upper=float(tau_model[:, j].max()),
            file_lower=float(tau_raw[:, j].min()),
            file_upper=float(tau_raw[:, j].max()),
            clip_lower=float(file.torque_lower[j]),
            clip_upper=float(file.torque_upper[j]),
            clipped=float(clipped[:, j].mean()),
            opposed=float(opposed[:, j].mean()),
            runaway=float(runaway[:, j].mean()),
            polynomial=float(np.abs(polynomial[:, j]).max()),
            rms_inside=_rms(error[in_sweep, j]),
            rms_outside=_rms(error[~in_sweep, j]),
        )
        for j, name in enumerate(arm.joint_names)
    ]
    return CompensationComparison(
        file,
        model,
        joints,
        q,
        tau_model,
        tau_raw,
        tau_clipped,
        clipped,
        opposed,
        runaway,
        in_sweep,
        other_side=_is_of_other_side(model, q, tau_clipped, in_sweep),
    )


def _is_of_other_side(
    model: IdentifiedModel, q: NDArray[np.float64], tau_file: NDArray[np.float64], in_sweep: NDArray[np.bool_]
) -> bool:
    """Whether the mirror image of the model fits a file's torque clearly better, where the file has data if it says."""
    if np.count_nonzero(in_sweep) >= _LEAST_POSES:
        q, tau_file = q[in_sweep], tau_file[in_sweep]
    own, mirrored = model.holding_torque(q), _MIRROR * model.holding_torque(_MIRROR * q)
    return _side_error(tau_file, mirrored) < _CLEARLY_BETTER * _side_error(tau_file, own)


def _side_error(tau_file: NDArray[np.float64], tau_model: NDArray[np.float64]) -> float:
    """RMS error over the joints that tell the side, each as a share of the RMS of the file's torque."""
    size = np.sqrt(np.mean(tau_file[:, _TELLS_SIDE] ** 2, axis=0)) + 1e-12
    return _rms((tau_file - tau_model)[:, _TELLS_SIDE] / size)


def _polynomial_torque(file: GravityCompensationFile, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, 7) what the powers q .. q^4 add at rest [N m]."""
    parameters = (file.positive + file.negative) / 2
    parameters[:NUM_GRAVITY] = 0.0
    parameters[NUM_GRAVITY::5] = 0.0
    return controller_regressor(q) @ parameters


def _rms(x: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else float("nan")
