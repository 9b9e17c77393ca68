"""Reads a YAML file into a schema; whatever is wrong with it becomes one error of ours."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydrake.common.yaml import yaml_load_typed

from dvrk_drake.errors import DvrkDrakeError

Schema = TypeVar("Schema")


def load_typed_yaml(
    schema: type[Schema], path: str | Path, error: type[DvrkDrakeError], *, what: str = "", allowed: str = ""
) -> Schema:
    """What is in the file at `path`.

    Args:
        schema: a dataclass, see yaml_load_typed.
        path: of the file.
        error: that is raised.
        what: the file should be, for the message: "a file of gains".
        allowed: in it, for the message.

    Raises:
        DvrkDrakeError: of the type `error`; it is no YAML, or does not fit the schema.
    """
    try:
        return yaml_load_typed(schema=schema, filename=str(path))
    except Exception as cause:
        # yaml_load_typed raises many types, from YAML's to KeyError and TypeError; each text names the field.
        message = f"{path}: " + (f"not {what}: " if what else "") + str(cause)
        raise error(f"{message}; allowed: {allowed}" if allowed else message) from cause
