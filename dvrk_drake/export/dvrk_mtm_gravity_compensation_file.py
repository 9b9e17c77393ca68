"""Gravity-compensation file of the dVRK's controller for an MTM, and the torque of the controller with this file."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm_files import known_arms
from dvrk_drake.models.files import atomic_write, read_json_input
from dvrk_drake.models.ranges import number_fault, within

#: Version of the files that `GravityCompensationFile.save` writes.
VERSION = "2.0"
NUM_JOINTS = 7
#: Number of parameters: ten for gravity, then five polynomial coefficients for each of the first six joints.
NUM_PARAMETERS = 40
_CONTROLLER = "GC_controller"
#: Key of the arm's name. The controller does not read this key.
_ARM_NAME = "ARM_NAME"
#: Field of `GravityCompensationFile` -> key in the file. "sat_vec_vec" is spelled as in the controller's source code.
_KEYS = {
    "positive": "gc_dynamic_params_pos",
    "negative": "gc_dynamic_params_neg",
    "torque_upper": "safe_upper_torque_limit",
    "torque_lower": "safe_lower_torque_limit",
    "dead_band": "db_vel_vec",
    "saturation": "sat_vec_vec",
    "friction_ratio": "fric_comp_ratio_vec",
}
#: Fields that a file of version 1 replaces by the speeds of the key `_AMPLITUDES` [rad/s].
_FRICTION_FIELDS = ("dead_band", "saturation", "friction_ratio")
_AMPLITUDES = "beta_vel_amplitude"
_LENGTHS = {"positive": NUM_PARAMETERS, "negative": NUM_PARAMETERS}
#: Keys of the lower and upper joint positions [deg] in the recording from which the file was computed. The controller
#: does not read these keys.
_SWEEP_KEYS = ("joint_position_lower_limit", "joint_position_upper_limit")

#: Allowed range of the parameters. Polynomial coefficients in public files are up to 24 N m.
_PARAMETERS = within(-1e4, 1e4, "N m")


@dataclass(frozen=True, eq=False)
class GravityCompensationFile:
    """Content of a gravity-compensation file of the controller.

    Attributes:
        positive, negative: Parameters (40,) for positive and negative joint velocities.
        torque_lower, torque_upper: Torque limits (7,) [N m].
        dead_band: Speeds (7,) [rad/s] below which both parameter vectors have equal weight.
        saturation: Speeds (7,) [rad/s] above which the weights differ by `friction_ratio`.
        friction_ratio: Share of the friction to compensate on each joint (7,) during a motion, 0 to 1. 0 for a file of
            version 1, which has another rule for motions. At rest, the torques of both versions are equal.
        sweep: Lower and upper joint positions (2, 7) [rad] in the recording from which the file was computed. None if
            the file does not contain these positions.
        arm_name: Name of the arm from the key ARM_NAME, or else from the file name. "" if neither contains a name.
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
        """Checks the length and the range of each field, and that lower values are below upper values.

        The controller does not make these checks before it commands the motors.

        Raises:
            ModelError: A field is invalid. The message contains the key and the allowed values.
        """
        for name, key in _KEYS.items():
            length = _LENGTHS.get(name, NUM_JOINTS)
            value = getattr(self, name)
            if value.shape != (length,) or not np.all(np.isfinite(value)):
                raise ModelError(f"{key} must be {length} finite numbers")
        if fault := number_fault(self):
            name = fault.split("[")[0]
            raise ModelError(fault.replace(name, _KEYS.get(name, name), 1))
        for joint in range(NUM_JOINTS):
            lower, upper = self.torque_lower[joint], self.torque_upper[joint]
            if lower > upper:
                raise ModelError(
                    f"safe_lower_torque_limit[{joint}] ({lower:g}) must not exceed "
                    f"safe_upper_torque_limit[{joint}] ({upper:g}) [N m]"
                )
            dead_band, saturation = self.dead_band[joint], self.saturation[joint]
            if dead_band >= saturation:
                raise ModelError(
                    f"db_vel_vec[{joint}] ({dead_band:g}) must be below sat_vec_vec[{joint}] ({saturation:g}) [rad/s]"
                )

    @classmethod
    def load(cls, path: str | Path) -> GravityCompensationFile:
        """Reads a file of version 1 or 2 of the controller. The controller reads only the integer part of the version.

        Raises:
            ModelError: The file is missing, is not JSON or has an unknown version, or a field is missing or invalid.
        """
        content = read_json_input(path, ModelError)
        controller = content.get(_CONTROLLER) if isinstance(content, dict) else None
        if not isinstance(controller, dict):
            raise ModelError(f"{path}: has no key {_CONTROLLER}, so it is not a gravity-compensation file of an MTM")
        if (version := _major_version(content.get("version"))) not in (1, 2):
            raise ModelError(f'{path}: version is {content.get("version")!r}; allowed: "1.0", "{VERSION}"')
        keys = {name: key for name, key in _KEYS.items() if version == 2 or name not in _FRICTION_FIELDS}
        required = [*keys.values(), *([_AMPLITUDES] if version == 1 else [])]
        if missing := [key for key in required if key not in controller]:
            raise ModelError(f"{path}: keys missing in {_CONTROLLER}: {', '.join(missing)}")
        fields = {name: _numbers(controller[key]) for name, key in keys.items()}
        if version == 1:
            amplitudes = _numbers(controller[_AMPLITUDES])
            if amplitudes.shape != (NUM_JOINTS,) or not np.all((amplitudes > 0) & np.isfinite(amplitudes)):
                raise ModelError(f"{path}: {_AMPLITUDES} must be {NUM_JOINTS} positive numbers [rad/s]")
            fields |= {"dead_band": np.zeros(NUM_JOINTS), "saturation": np.ones(NUM_JOINTS)}
            fields["friction_ratio"] = np.zeros(NUM_JOINTS)
        file = cls(
            **fields,
            sweep=_sweep(controller),
            arm_name=_arm_name(content.get(_ARM_NAME), Path(path).name),
        )
        try:
            file.check()
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
        return file

    def save(self, path: str | Path, arm_name: str, origin: str) -> None:
        """Writes the file atomically.

        Args:
            path: Path of the file.
            arm_name: Name of the arm, e.g. "MTML". The controller does not read this name.
            origin: Description of the source of the parameters. The controller does not read this text.

        Raises:
            ModelError: `check` rejects a field.
        """
        self.check()
        lines = [f'    "{key}": {json.dumps(getattr(self, name).tolist())}' for name, key in _KEYS.items()]
        with atomic_write(path) as stream:
            stream.write(
                f'{{\n  "version": "{VERSION}",\n  "{_ARM_NAME}": {json.dumps(arm_name)},\n'
                f'  "origin": {json.dumps(origin)},\n  "{_CONTROLLER}": {{\n' + ",\n".join(lines) + "\n  }\n}\n"
            )


