"""Reads a YAML file into a schema; what does not fit becomes one error of ours: key, value, what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.schema_fault import schema_fault

Schema = TypeVar("Schema")


def load_typed_yaml(schema: type[Schema], path: str | Path, error: type[DvrkDrakeError], what: str) -> Schema:
    """What is in the file at `path`.

    Args:
        schema: a dataclass, see yaml_load_typed.
        path: of the file.
        error: that is raised.
        what: the file should be, for the message: "a file of gains".

    Raises:
        DvrkDrakeError: of the type `error`; it cannot be read, is no YAML, or does not fit the schema.
    """
    content = load_yaml(path, error)
    if fault := schema_fault(schema, content, what):
        raise error(f"{path}: {fault}")
    try:
        return yaml_load_typed(schema=schema, filename=str(path))
    except Exception as cause:
        raise _unforeseen(cause, str(path), error) from cause


def typed_content(schema: type[Schema], content: Any, where: str, error: type[DvrkDrakeError], what: str) -> Schema:
    """The same of what was read already, with `where` it is from."""
    if fault := schema_fault(schema, content, what):
        raise error(f"{where}: {fault}")
    try:
        return yaml_load_typed(schema=schema, data=yaml_dump(content))
    except Exception as cause:
        raise _unforeseen(cause, where, error) from cause


def load_yaml(path: str | Path, error: type[DvrkDrakeError]) -> Any:
    """What is in the file at `path`, whatever it is.

    Raises:
        DvrkDrakeError: of the type `error`; it cannot be read, or is no YAML.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a text file in UTF-8: {cause.reason} at byte {cause.start}") from cause
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror}") from cause
    return parse_yaml(text, str(path), error)


def parse_yaml(text: str, where: str, error: type[DvrkDrakeError]) -> Any:
    """What a text says, with `where` it stands; None if it is empty.

    Raises:
        DvrkDrakeError: of the type `error`; it is no YAML.
    """
    try:
        return yaml_load(data=text) if text.strip() else None
    except Exception as cause:
        # Of many types; YAML's own know the line.
        mark, problem = getattr(cause, "problem_mark", None), getattr(cause, "problem", None)
        line = "" if mark is None else f"line {mark.line + 1}: "
        raise error(f"{where}: not YAML: {line}{problem or cause}") from cause


def _unforeseen(cause: Exception, where: str, error: type[DvrkDrakeError]) -> DvrkDrakeError:
    """Of what yaml_load_typed refuses and `schema_fault` lets pass, such as what a schema's own check raises."""
    return error(f"{where}: {cause}")
