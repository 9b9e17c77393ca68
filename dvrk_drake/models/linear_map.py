"""Constant affine maps of joint coordinates: what a linkage and a transmission of these arms are."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.models.schema_fault import within


@dataclass(frozen=True, eq=False)
class LinearMap:
    """y = matrix x + offset, with velocities and efforts mapped as virtual work demands.

    Attributes:
        matrix: (m, n), constant.
        offset: (m,), in the units of y.
    """

    matrix: NDArray[np.float64] = field(metadata=within(-1e4, 1e4))
    offset: NDArray[np.float64] = field(metadata=within(-100.0, 100.0, "rad or m"))

    def position(self, x: ArrayLike) -> NDArray[np.float64]:
        """y = matrix x + offset for x of shape (n,) or (samples, n)."""
        return np.asarray(x, float) @ self.matrix.T + self.offset

    def velocity(self, x_dot: ArrayLike) -> NDArray[np.float64]:
        """The rate of y for rates of x, shape (n,) or (samples, n)."""
        return np.asarray(x_dot, float) @ self.matrix.T

    def pull_back_effort(self, effort_y: ArrayLike) -> NDArray[np.float64]:
        """Effort on x that does the same work as `effort_y` on y: matrix' effort_y, (m,) or (samples, m)."""
        return np.asarray(effort_y, float) @ self.matrix

    @cached_property
    def inverse(self) -> LinearMap:
        """The map from y to x; raises numpy.linalg.LinAlgError if the matrix is singular or not square."""
        matrix = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        inverse = LinearMap(matrix, -matrix @ self.offset)
        vars(inverse)["inverse"] = self
        return inverse
