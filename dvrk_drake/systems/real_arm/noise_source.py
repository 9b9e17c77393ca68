"""White noise that depends on nothing but a seed and the time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, LeafSystem


class NoiseSource(LeafSystem):
    """Gaussian noise, new in every time step.

    .. pydrake_system::

        name: NoiseSource
        output_ports:
        - noise

    - `noise` (n): independent numbers with the standard deviations that were given.

    The generator counts (Philox, Salmon et al., SC 2011): the numbers of a time step follow from seed and index alone,
    whoever asks, in whatever order. So a seed gives the same noise bit for bit, and what nobody reads costs nothing.
    Drake's RandomSource has no seed that Python can set (1.51 to 1.58).
    """

    def __init__(self, standard_deviations: ArrayLike, time_step: float, seed: int) -> None:
        """Of `standard_deviations` (n,), with a new number every `time_step` [s]; `seed` >= 0."""
        super().__init__()
        self._deviations = np.asarray(standard_deviations, float)
        self._time_step, self._seed = time_step, seed
        self.DeclareVectorOutputPort(
            name="noise", size=len(self._deviations), calc=self._calc, prerequisites_of_calc={self.time_ticket()}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        # Half a step of grace: sums of time steps are not exact.
        tick = int(context.get_time() / self._time_step + 0.5)
        bits = np.random.Philox(key=self._seed, counter=[0, 0, tick, 0])
        output.SetFromVector(self._deviations * np.random.Generator(bits).standard_normal(len(self._deviations)))
