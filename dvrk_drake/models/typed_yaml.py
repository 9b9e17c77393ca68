"""Reads YAML files into dataclasses. Error messages name the key, its value and the accepted values."""

from __future__ import annotations

import dataclasses
import math
import types
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.files import read_text_input
from dvrk_drake.models.ranges import RANGE, Range, quoted, suggest_name

Schema = TypeVar("Schema")

_ONE = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}
_MANY = {bool: "true or false", int: "integers", float: "numbers", str: "strings"}
#: Upper bound of the absolute value of integers.
_MAX_INT = 2**63

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
        schema: Dataclass whose fields are dataclasses, configurations of Drake such as `MultibodyPlantConfig`, lists,
            mappings with text keys, bool, int, float, str, or optional values of these types. Numbers must be finite
            and within the range of their field, see `within`. The key `format` must equal its default, if there is one.
        path: Path of the file.
        error: Type of error to raise.
        what: Kind of file that is expected, for messages, e.g. "a gains file".

    Raises:
        DvrkDrakeError: The file cannot be read, is not YAML, or does not match the schema. The exception has the type
            `error`.
    """
    return typed_content(schema, load_yaml(path, error), str(path), error, what)


def typed_content(
    schema: type[Schema],
    content: Any,
    where: str,
    error: type[DvrkDrakeError],
    what: str,
    *,
    complete: bool = False,
) -> Schema:
    """Converts parsed content as `load_typed_yaml` does.

    Args:
        schema, error, what: Arguments of `load_typed_yaml`.
        content: Parsed content.
        where: Name of the source of the content.
        complete: Whether all keys must be stated whose default is not None, e.g. because a missing number must not
            become 0.
    """
    if not isinstance(content, dict):
        given = "is empty" if content is None else f"must have keys and values, not {quoted(content)}"
        raise error(f"{where}: {given}; allowed in {what}: {', '.join(_types_of_keys(schema))}")
    # The keys of another version are unknown, so the version is checked first.
    version = getattr(schema, "format", None)
    if version and content.get("format", version) != version:
        raise error(f'{where}: format is {quoted(content["format"])}; allowed: "{version}"')
    try:
        return _read(schema, content, "", what, None, complete)
    except _SchemaError as cause:
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


class _SchemaError(Exception):
    """Message on the first part of a content that does not match a schema."""


def _read(schema: Any, value: Any, key: str, what: str, allowed: Range | None, complete: bool) -> Any:
    """Returns the value of `key`, converted to the type of the schema.

    Args:
        schema: Type of the value, see `load_typed_yaml`.
        value: Parsed content.
        key: Key of the value, e.g. "gains.kp[0]", or "" for the whole content.
        what: Name of the mapping in messages on an unknown key.
        allowed: Range of the numbers in the value.
        complete: See `typed_content`.

    Raises:
        _SchemaError: The value does not match the schema.
    """
    schema = schema if value is None else _without_none(schema)
    origin, arguments = get_origin(schema), get_args(schema)
    if origin in (Union, types.UnionType):
        return None
    if origin is list and isinstance(value, list):
        return [_read(arguments[0], x, f"{key}[{i}]", key, allowed, complete) for i, x in enumerate(value)]
    if origin is dict and isinstance(value, dict) and all(isinstance(name, str) for name in value):
        return {name: _read(arguments[1], x, f"{key}.{name}", key, allowed, complete) for name, x in value.items()}
    if origin is None and isinstance(value, dict) and (types_of := _types_of_keys(schema)):
        return _read_object(schema, types_of, value, key, what, complete)
    if schema not in _ONE:
        raise _SchemaError(_wrong(schema, value, key))
    if allowed is not None and isinstance(value, float) and math.isinf(value) and value in allowed:
        return value
    if not _fits(schema, value):
        raise _SchemaError(_wrong(schema, value, key))
    converted = value == "true" if schema is bool and isinstance(value, str) else schema(value)
    if allowed is not None and (fault := allowed.fault(key, converted)):
        raise _SchemaError(fault)
    return converted


def _read_object(schema: Any, types_of: dict[str, Any], content: dict, key: str, what: str, complete: bool) -> Any:
    """Returns an object of the schema, whose keys have the types `types_of`. The other arguments are as for `_read`."""
    fields = {entry.name: entry for entry in dataclasses.fields(schema)} if dataclasses.is_dataclass(schema) else {}
    values = {}
    for name, value in content.items():
        if name not in types_of:
            where, known = f"{key}: " if key else "", ", ".join(types_of)
            advice = suggest_name(name, types_of)
            raise _SchemaError(f"{where}key {quoted(name)} is unknown; {advice}allowed in {what}: {known}")
        inside = f"{key}.{name}".lstrip(".")
        allowed = fields[name].metadata.get(RANGE) if name in fields else None
        values[name] = _read(types_of[name], value, inside, inside, allowed, complete)
    for name, entry in fields.items() if complete else ():
        if name not in content and entry.default is not None:
            raise _SchemaError(f"{key}.{name} is missing".lstrip("."))
    try:
        return schema(**values)
    except DvrkDrakeError as cause:  # raised by the schema's own check
        raise _SchemaError(f"{key}: {cause}".removeprefix(": ")) from cause


def _types_of_keys(schema: Any) -> dict[str, Any]:
    """Returns the types of the fields of a dataclass or of a configuration of Drake, or {} for other types."""
    if dataclasses.is_dataclass(schema):
        return get_type_hints(schema)
    return {field.name: field.type for field in getattr(schema, "__fields__", ())}


def _without_none(schema: Any) -> Any:
    """Returns the type T for the schema `T | None`."""
    if get_origin(schema) not in (Union, types.UnionType):
        return schema
    (inner,) = (argument for argument in get_args(schema) if argument is not types.NoneType)
    return inner


def _fits(schema: type, value: Any) -> bool:
    """Returns whether yaml_load_typed would convert the value to the type `schema`. Numbers must be finite."""
    if schema is bool:
        return isinstance(value, bool) or value in ("true", "false")
    if schema is str:
        return isinstance(value, str)
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return False
    try:
        number = schema(value)
    except (ValueError, OverflowError):
        return False
    if schema is int:
        return abs(number) < _MAX_INT and (not isinstance(value, float) or value.is_integer())
    return math.isfinite(number)


def _wrong(schema: Any, value: Any, key: str) -> str:
    allowed = _described(schema, _ONE)
    if get_origin(schema) is list and not isinstance(value, dict | None):
        (inner,) = get_args(schema)
        if inner in _ONE and _fits(inner, value):
            allowed += f", e.g. [{value}]"
    elif schema is float and isinstance(value, float):
        allowed = "a finite number"
    if isinstance(value, bool) and schema in (str, list[str]):
        word, words, meaning = ("on", "on and yes", "true") if value else ("off", "off and no", "false")
        example = f'"{word}"' if schema is str else f'["{word}"]'
        allowed += f"; quote a word, e.g. {example}: YAML reads {words} without quotes as {meaning}"
    return f"{key} is {quoted(value)}; allowed: {allowed}"


def _described(schema: Any, number: dict[type, str]) -> str:
    """Returns a description of the accepted values: "a number", or "numbers" for a list."""
    schema = _without_none(schema)
    one, arguments = number is _ONE, get_args(schema)
    if get_origin(schema) is list:
        return f"{'a list' if one else 'lists'} of {_described(arguments[0], _MANY)}"
    if get_origin(schema) is dict:
        return f"{'a mapping' if one else 'mappings'} from names to {_described(arguments[1], _MANY)}"
    if types_of := _types_of_keys(schema):
        return f"{'a mapping' if one else 'mappings'} with the keys {', '.join(types_of)}"
    return number[schema]
