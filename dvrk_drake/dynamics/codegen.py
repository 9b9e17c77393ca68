"""Generates Python source code from symbolic expressions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import sympy


@dataclass(frozen=True)
class SharedTerms:
    """Array of expressions after common subexpression elimination.

    Attributes:
        assignments: Symbol and expression of each common subexpression, in the order of evaluation.
        entries: Index and expression of each array element that is not identically zero.
        shape: Shape of the array.
    """

    assignments: list[tuple[sympy.Symbol, sympy.Expr]]
    entries: list[tuple[tuple[int, ...], sympy.Expr]]
    shape: tuple[int, ...]


def share_terms(array: sympy.NDimArray | sympy.MatrixBase) -> SharedTerms:
    """Eliminates common subexpressions of a vector or matrix of expressions."""
    dense = sympy.ImmutableDenseNDimArray(array)
    indices = list(np.ndindex(*dense.shape))
    flat = [dense[index] for index in indices]
    assignments, reduced = sympy.cse(flat, symbols=sympy.numbered_symbols("x"), optimizations="basic")
    entries = [(index, e) for index, e in zip(indices, reduced, strict=True) if e != 0]
    return SharedTerms(assignments, entries, dense.shape)


def python_source(
    name: str,
    arguments: Sequence[tuple[str, Sequence[sympy.Symbol]]],
    terms: SharedTerms,
    docstring: str = "",
) -> str:
    """Returns the source of a Python function `name(*arguments, out)` that fills the array `out`.

    Args:
        name: Name of the function.
        arguments: Name and symbols of each argument. An argument with one symbol of the same name is a scalar. Other
            arguments are arrays with one element per symbol.
        terms: Expressions to compute.
        docstring: Docstring of the function. If it is "", the function has no docstring.
    """
    lines = [f"def {name}({', '.join(n for n, _ in arguments)}, out):"]
    if docstring:
        lines.append(f'    """{docstring}"""')
    lines += unpacking_lines(arguments, terms, "    {symbol} = {array}[{index}]")
    lines += [f"    {symbol} = {sympy.pycode(e)}" for symbol, e in terms.assignments]
    if len(terms.entries) < math.prod(terms.shape):
        lines.append("    out[:] = 0.0")
    lines += [f"    out[{', '.join(map(str, index))}] = {sympy.pycode(e)}" for index, e in terms.entries]
    return "\n".join(lines) + "\n"


def is_scalar(name: str, symbols: Sequence[sympy.Symbol]) -> bool:
    """Returns whether an argument is a scalar. A scalar argument has a single symbol with the name of the argument."""
    return len(symbols) == 1 and symbols[0].name == name


def unpacking_lines(
    arguments: Sequence[tuple[str, Sequence[sympy.Symbol]]], terms: SharedTerms, form: str
) -> list[str]:
    """Returns one line of code for each array element that `terms` use.

    Args:
        arguments: Arguments of `python_source`.
        terms: Expressions to compute.
        form: Format of a line, with {symbol}, {array} and {index}.
    """
    used = set().union(*(e.free_symbols for _, e in [*terms.assignments, *terms.entries]), set())
    return [
        form.format(symbol=symbol, array=name, index=index)
        for name, symbols in arguments
        if not is_scalar(name, symbols)
        for index, symbol in enumerate(symbols)
        if symbol in used
    ]
