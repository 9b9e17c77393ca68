"""Generates Python source code and compiled functions (numba) from symbolic expressions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numba
import numpy as np
import sympy
from numpy.typing import NDArray

from dvrk_drake.dynamics.trigonometry import cos, sin


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
    functions: Mapping[str, str] | None = None,
) -> str:
    """Returns the source of a Python function `name(*arguments, out)` that fills the array `out`.

    Args:
        name: Name of the function.
        arguments: Name and symbols of each argument. An argument with one symbol of the same name is a scalar. Other
            arguments are arrays with one element per symbol.
        terms: Expressions to compute.
        docstring: Docstring of the function. If it is "", the function has no docstring.
        functions: Name of a sympy function -> name of the function to call. By default, the functions of `math` are
            called.
    """
    lines = [f"def {name}({', '.join(n for n, _ in arguments)}, out):"]
    if docstring:
        lines.append(f'    """{docstring}"""')
    lines += unpacking_lines(arguments, terms, "    {symbol} = {array}[{index}]")
    code = partial(sympy.pycode, user_functions=dict(functions or {}))
    lines += [f"    {symbol} = {code(e)}" for symbol, e in terms.assignments]
    if len(terms.entries) < math.prod(terms.shape):
        lines.append("    out[:] = 0.0")
    lines += [f"    out[{', '.join(map(str, index))}] = {code(e)}" for index, e in terms.entries]
    return "\n".join(lines) + "\n"


def compile_function(
    name: str, arguments: Sequence[tuple[str, Sequence[sympy.Symbol]]], terms: SharedTerms
) -> Callable[..., None]:
    """Compiles the function of `python_source` with numba for float64. Arrays must be C-contiguous.

    Sine and cosine are computed by the functions in `trigonometry`.
    """
    namespace: dict[str, Any] = {"math": math, "sin": sin, "cos": cos}
    exec(python_source(name, arguments, terms, functions={"sin": "sin", "cos": "cos"}), namespace)
    kinds = [numba.float64 if is_scalar(n, s) else numba.float64[::1] for n, s in arguments]
    out = (numba.float64[::1], numba.float64[:, ::1])[len(terms.shape) - 1]
    return numba.njit(numba.void(*kinds, out), fastmath=False)(namespace[name])


def compile_batch(
    function: Callable[..., None], shape: tuple[int, ...]
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Compiles a loop that calls `function` for each row of its argument.

    Args:
        function: Compiled function f(row, out) with an output array of the given shape.
        shape: Shape of the output array.

    Returns:
        Function of rows (m, k), which returns an array (m, *shape).
    """

    @numba.njit
    def loop(rows: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        for i in range(rows.shape[0]):
            function(rows[i], out[i])

    def evaluate(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = np.ascontiguousarray(rows, dtype=np.float64)
        out = np.empty((len(rows), *shape))
        loop(rows, out)
        return out

    return evaluate


def entry_point(dispatcher: Callable[..., None]) -> Callable[..., None]:
    """Returns the machine code of a compiled function with one signature. Calls do not check types.

    The caller must pass arrays of exactly the compiled types.
    """
    (overload,) = dispatcher.overloads.values()  # type: ignore[attr-defined]
    return overload.entry_point


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
