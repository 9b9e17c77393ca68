"""Base parameters: the combinations of link parameters that a regressor can tell apart, readably named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StandardParameter:
    """One inertial parameter of one link: its mass m [kg] (axis "") or a first moment m c [kg m] (axis "x", "y", "z").

    `label` is the link as the field counts it ("2", or a name such as "crank").
    """

    label: str
    axis: str = ""

    def __str__(self) -> str:
        separator = "" if self.label.isdigit() else "_"
        mass = f"m{separator}{self.label}"
        return f"{mass} c{separator}{self.label}{separator}{self.axis}" if self.axis else mass


@dataclass(frozen=True)
class BaseParameters:
    """beta = combination phi, and Y_base = the columns `columns` of the regressor of phi.

    Attributes:
        columns: (b,) index of the standard parameter whose column stands for each base parameter.
        combination: (b, p) coefficients.
        names: (b,) such as "L2 (m2+...+m7) + m2 c2x".
        units: (b,) "kg m", or "kg" of the mass that a prismatic joint lifts.
    """

    columns: tuple[int, ...]
    combination: NDArray[np.float64]
    names: tuple[str, ...]
    units: tuple[str, ...]


def reduce_to_base(
    regressor: NDArray[np.float64],
    parameters: Sequence[StandardParameter],
    preference: Sequence[int],
    lengths: Mapping[str, float],
    tolerance: float = 1e-9,
) -> BaseParameters:
    """Reduces a regressor to a base set, keeping the columns that come first in `preference`.

    This is a QR decomposition whose pivots are chosen to be read rather than by size; on exact regressors the two
    differ only in names (Gautier, "Numerical calculation of the base inertial parameters of robots", 1991).

    Args:
        regressor: (rows, p) stacked over random poses; rows must be well over p.
        parameters: the p standard parameters.
        preference: a permutation of 0..p-1.
        lengths: named lengths [m], to print 0.2794 as L2.
        tolerance: relative size below which a column counts as dependent.
    """
    scale = np.linalg.norm(regressor, axis=0).max()
    columns: list[int] = []
    basis = np.empty((len(regressor), 0))
    for column in preference:
        residual = regressor[:, column]
        for _ in range(2):  # twice is enough (Kahan, Parlett): orthogonal to machine precision
            residual = residual - basis @ (basis.T @ residual)
        norm = np.linalg.norm(residual)
        if norm > tolerance * scale:
            columns.append(column)
            basis = np.column_stack([basis, residual / norm])
    columns.sort()
    solution = np.linalg.lstsq(regressor[:, columns], regressor, rcond=None)[0]
    combination = _snap(np.asarray(solution, dtype=np.float64), lengths)
    names = tuple(_readable(row, parameters, lengths) for row in combination)
    units = tuple("kg m" if parameters[column].axis else "kg" for column in columns)
    return BaseParameters(tuple(columns), combination, names, units)


def _snap(combination: NDArray[np.float64], lengths: Mapping[str, float]) -> NDArray[np.float64]:
    """Replaces coefficients within rounding of 0, +-1 or a named length by exactly that."""
    known = np.array([0.0, 1.0, -1.0, *lengths.values(), *(-v for v in lengths.values())])
    nearest = known[np.argmin(np.abs(combination[..., None] - known), axis=-1)]
    return np.where(np.abs(combination - nearest) < 1e-9, nearest, combination)


def _readable(row: NDArray[np.float64], parameters: Sequence[StandardParameter], lengths: Mapping[str, float]) -> str:
    """One combination as the field writes it: masses with a common length grouped first, then first moments."""
    groups: dict[float, list[StandardParameter]] = {}
    moments: list[tuple[float, str]] = []
    for coefficient, parameter in zip(row, parameters, strict=True):
        if coefficient and parameter.axis:
            moments.append((coefficient, str(parameter)))
        elif coefficient:
            groups.setdefault(coefficient, []).append(parameter)
    terms = [(coefficient, _sum_of_masses(group)) for coefficient, group in groups.items()] + moments
    text = ""
    for coefficient, what in terms:
        size = next((name for name, v in lengths.items() if v == abs(coefficient)), f"{abs(coefficient):.6g}")
        factor = "" if size == "1" else f"{size} "
        sign = ("- " if coefficient < 0 else "+ ") if text else ("-" if coefficient < 0 else "")
        text += f"{' ' if text else ''}{sign}{factor}{what}"
    return text


def _sum_of_masses(group: Sequence[StandardParameter]) -> str:
    """m2+...+m7 for consecutive numbered links, all of them written out otherwise; brackets where a factor follows."""
    if len(group) == 1:
        return str(group[0])
    numbers = [int(p.label) for p in group if p.label.isdigit()]
    others = [str(p) for p in group if not p.label.isdigit()]
    if len(numbers) > 3 and numbers == list(range(numbers[0], numbers[-1] + 1)):
        parts = [f"m{numbers[0]}", "...", f"m{numbers[-1]}"]
    else:
        parts = [f"m{number}" for number in numbers]
    return f"({'+'.join(parts + others)})"
