"""Ranges of numbers in files and Python objects. Messages name the key, its value and the accepted values.

The range of a number is metadata of its field: `field(default=0.05, metadata=within(0.002, 1.0, "s"))`. It applies to
all numbers in the field, including those in lists and mappings. `number_fault` checks an object, and
`dvrk_drake.models.typed_yaml` checks the content of a file.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np

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
        yield f"{key} is {quoted(value)}; allowed: a number"


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


def quoted(value: Any) -> str:
    """Returns a value for a message: a shortened text, in quotation marks if it is a string."""
    if value is None:
        return "empty"
    text = str(value)
    text = text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]}..."
    return f'"{text}"' if isinstance(value, str) else text
