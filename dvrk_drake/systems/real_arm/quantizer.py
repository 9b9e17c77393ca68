"""Rounds the numbers of a vector to the steps that a converter has."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.errors import StationError


class Quantizer(LeafSystem):
    """y = step round(u / step), entry by entry; exact where the step is 0.

    .. pydrake_system::

        name: Quantizer
        input_ports:
        - u
        output_ports:
        - y

    - `u`, `y` (n): any quantity, in the units of the steps.
    """

    def __init__(self, steps: ArrayLike) -> None:
        """Of `steps` (n,) >= 0.

        Raises:
            StationError: a step that is negative or not finite.
        """
        super().__init__()
        steps = np.asarray(steps, float)
        if not np.all(np.isfinite(steps) & (steps >= 0)):
            raise StationError(f"steps of a quantizer must be finite and not negative; got {steps.tolist()}")
        self._step, self._exact = np.where(steps > 0, steps, 1.0), steps == 0
        self.DeclareVectorInputPort(name="u", size=len(steps))
        self.DeclareVectorOutputPort(
            name="y", size=len(steps), calc=self._calc, prerequisites_of_calc={self.all_input_ports_ticket()}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        u = self.EvalVectorInput(context, 0).get_value()
        output.SetFromVector(np.where(self._exact, u, self._step * np.rint(u / self._step)))