def _major_version(value: object) -> int:
    """Returns the integer part of a version, or 0 if it is not a number."""
    try:
        return int(float(value)) if isinstance(value, str | int | float) else 0
    except (ValueError, OverflowError):
        return 0


def _numbers(value: object) -> NDArray[np.float64]:
    try:
        return np.atleast_1d(np.array(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)  # check() rejects this length. Its message contains the key.


def _arm_name(value: object, file_name: str) -> str:
    """Returns the value of ARM_NAME. Without ARM_NAME, returns the name of a known arm in the file name, or ""."""
    if isinstance(value, str) and value:
        return value
    return next((name.upper() for name in known_arms() if name in file_name.lower()), "")


def _sweep(controller: dict) -> NDArray[np.float64] | None:
    bounds = [_numbers(controller.get(key)) for key in _SWEEP_KEYS]
    if any(b.shape != (NUM_JOINTS,) or not np.all(np.isfinite(b)) for b in bounds):
        return None
    return np.deg2rad(np.array(bounds))


#: Gravitational acceleration in the gravity columns of the controller's regressor [m/s^2].
CONTROLLER_GRAVITY = 9.81
#: Number of gravity columns of the controller's regressor.
NUM_GRAVITY = 10
#: Order of the polynomials in a joint position.
ORDER = 4
MTM_JOINTS = (
    "outer_yaw",
    "shoulder_pitch",
    "elbow_pitch",
    "wrist_platform",
    "wrist_pitch",
    "wrist_yaw",
    "wrist_roll",
)


def controller_regressor(q: ArrayLike) -> NDArray[np.float64]:
    """Returns the regressor R (m, 7, 40) at poses q (m, 7) [rad]. R times the parameters (40,) is the torque [N m].

    The formula is from the class robGravityCompensationMTM of sawIntuitiveResearchKit, the software of the dVRK.
    """
    q = np.atleast_2d(np.asarray(q, dtype=np.float64))
    s4, s5, s6 = np.sin(q[:, 3:6]).T
    c4, c5, c6 = np.cos(q[:, 3:6]).T
    S, C = np.sin(q[:, 1] + q[:, 2]), np.cos(q[:, 1] + q[:, 2])
    R = np.zeros((len(q), NUM_JOINTS, NUM_PARAMETERS))
    R[:, 1, 0], R[:, 1, 1] = np.sin(q[:, 1]), np.cos(q[:, 1])
    R[:, 1, 2:10] = np.stack(
        [
            C,
            -S,
            C * c4,
            -C * s4,
            -(S * c5 + C * c4 * s5),
            C * c4 * c5 - S * s5,
            C * s4 * s6 + S * c6 * s5 - C * c4 * c5 * c6,
            C * c6 * s4 - S * s5 * s6 + C * c4 * c5 * s6,
        ],
        axis=1,
    )
    R[:, 2, 2:10] = R[:, 1, 2:10]
    R[:, 3, 4:10] = np.stack(
        [-S * s4, -S * c4, S * s4 * s5, -S * c5 * s4, S * (c4 * s6 + c5 * c6 * s4), S * (c4 * c6 - c5 * s4 * s6)],
        axis=1,
    )
    R[:, 4, 6:10] = np.stack(
        [
            -(C * s5 + S * c4 * c5),
            C * c5 - S * c4 * s5,
            -C * c5 * c6 + S * c4 * c6 * s5,
            C * c5 * s6 - S * c4 * s5 * s6,
        ],
        axis=1,
    )
    R[:, 5, 8] = S * c6 * s4 + C * s5 * s6 + S * c4 * c5 * s6
    R[:, 5, 9] = C * c6 * s5 - S * s4 * s6 + S * c4 * c5 * c6
    R *= CONTROLLER_GRAVITY
    for joint in range(NUM_JOINTS - 1):
        R[:, joint, polynomial_columns(joint)] = q[:, joint, None] ** np.arange(ORDER + 1)
    return R


def polynomial_columns(joint: int) -> slice:
    """Returns the slice of the five regressor columns (powers 0 to 4 of the position) of a joint with index 0 to 5."""
    first = NUM_GRAVITY + (ORDER + 1) * joint
    return slice(first, first + ORDER + 1)


def unclipped_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns the torque (m, 7) that the controller computes from a file, before clipping to the torque limits [N m].

    Args:
        file: Content of the file.
        q: Poses (m, 7) [rad].
        v: Velocities (m, 7) [rad/s]. None: all velocities are zero.
    """
    R = controller_regressor(q)
    v = np.zeros(R.shape[:2]) if v is None else np.atleast_2d(np.asarray(v, dtype=np.float64))
    share = np.clip((np.abs(v) - file.dead_band) / (file.saturation - file.dead_band), 0.0, 1.0)
    alpha = 0.5 + 0.5 * file.friction_ratio * share * np.sign(v)
    return alpha * (R @ file.positive) + (1.0 - alpha) * (R @ file.negative)


def controller_torque(file: GravityCompensationFile, q: ArrayLike, v: ArrayLike | None = None) -> NDArray[np.float64]:
    """Returns the torque (m, 7) that the controller applies: `unclipped_torque`, clipped to the torque limits [N m]."""
    return np.clip(unclipped_torque(file, q, v), file.torque_lower, file.torque_upper)
