"""Reads a YAML file into a schema; what does not fit becomes one error of ours: key, value, what is allowed."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.files import read_text_input
from dvrk_drake.models.schema_fault import schema_fault, with_current_keys

Schema = TypeVar("Schema")

#: Deepest nesting and most values, aliases expanded, of a file; a PSM's files have 6 and 6000.
MAX_DEPTH, MAX_VALUES = 50, 1_000_000
# libyaml's parser is ten times as fast as the one in Python, and does not slow down where values are nested.
_FastLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_FastLoader):
    """Refuses a key that stands twice in one table, of which YAML takes the last one."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in keys:
                    what = f'key "{key.value}" is there twice'
                    raise yaml.constructor.ConstructorError(None, None, what, key.start_mark)
                keys.add(key.value)
        return super().construct_mapping(node, deep)


def load_typed_yaml(schema: type[Schema], path: str | Path, error: type[DvrkDrakeError], what: str) -> Schema:
    """What is in the file at `path`.

    Args:
        schema: a dataclass, see `schema_fault`.
        path: of the file.
        error: that is raised.
        what: the file should be, for the message: "a file of gains".

    Raises:
        DvrkDrakeError: of the type `error`; it cannot be read, is no YAML, or does not fit the schema.
    """
    return typed_content(schema, load_yaml(path, error), str(path), error, what)


def typed_content(schema: type[Schema], content: Any, where: str, error: type[DvrkDrakeError], what: str) -> Schema:
    """The same of what was read already, with `where` it is from."""
    content = with_current_keys(schema, content, where)
    if fault := schema_fault(schema, content, what):
        raise error(f"{where}: {fault}")
    try:
        return _converted(schema, content)
    except DvrkDrakeError as cause:  # of a schema's own check
        raise error(f"{where}: {cause}") from cause


def load_yaml(path: str | Path, error: type[DvrkDrakeError]) -> Any:
    """What is in the file at `path`, whatever it is.

    Raises:
        DvrkDrakeError: of the type `error`; it cannot be read, or is no YAML.
    """
    return parse_yaml(read_text_input(path, error), str(path), error)


def parse_yaml(text: str, where: str, error: type[DvrkDrakeError]) -> Any:
    """What a text says, with `where` it stands; None if it is empty.

    Keys that begin with "_" are left out: they may hold anchors.

    Raises:
        DvrkDrakeError: of the type `error`; it is no YAML.
    """
    try:
        if excess := _excess(text):
            raise error(f"{where}: not YAML that can be read: {excess}")
        content = yaml.load(text, Loader=_Loader)
    except DvrkDrakeError:
        raise
    except Exception as cause:
        # Of many types; YAML's own know the line.
        mark, problem = getattr(cause, "problem_mark", None), getattr(cause, "problem", None)
        # At the end of a text libyaml counts one line more.
        line = "" if mark is None else f"line {min(mark.line, len(text.splitlines()) - 1) + 1}: "
        raise error(f"{where}: not YAML: {line}{problem or cause}") from cause
    if isinstance(content, dict):
        return {key: value for key, value in content.items() if not str(key).startswith("_")}
    return content


def _excess(text: str) -> str:
    """Says what of a text has no end in use: nesting, or aliases of aliases; "" if nothing.

    The parser's events come one by one, so that this ends where the text begins to be too much.
    """
    # Per open collection, the number of values in it so far and its anchor.
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
    """A value in which `schema_fault` found nothing, as the schema's type."""
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
