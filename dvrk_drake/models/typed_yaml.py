"""Reads YAML files into dataclasses. Error messages name the key, its value and the accepted values."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.file_format import FileFormat
from dvrk_drake.models.files import read_text_input
from dvrk_drake.models.schema_fault import schema_fault

Schema = TypeVar("Schema")

#: Maximum nesting and maximum number of values of a file, with expanded aliases. The files of a PSM have a nesting of 6
#: and 6000 values.
MAX_DEPTH, MAX_VALUES = 50, 1_000_000
# The parser of libyaml is faster than the Python parser, and its speed does not depend on the nesting.
_FastLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_FastLoader):
    """YAML loader that refuses duplicate keys in a mapping. PyYAML's own loaders use the last of these keys."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in keys:
                    what = f'duplicate key "{key.value}"'
                    raise yaml.constructor.ConstructorError(None, None, what, key.start_mark)
                keys.add(key.value)
        return super().construct_mapping(node, deep)


# Rotation in Drake's model directives, e.g. `rotation: !Rpy {deg: [0, 0, 90]}`. All other tags are refused.
_Loader.add_constructor("!Rpy", lambda loader, node: loader.construct_mapping(node, deep=True))


def load_typed_yaml(schema: type[Schema], path: str | Path, error: type[DvrkDrakeError], what: str) -> Schema:
    """Returns the content of the file at `path` as an object of the schema.

    Args:
        schema: Dataclass, see `schema_fault`. A `FileFormat` in its metadata, or the default of its field `format`, is
            checked first.
        path: Path of the file.
        error: Type of error to raise.
        what: Kind of file that is expected, for messages, e.g. "a gains file".

    Raises:
        DvrkDrakeError: The file cannot be read, is not YAML, or does not match the schema. The exception has the type
            `error`.
    """
    return typed_content(schema, load_yaml(path, error), str(path), error, what)


def typed_content(schema: type[Schema], content: Any, where: str, error: type[DvrkDrakeError], what: str) -> Schema:
    """Converts parsed content as `load_typed_yaml` does; `where` names the source of the content."""
    if (expected := FileFormat.of(schema)) is not None and isinstance(content, dict) and "format" in content:
        try:
            expected.check(content["format"])
        except ValueError as cause:
            raise error(f"{where}: {cause}") from cause
    fixed = getattr(schema, "format", None)
    if fixed and isinstance(content, dict) and content.get("format", fixed) != fixed:
        raise error(f'{where}: format is "{content["format"]}"; allowed: "{fixed}"')
    if fault := schema_fault(schema, content, what):
        raise error(f"{where}: {fault}")
    try:
        return _converted(schema, content)
    except DvrkDrakeError as cause:  # raised by the schema's own check
        raise error(f"{where}: {cause}") from cause


def load_yaml(path: str | Path, error: type[DvrkDrakeError]) -> Any:
    """Returns the content of the YAML file at `path`, without a schema.

    Raises:
        DvrkDrakeError: The file cannot be read or is not YAML. The exception has the type `error`.
    """
    return parse_yaml(read_text_input(path, error), str(path), error)


def parse_yaml(text: str, where: str, error: type[DvrkDrakeError]) -> Any:
    """Returns the content of a YAML text, or None for an empty text. `where` names the source of the text.

    Top-level keys that begin with "_" are omitted. A file can define anchors under such keys.

    Raises:
        DvrkDrakeError: The text is not YAML. The exception has the type `error`.
    """
    try:
        if excess := _excess(text):
            raise error(f"{where}: invalid YAML: {excess}")
        content = yaml.load(text, Loader=_Loader)
    except DvrkDrakeError:
        raise
    except Exception as cause:
        # The parser raises errors of various types. Only YAML errors contain the line number.
        mark, problem = getattr(cause, "problem_mark", None), getattr(cause, "problem", None)
        # At the end of a text, the line number of libyaml is too large by one.
        line = "" if mark is None else f"line {min(mark.line, len(text.splitlines()) - 1) + 1}: "
        raise error(f"{where}: invalid YAML: {line}{problem or cause}") from cause
    if isinstance(content, dict):
        return {key: value for key, value in content.items() if not str(key).startswith("_")}
    return content


def _excess(text: str) -> str:
    """Returns a description of excessive nesting or excessive aliases in a text, or "".

    The check processes the events of the parser one by one, and stops as soon as a maximum is exceeded.
    """
    # For each open collection: number of values so far, and anchor.
    open_values: list[int] = [0]
    open_anchors: list[str | None] = []
    values_of: dict[str, int] = {}
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            open_values.append(1)
            open_anchors.append(event.anchor)
            if len(open_anchors) > MAX_DEPTH:
                return f"line {event.start_mark.line + 1}: nested deeper than {MAX_DEPTH} levels"
        elif isinstance(event, yaml.CollectionEndEvent):
            count, anchor = open_values.pop(), open_anchors.pop()
            open_values[-1] += count
            if anchor is not None:
                values_of[anchor] = count
        elif isinstance(event, yaml.ScalarEvent):
            open_values[-1] += 1
            if event.anchor is not None:
                values_of[event.anchor] = 1
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor in open_anchors:
                return f"line {event.start_mark.line + 1}: {event.anchor} contains itself"
            open_values[-1] += values_of.get(event.anchor, 1)
        if open_values[-1] > MAX_VALUES:
            return f"more than {MAX_VALUES} values"
    return ""


def _converted(schema: Any, value: Any) -> Any:
    """Converts a value to the type of the schema. `schema_fault` must accept the value."""
    origin, arguments = get_origin(schema), get_args(schema)
    if origin in (Union, types.UnionType):
        (inner,) = (argument for argument in arguments if argument is not types.NoneType)
        return None if value is None else _converted(inner, value)
    if origin is list:
        return [_converted(arguments[0], entry) for entry in value]
    if origin is dict:
        return {name: _converted(arguments[1], entry) for name, entry in value.items()}
    if schema is bool and isinstance(value, str):
        return value == "true"
    if schema in (bool, int, float, str):
        return schema(value)
    hints = get_type_hints(schema)
    return schema(**{name: _converted(hints[name], entry) for name, entry in value.items()})
