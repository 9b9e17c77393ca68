"""Constant affine maps between coordinates, for linkages and transmissions."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.models.immutable import immutable
from dvrk_drake.models.ranges import within


@dataclass(frozen=True, eq=False)
class LinearMap:
    """Immutable affine map y = matrix x + offset of positions, with the corresponding maps of velocities and efforts.

    Attributes:
        matrix: Constant matrix (m, n).
        offset: Constant vector (m,), in the units of y.
    """

    matrix: NDArray[np.float64] = field(metadata=within(-1e4, 1e4))
    offset: NDArray[np.float64] = field(metadata=within(-100.0, 100.0, "rad or m"))

    def __post_init__(self) -> None:
        for name in ("matrix", "offset"):
            object.__setattr__(self, name, immutable(getattr(self, name)))

    def position(self, x: ArrayLike) -> NDArray[np.float64]:
        """Returns y = matrix x + offset for x of shape (n,) or (samples, n)."""
        return np.asarray(x, float) @ self.matrix.T + self.offset

    def velocity(self, x_dot: ArrayLike) -> NDArray[np.float64]:
        """Returns the velocity of y for a velocity `x_dot` of x, of shape (n,) or (samples, n)."""
        return np.asarray(x_dot, float) @ self.matrix.T

    def pull_back_effort(self, effort_y: ArrayLike) -> NDArray[np.float64]:
        """Returns the effort on x that does the same work as `effort_y` on y.

        The effort on x is matrix' effort_y, for `effort_y` of shape (m,) or (samples, m).
        """
        return np.asarray(effort_y, float) @ self.matrix

    @cached_property
    def inverse(self) -> LinearMap:
        """Returns the map from y to x. Raises numpy.linalg.LinAlgError if the matrix is singular or not square."""
        matrix = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        inverse = LinearMap(matrix, -matrix @ self.offset)
        vars(inverse)["inverse"] = self
        return inverse
