"""Files of gains: what `tune` writes and what a scenario and `run` read."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from pydrake.common.yaml import yaml_dump

from dvrk_drake.errors import ControllerError
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.typed_yaml import load_typed_yaml


def load_gains(path: str | Path) -> Gains:
    """Reads kp, kd and ki, one number a joint each; whether they fit an arm is the controller's to say.

    Raises:
        ControllerError: no such file, not one of gains, or a gain outside the range of `Gains`.
    """
    gains = load_typed_yaml(Gains, path, ControllerError, "a file of gains")
    for name, values in dataclasses.asdict(gains).items():
        if not values:
            raise ControllerError(f"{path}: {name} is missing; a file of gains has kp, kd and ki, one number a joint")
    return gains


def save_gains(gains: Gains, path: str | Path, remark: str) -> None:
    """Writes a file of gains with a remark of one line at its top.

    Raises:
        DvrkDrakeError: it cannot be written.
    """
    with atomic_write(path) as stream:
        stream.write(f"# {remark}\n# N m/rad, N m s/rad, N m/(rad s); N and m on a joint that slides.\n")
        stream.write(yaml_dump(dataclasses.asdict(gains)))
