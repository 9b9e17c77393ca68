"""Base class of the parts of a command guard, whose copies are fast."""

from __future__ import annotations

from typing import Self


class Part:
    """Object with a state that changes in each step of the guard.

    A deep copy shares all attributes with the original, in particular arrays, except those that `_find_parts` found. A
    subclass must therefore replace an array instead of changing it in place. Drake copies the state of a Context before
    every update, and a copy of each array would take longer than the update.
    """

    _parts: tuple[str, ...] = ()

    def __deepcopy__(self, memo: object) -> Self:
        """Returns a copy that changes independently of this object."""
        other = object.__new__(type(self))
        other.__dict__ = attributes = self.__dict__.copy()
        for name in self._parts:
            attributes[name] = attributes[name].__deepcopy__(memo)
        return other

    def _find_parts(self) -> None:
        """Finds the attributes that are parts themselves. A constructor calls this method last."""
        self._parts = tuple(name for name, value in vars(self).items() if isinstance(value, Part))
