"""Checks the content of files and of Python objects. Messages name the key, its value and the accepted values.

The range of a number is metadata of its field: `field(default=0.05, metadata=within(0.002, 1.0, "s"))`. It applies to
all numbers in the field, including those in lists and mappings. `schema_fault` checks the content of a file, and
`number_fault` checks an object.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
from collections.abc import Iterable, Iterator, Mapping
from numbers import Integral, Real
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

_ONE = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}
_MANY = {bool: "true or false", int: "integers", float: "numbers", str: "strings"}
#: Metadata key of a field: the `Range` of all numbers in it.
RANGE = "range"
#: Mapping from a unit to another unit that is often used by mistake, and the factor that converts the other unit to it.
_MISTAKEN = {
    "rad": ("degrees", math.pi / 180),
    "rad/s": ("degrees/s", math.pi / 180),
    "m": ("mm", 1e-3),
    "m/s": ("mm/s", 1e-3),
    "s": ("ms", 1e-3),
    "kg": ("g", 1e-3),
}
#: Upper bound of the absolute value of integers.
_MAX_INT = 2**63
#: Maximum number of characters of a value in a message.
_MAX_LENGTH = 60


@dataclasses.dataclass(frozen=True)
class Range:
    """Numbers that a field accepts.

    Attributes:
        low, high: Smallest and largest accepted number.
        unit: Unit of both numbers; "rad or m" if it depends on the joint type.
        also: Additional accepted numbers, e.g. 0 or infinity.
        either_sign: True if low and high apply to the absolute value.
    """

    low: float
    high: float
    unit: str = ""
    also: tuple[float, ...] = ()
    either_sign: bool = False

    def __contains__(self, value: float) -> bool:
        """Returns whether the number is accepted. NaN is not accepted."""
        return bool(self.low <= (abs(value) if self.either_sign else value) <= self.high) or value in self.also

    def __str__(self) -> str:
        numbers = [f"{number:g}" if isinstance(number, float) else str(number) for number in (self.low, self.high)]
        text = "..".join(numbers) + (f" {self.unit}" if self.unit else "")
        text += " of either sign" if self.either_sign else ""
        return "".join(f"{number:g} or " for number in self.also) + text

    def fault(self, key: str, value: float) -> str:
        """Returns a message if the number is not accepted, or "". The message may suggest another unit."""
        if value in self:
            return ""
        mistaken = [_MISTAKEN[unit] for unit in self.unit.split(" or ") if unit in _MISTAKEN]
        other = " or ".join(name for name, size in mistaken if abs(value) > self.high and value * size in self)
        text = f"{value:g}" if isinstance(value, float) else str(value)
        return f"{key} is {text}; allowed: {self}" + (f"; is it in {other}?" if other else "")


def within(
    low: float, high: float, unit: str = "", *, also: tuple[float, ...] = (), either_sign: bool = False
) -> dict[str, object]:
    """Returns metadata of a field whose numbers must be in a range, see `Range`."""
    return {RANGE: Range(low, high, unit, also, either_sign)}


def number_fault(instance: object) -> str:
    """Returns a message on the first number of a dataclass object that is not finite or is out of range, or "".

    The message contains the key of the number. Nested lists, tuples, mappings, arrays and dataclasses are searched.
    Values that are not numbers are ignored.
    """
    return next(_number_faults(instance, "", None), "")


def _number_faults(value: Any, key: str, allowed: Range | None) -> Iterator[str]:
    if dataclasses.is_dataclass(value):
        for entry in dataclasses.fields(value):
            inside = f"{key}.{entry.name}" if key else entry.name
            yield from _number_faults(getattr(value, entry.name), inside, entry.metadata.get(RANGE))
    elif isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _number_faults(entry, f"{key}.{name}", allowed)
    elif isinstance(value, list | tuple | np.ndarray):
        for i, entry in enumerate(value):
            yield from _number_faults(entry, f"{key}[{i}]", allowed)
    elif isinstance(value, Real) and not isinstance(value, bool):
        number = int(value) if isinstance(value, Integral) else float(value)
        if allowed is not None:
            yield from filter(None, [allowed.fault(key, number)])
        elif not math.isfinite(number):
            yield f"{key} is {number:g}; allowed: a finite number"
    elif allowed is not None and isinstance(value, bool | str):
        yield f"{key} is {_quoted(value)}; allowed: a number"


def schema_fault(schema: type, content: Any, what: str) -> str:
    """Returns a message on the first part of `content` that does not match the schema, or "" if all parts match.

    Args:
        schema: Dataclass whose fields are dataclasses, configurations of Drake such as `MultibodyPlantConfig`, lists,
            mappings with text keys, bool, int, float, str, or optional values of these types. Numbers must be finite
            and within the range of their field, see `within`.
        content: Parsed content of the file.
        what: Kind of file that is expected, e.g. "a gains file".
    """
    if not isinstance(content, dict):
        given = "is empty" if content is None else f"must have keys and values, not {_quoted(content)}"
        return f"{given}; allowed in {what}: {_keys(schema)}"
    return next(_faults(schema, content, "", what, None), "")


def _faults(schema: Any, value: Any, key: str, what: str, allowed: Range | None) -> Iterator[str]:
    """Yields messages on faults of the value of `key`. In messages on an unknown key, `what` names the mapping."""
    origin, arguments = get_origin(schema), get_args(schema)
    if origin in (Union, types.UnionType):
        if value is not None:
            (inner,) = (argument for argument in arguments if argument is not types.NoneType)
            yield from _faults(inner, value, key, what, allowed)
    elif hints := _hints(schema):
        if not isinstance(value, dict):
            yield _wrong(schema, value, key)
            return
        fields = getattr(schema, "__dataclass_fields__", {})
        ranges = {name: entry.metadata.get(RANGE) for name, entry in fields.items()}
        for name, entry in value.items():
            if name not in hints:
                yield f"{f'{key}: ' if key else ''}key {_quoted(name)} is unknown; {suggest_name(name, hints)}" + (
                    f"allowed in {what}: {_keys(schema)}"
                )
            else:
                inside = f"{key}.{name}" if key else name
                yield from _faults(hints[name], entry, inside, inside, ranges.get(name))
    elif origin is list:
        if not isinstance(value, list):
            yield _wrong(schema, value, key)
            return
        for i, entry in enumerate(value):
            yield from _faults(arguments[0], entry, f"{key}[{i}]", key, allowed)
    elif origin is dict:
        if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
            yield _wrong(schema, value, key)
            return
        for name, entry in value.items():
            yield from _faults(arguments[1], entry, f"{key}.{name}", key, allowed)
    elif allowed is not None and isinstance(value, float) and math.isinf(value) and value in allowed:
        return  # infinity, if accepted
    elif not _fits(schema, value):
        yield _wrong(schema, value, key)
    elif allowed is not None and (fault := allowed.fault(key, schema(value))):
        yield fault


def missing_key(schema: Any, content: Any, key: str = "") -> str:
    """Returns the first missing key of `content`, or "" if there is none.

    The other keys must match the schema. Keys whose default is None are optional.
    """
    if content is not None and get_origin(schema) in (Union, types.UnionType):
        (schema,) = (argument for argument in get_args(schema) if argument is not types.NoneType)
    inner: Iterator[str] = iter(())
    if dataclasses.is_dataclass(schema) and isinstance(content, dict):
        names = {field.name: f"{key}.{field.name}".lstrip(".") for field in dataclasses.fields(schema)}
        for field in dataclasses.fields(schema):
            if field.name not in content and field.default is not None:
                return names[field.name]
        hints = get_type_hints(schema)
        inner = (missing_key(hints[name], entry, names[name]) for name, entry in content.items())
    elif get_origin(schema) is list:
        inner = (missing_key(get_args(schema)[0], entry, f"{key}[{i}]") for i, entry in enumerate(content))
    return next(filter(None, inner), "")


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
    return f"{key} is {_quoted(value)}; allowed: {allowed}"


def _described(schema: Any, number: dict[type, str]) -> str:
    """Returns a description of the accepted values: "a number", or "numbers" for a list."""
    one, arguments = number is _ONE, get_args(schema)
    if get_origin(schema) in (Union, types.UnionType):
        return _described(arguments[0], number)
    if get_origin(schema) is list:
        return f"{'a list' if one else 'lists'} of {_described(arguments[0], _MANY)}"
    if get_origin(schema) is dict:
        return f"{'a mapping' if one else 'mappings'} from names to {_described(arguments[1], _MANY)}"
    if _hints(schema):
        return f"{'a mapping' if one else 'mappings'} with the keys {_keys(schema)}"
    return number[schema]


def _keys(schema: Any) -> str:
    return ", ".join(_hints(schema))


def _hints(schema: Any) -> dict[str, Any]:
    """Returns the types of the fields of a dataclass or of a configuration of Drake, or {} for other types."""
    if dataclasses.is_dataclass(schema):
        return get_type_hints(schema)
    return {field.name: field.type for field in getattr(schema, "__fields__", ())}


def suggest_name(name: object, known: Iterable[str]) -> str:
    """Returns "did you mean ...? " with the known name that is most similar to `name`.

    Returns "" if no known name is similar, or if several names are equally similar.
    """
    of_lower_case = {key.lower(): key for key in known}
    given = str(name)[:_MAX_LENGTH].lower()
    near = difflib.get_close_matches(given, of_lower_case, 2)
    similarity = [difflib.SequenceMatcher(None, other, given).ratio() for other in near]
    unique = len(set(similarity)) == len(similarity) > 0
    return f'did you mean "{of_lower_case[near[0]]}"? ' if unique else ""


def _quoted(value: Any) -> str:
    if value is None:
        return "empty"
    text = str(value)
    text = text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]}..."
    return f'"{text}"' if isinstance(value, str) else text
