"""Immutable objects that several users share, because `load_arm` returns the same Arm object to all of them."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, NoReturn, ParamSpec, TypeVar

import numpy as np

from dvrk_drake.errors import ArmError

Parameters = ParamSpec("Parameters")
Value = TypeVar("Value")
_LOCK = threading.RLock()


class Shared:
    """Base class of dataclasses that are mutable while a file is read, and immutable as a part of an arm."""

    __slots__ = ("_is_immutable",)

    def __setattr__(self, name: str, value: object) -> None:
        if getattr(self, "_is_immutable", False):
            _refuse()
        super().__setattr__(name, value)


def _refuse(*_: object, **__: object) -> NoReturn:
    raise ArmError("an arm cannot be modified, because load_arm returns it to all callers; use dataclasses.replace")


class ImmutableList(list):
    """List that cannot be modified. A copy is an ordinary list."""

    __setitem__ = __delitem__ = __iadd__ = __imul__ = _refuse
    append = extend = insert = pop = remove = clear = sort = reverse = _refuse

    def __reduce__(self) -> tuple:
        return list, (list(self),)


class ImmutableDict(dict):
    """Dictionary that cannot be modified. A copy is an ordinary dictionary."""

    __setitem__ = __delitem__ = __ior__ = _refuse
    pop = popitem = clear = update = setdefault = _refuse

    def __reduce__(self) -> tuple:
        return dict, (dict(self),)


def immutable(value: Any) -> Any:
    """Returns an immutable copy of an array, a list, a tuple, a dictionary or a `Shared` object, with all its parts."""
    if isinstance(value, np.ndarray):
        array = np.array(value)
        array.setflags(write=False)
        return array
    if isinstance(value, list):
        return ImmutableList(map(immutable, value))
    if isinstance(value, tuple):
        return tuple(map(immutable, value))
    if isinstance(value, dict):
        return ImmutableDict((key, immutable(part)) for key, part in value.items())
    if isinstance(value, Shared) and dataclasses.is_dataclass(value):
        parts = {part.name: immutable(getattr(value, part.name)) for part in dataclasses.fields(value)}
        copy = dataclasses.replace(value, **parts)
        copy._is_immutable = True
        return copy
    return value


def cached(function: Callable[Parameters, Value]) -> Callable[Parameters, Value]:
    """Decorator like `functools.cache`. Threads that call the function with equal arguments get the same object."""
    results = cache(function)

    @wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Value:
        with _LOCK:
            return results(*args, **kwargs)  # type: ignore[arg-type]

    call.cache_clear = results.cache_clear  # type: ignore[attr-defined]
    return call
