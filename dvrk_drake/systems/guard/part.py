"""Base classes of a command guard: its parts, whose copies are fast, and its plausibility checks of measurements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Self

from dvrk_drake.systems.guard.limits import Mask, Vector


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


@dataclass(slots=True)
class Sample:
    """Measurement of n joints with derived quantities.

    Attributes:
        dt: Time since the previous measurement [s].
        q: Measured positions (n,) [rad, m].
        v: Measured velocities (n,) [rad/s, m/s].
        step: Change of position (n,) [rad, m] since the previous measurement.
        speed: Larger value (n,) of the speeds in this measurement and in the previous measurement [rad/s, m/s].
        effort: Measured effort (n,) [N m, N] of the motors.
        net_effort: Measured effort (n,) [N m, N] minus the gravity effort of the model.
        commanded: Effort (n,) [N m, N] that the guard commanded in the previous step, or None if it commanded no
            effort.
    """

    dt: float
    q: Vector
    v: Vector
    step: Vector
    speed: Vector
    effort: Vector
    net_effort: Vector
    commanded: Vector | None


class Check(Part, ABC):
    """Plausibility check of successive samples.

    Attributes:
        text: Description of the error that this check detects.
        about_position: True if the position of a joint with this error is invalid.
        uses_effort: True if the check requires the measured effort.
    """

    text: ClassVar[str]
    about_position: ClassVar[bool] = True
    uses_effort: ClassVar[bool] = True

    def begin(self, sample: Sample) -> None:
        """Starts with the first sample, which is not checked. By default, a check has no state."""

    @abstractmethod
    def check(self, sample: Sample) -> Mask:
        """Returns a mask (n,) of the joints whose measurement is implausible in the next sample."""
