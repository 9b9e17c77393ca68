"""Base class of the plausibility checks of measurements, and the samples that they check."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from dvrk_drake.systems.guard.limits import Mask, Vector
from dvrk_drake.systems.guard.part import Part


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
