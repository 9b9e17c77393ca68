"""File of the dVRK controller for gravity compensation of a master arm: `gc-MTML-<serial>.json`."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import ModelError
from dvrk_drake.models.arm import known_arms
from dvrk_drake.models.files import atomic_write, read_json_input
from dvrk_drake.models.schema_fault import number_fault, within

VERSION = "2.0"
NUM_JOINTS = 7
#: Ten gravity terms, then 1, q, q^2, q^3, q^4 of each of the first six joints.
NUM_PARAMETERS = 40
_CONTROLLER = "GC_controller"
#: Information for users. The controller does not read it.
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
    """Content of the file. `export.dvrk_mtm_gravity_compensation` has the controller's formula.

    Attributes:
        positive, negative: Parameters (40,) for positive and negative joint velocity.
        torque_lower, torque_upper: Limits (7,) of the torque [N m].
        dead_band: Speeds (7,) [rad/s] up to which both parameters have equal weight.
        saturation: Speeds (7,) [rad/s] from which the weights differ by the full `friction_ratio`.
        friction_ratio: Share (7,), 0..1, of the friction that is compensated in motion.
        sweep: Lower and upper joint positions (2, 7) [rad] of the data of the file, if the file states them.
        arm_name: Name of the arm in the file (ARM_NAME), otherwise in the file name. Empty if neither has one.
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
        """Checks lengths, finite numbers and order, which the controller does not check before it commands motors.

        Raises:
            ModelError: A field is invalid. The message contains its name and the accepted values.
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
            ModelError: The file is missing, is not JSON, has another version, or a field is missing or invalid.
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
