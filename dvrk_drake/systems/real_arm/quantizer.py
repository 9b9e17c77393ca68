"""Rounds the numbers of a vector to the steps that a converter has."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.errors import StationError
from dvrk_drake.systems.gravity_pid_step import entry_point


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
        self.DeclareVectorInputPort(name="u", size=len(steps))
        self.DeclareVectorOutputPort(
            name="y",
            size=len(steps),
            calc=self._make_calc(steps),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _make_calc(self, steps: NDArray[np.float64]) -> Callable[[Context, BasicVector], None]:
        eval_vector_input, quantize = self.EvalVectorInput, entry_point(_quantize_into)

        def calc(context: Context, output: BasicVector) -> None:
            quantize(eval_vector_input(context, 0).get_value(), steps, output.get_mutable_value())

        return calc


@numba.njit("void(float64[::1], float64[::1], float64[::1])", cache=True)
def _quantize_into(u, steps, y):
    for i in range(len(u)):
        y[i] = steps[i] * np.rint(u[i] / steps[i]) if steps[i] > 0.0 else u[i]
