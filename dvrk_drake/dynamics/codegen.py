"""Symbolic expressions as Python source and as functions compiled with numba."""

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
    """An array of expressions after common subexpression elimination.

    Attributes:
        assignments: (symbol, expression), in order of use.
        entries: (index, expression) of each entry that is not identically zero.
        shape: of the array.
    """

    assignments: list[tuple[sympy.Symbol, sympy.Expr]]
    entries: list[tuple[tuple[int, ...], sympy.Expr]]
    shape: tuple[int, ...]


def share_terms(array: sympy.NDimArray | sympy.MatrixBase) -> SharedTerms:
    """Common subexpression elimination over a vector or matrix of expressions."""
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
    """A Python function `name(*arguments, out)` that fills the array `out`; needs only the standard library's math.

    Args:
        name: of the function.
        arguments: (name, symbols) each; a one-element tuple of the same name is a scalar, else symbols are unpacked.
        terms: what to compute.
        docstring: first statement of the function.
        functions: names of sympy's functions, where others than those of math are to be called.
    """
    lines = [f"def {name}({', '.join(n for n, _ in arguments)}, out):"]
    if docstring:
        lines.append(f'    """{docstring}"""')
    lines += unpacking(arguments, terms, "    {symbol} = {array}[{index}]")
    code = partial(sympy.pycode, user_functions=dict(functions or {}))
    lines += [f"    {symbol} = {code(e)}" for symbol, e in terms.assignments]
    if len(terms.entries) < math.prod(terms.shape):
        lines.append("    out[:] = 0.0")
    lines += [f"    out[{', '.join(map(str, index))}] = {code(e)}" for index, e in terms.entries]
    return "\n".join(lines) + "\n"


def compile_function(
    name: str, arguments: Sequence[tuple[str, Sequence[sympy.Symbol]]], terms: SharedTerms
) -> Callable[..., None]:
    """The function of `python_source`, compiled with numba for float64; vectors and `out` must be C-contiguous.

    Sine and cosine are those of `trigonometry`.
    """
    namespace: dict[str, Any] = {"math": math, "sin": sin, "cos": cos}
    exec(python_source(name, arguments, terms, functions={"sin": "sin", "cos": "cos"}), namespace)
    kinds = [numba.float64 if is_scalar(n, s) else numba.float64[::1] for n, s in arguments]
    out = (numba.float64[::1], numba.float64[:, ::1])[len(terms.shape) - 1]
    return numba.njit(numba.void(*kinds, out), fastmath=False)(namespace[name])


def compile_batch(function: Callable[..., None], num_arguments: int, shape: tuple[int, ...]) -> Callable:
    """A compiled loop of `function` over the rows of its first argument.

    Returns:
        f(rows, *others) -> (len(rows), *shape), where rows is (m, k) C-contiguous.
    """
    others = ", ".join(f"a{i}" for i in range(1, num_arguments))
    call = f"rows[i], {others + ', ' if others else ''}out[i]"
    source = (
        f"def batch(rows, {others}{', ' if others else ''}out):\n"
        "    for i in range(rows.shape[0]):\n"
        f"        function({call})\n"
    )
    namespace: dict[str, Any] = {"function": function}
    exec(source, namespace)
    loop = numba.njit(namespace["batch"])

    def evaluate(rows: NDArray[np.float64], *arguments: object) -> NDArray[np.float64]:
        rows = np.ascontiguousarray(rows, dtype=np.float64)
        out = np.empty((len(rows), *shape))
        loop(rows, *arguments, out)
        return out

    return evaluate


def entry_point(dispatcher: Callable[..., None]) -> Callable[..., None]:
    """The only signature of a compiled function, without the choice between signatures (4 us a call here).

    Its types are not checked any more: the arrays must be what the signature says. Drake's always are.
    """
    (overload,) = dispatcher.overloads.values()  # type: ignore[attr-defined]
    return overload.entry_point


def is_scalar(name: str, symbols: Sequence[sympy.Symbol]) -> bool:
    """Returns whether an argument is a number: one symbol, of the same name."""
    return len(symbols) == 1 and symbols[0].name == name


def unpacking(arguments: Sequence[tuple[str, Sequence[sympy.Symbol]]], terms: SharedTerms, form: str) -> list[str]:
    """A line for each symbol that `terms` use of an array argument; `form` has {symbol}, {array} and {index}."""
    used = set().union(*(e.free_symbols for _, e in [*terms.assignments, *terms.entries]), set())
    return [
        form.format(symbol=symbol, array=name, index=index)
        for name, symbols in arguments
        if not is_scalar(name, symbols)
        for index, symbol in enumerate(symbols)
        if symbol in used
    ]
