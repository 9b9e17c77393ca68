"""Computes base parameters and their names. Base parameters are the identifiable combinations of link parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray


@dataclass(frozen=True)
class StandardParameter:
    """Inertial parameter of a link or a rotor.

    Attributes:
        label: Number or name of the link, such as "2" or "crank". For a rotor, number of the actuator.
        axis: "" for the mass [kg], "x", "y" or "z" for a first moment [kg m], "xx", "yy", "zz", "xy", "xz" or "yz" for
            a moment or product of inertia [kg m^2], and "a" for the inertia of a rotor [kg m^2; kg if `prismatic`].
        prismatic: True for the rotor of a prismatic actuator.
    """

    label: str
    axis: str = ""
    prismatic: bool = False

    def __str__(self) -> str:
        if self.is_inertia:
            return f"I{self.axis}_{self.label}"
        separator = "" if self.label.isdigit() else "_"
        mass = f"m{separator}{self.label}"
        return f"{mass} c{separator}{self.label}{separator}{self.axis}" if self.axis else mass

    @property
    def is_inertia(self) -> bool:
        """True for a second moment of mass of a link or a rotor."""
        return self.axis == "a" or len(self.axis) == 2

    @property
    def unit(self) -> str:
        """SI unit of the parameter."""
        if self.is_inertia:
            return "kg" if self.prismatic else "kg m^2"
        return "kg m" if self.axis else "kg"


@dataclass(frozen=True)
class BaseParameters:
    """Base parameters beta = combination @ phi, where phi (p,) contains the standard parameters.

    The regressor for beta consists of the columns `columns` of the regressor for phi.

    Attributes:
        columns: Indices (b,) of the standard parameters whose regressor columns form the regressor for beta.
        combination: Matrix (b, p) that maps phi to beta.
        names: Names (b,), such as "L2 (m2+...+m7) + m2 c2x".
        units: Units (b,) of the base parameters.
    """

    columns: tuple[int, ...]
    combination: NDArray[np.float64]
    names: tuple[str, ...]
    units: tuple[str, ...]


#: Largest rounding error of a coefficient. A column is dependent if the norm of its component that is orthogonal to the
#: chosen columns is at most this share of the largest column norm. For this package's arms, the share is above 1e-3 for
#: independent and below 1e-15 for dependent columns.
TOLERANCE = 1e-9


def independent_columns(regressor: NDArray[np.float64]) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Returns indices of linearly independent columns of a regressor, and the combinations that give all columns.

    The indices `columns` (b,) and the matrix B (b, p) satisfy regressor = regressor[:, columns] B.

    Args:
        regressor: Regressor rows (rows, p) at random states, with many more rows than columns.
    """
    R, pivots = scipy.linalg.qr(regressor, mode="r", pivoting=True)
    rank = int(np.sum(np.abs(np.diag(R)) > TOLERANCE * abs(R[0, 0])))
    order = np.argsort(pivots[:rank])
    B = np.empty((rank, regressor.shape[1]))
    B[:, pivots] = np.linalg.solve(R[:rank, :rank], R[:rank])[order]
    return pivots[:rank][order], np.where(np.abs(B) > TOLERANCE, B, 0.0)


def reduce_to_base(
    regressor: NDArray[np.float64],
    parameters: Sequence[StandardParameter],
    preference: Sequence[int],
    lengths: Mapping[str, float],
) -> BaseParameters:
    """Computes base parameters whose regressor columns come as early as possible in `preference`.

    The method is a QR decomposition. Its pivots are chosen in the order of `preference` instead of by magnitude.
    Without rounding errors, the order affects only the form of the base parameters. Reference: Gautier, "Numerical
    calculation of the base inertial parameters of robots" (1991).

    Args:
        regressor: Regressor rows (rows, p) at random states, with many more rows than columns.
        parameters: Standard parameters (p,).
        preference: Permutation of the column indices 0 to p - 1, most preferred column first.
        lengths: Name -> coefficient, such as a length [m] or a product of lengths. In the symbolic names of the
            base parameters, each coefficient is written as its key instead of its value.
    """
    scale = np.linalg.norm(regressor, axis=0).max()
    columns: list[int] = []
    basis = np.empty((len(regressor), 0))
    for column in preference:
        residual = regressor[:, column]
        for _ in range(2):  # Two passes give orthogonality to machine precision (Kahan, Parlett).
            residual = residual - basis @ (basis.T @ residual)
        norm = np.linalg.norm(residual)
        if norm > TOLERANCE * scale:
            columns.append(column)
            basis = np.column_stack([basis, residual / norm])
    columns.sort()
    in_basis = basis.T @ regressor
    combination = _snap_to_known(np.asarray(np.linalg.solve(in_basis[:, columns], in_basis)), lengths)
    names = tuple(_format_combination(row, parameters, lengths) for row in combination)
    units = tuple(parameters[column].unit for column in columns)
    return BaseParameters(tuple(columns), combination, names, units)


def _snap_to_known(combination: NDArray[np.float64], lengths: Mapping[str, float]) -> NDArray[np.float64]:
    """Corrects coefficients that differ from 0, +-1 or a named length only by rounding errors."""
    known = np.array([0.0, 1.0, -1.0, *lengths.values(), *(-v for v in lengths.values())])
    nearest = known[np.argmin(np.abs(combination[..., None] - known), axis=-1)]
    return np.where(np.abs(combination - nearest) < TOLERANCE, nearest, combination)


def _format_combination(
    row: NDArray[np.float64], parameters: Sequence[StandardParameter], lengths: Mapping[str, float]
) -> str:
    """Formats a base parameter as a sum of inertias, masses and first moments.

    Masses with a common coefficient are grouped in brackets.
    """
    groups: dict[float, list[StandardParameter]] = {}
    inertias: list[tuple[float, str]] = []
    moments: list[tuple[float, str]] = []
    for coefficient, parameter in zip(row, parameters, strict=True):
        if coefficient and parameter.is_inertia:
            inertias.append((coefficient, str(parameter)))
        elif coefficient and parameter.axis:
            moments.append((coefficient, str(parameter)))
        elif coefficient:
            # After rounding, coefficients that differ only by rounding errors have the same key.
            groups.setdefault(round(coefficient, 12), []).append(parameter)
    terms = inertias + [(coefficient, _sum_of_masses(group)) for coefficient, group in groups.items()] + moments
    text = ""
    for coefficient, term in terms:
        size = next(
            (name for name, v in lengths.items() if abs(v - abs(coefficient)) < TOLERANCE), f"{abs(coefficient):.6g}"
        )
        factor = "" if size == "1" else f"{size} "
        sign = ("- " if coefficient < 0 else "+ ") if text else ("-" if coefficient < 0 else "")
        text += f"{' ' if text else ''}{sign}{factor}{term}"
    return text


def _sum_of_masses(group: Sequence[StandardParameter]) -> str:
    """Formats a sum of masses: "(m2+...+m7)" for more than three consecutive links, otherwise e.g. "(m2+m_coupler)"."""
    if len(group) == 1:
        return str(group[0])
    numbers = [int(p.label) for p in group if p.label.isdigit()]
    others = [str(p) for p in group if not p.label.isdigit()]
    if len(numbers) > 3 and numbers == list(range(numbers[0], numbers[-1] + 1)):
        parts = [f"m{numbers[0]}", "...", f"m{numbers[-1]}"]
    else:
        parts = [f"m{number}" for number in numbers]
    return f"({'+'.join(parts + others)})"
