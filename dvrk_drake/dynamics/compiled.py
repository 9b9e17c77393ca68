"""Options and small functions of compiled code (numba).

A function with the decorator `compiled` is compiled once per installation and then read from numba's cache. numba
notices changes of the file of a function, but not of the files of the functions that it calls: after a change of one of
these, delete the cache (`find dvrk_drake -name '*.nb[ci]' -delete`). Assignments between slices are avoided, because
the message on their sizes takes seconds to compile.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numba
import numpy as np

#: Decorator of compiled functions. "contract" allows fused multiply-add instructions, which round once and not twice.
#: The error model "numpy" omits the checks for a division by zero.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


def read_only(dimension: int) -> numba.types.Array:
    """Returns the type of an argument that a function only reads: any C-contiguous array of float64."""
    return numba.types.Array(numba.float64, dimension, "C", readonly=True)


def compiled_for(*arguments: numba.types.Type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Returns a decorator as `compiled` for a function without result, whose arguments have these types only.

    The import of its module compiles the function or reads it from the cache, so calls never wait for the compiler.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        dispatcher = compiled(function)
        if not _is_cached(function, Path(dispatcher.stats.cache_path or "")):
            _announce()
        dispatcher.compile(numba.void(*arguments))
        dispatcher.disable_compile()
        return dispatcher

    return decorate


def _is_cached(function: Callable[..., None], folder: Path) -> bool:
    """Returns whether a folder of numba's cache has an index of the present file of the function."""
    source = Path(function.__code__.co_filename)
    index = folder.glob(f"{source.stem}.{function.__name__}-{function.__code__.co_firstlineno}.py*.nbi")
    return any(file.stat().st_mtime > source.stat().st_mtime for file in index)


@cache
def _announce() -> None:
    """Prints once why the first import takes long."""
    print(
        "dvrk_drake compiles its functions once per installation, which takes 10 to 30 s", file=sys.stderr, flush=True
    )


def entry_point(dispatcher: Callable[..., None]) -> Callable[..., None]:
    """Returns the machine code of a compiled function with one signature. Calls do not check types.

    The caller must pass arrays of exactly the compiled types.
    """
    (overload,) = dispatcher.overloads.values()  # type: ignore[attr-defined]
    return overload.entry_point


@compiled
def sin_cos(x):  # pragma: no cover - compiled
    """Returns sin(x) and cos(x) with an error below 3e-16 for |x| < 1e6, or NaN if x is not finite.

    The function contains no calls and no branches, so the compiler can vectorise loops that call it. The nearest
    multiple of pi/2 is subtracted from x in three parts. These parts and the polynomials are from Moshier's Cephes
    library (sin.c).
    """
    turns = np.floor(x * (2 / np.pi) + 0.5)
    y = ((x - turns * 1.57079625129699707031) - turns * 7.54978941586159635336e-8) - turns * 5.39030285815811905290e-15
    z = y * y
    p = -2.50507477628578072866e-8 + z * 1.58962301576546568060e-10
    p = -1.98412698295895385996e-4 + z * (2.75573136213857245213e-6 + z * p)
    sine = y + y * z * (-1.66666666666666307295e-1 + z * (8.33333333332211858878e-3 + z * p))
    p = 2.08757008747419316778e-9 - z * 1.13585365213876817300e-11
    p = 2.48015872888517045348e-5 + z * (-2.75573141792967388112e-7 + z * p)
    cosine = 1.0 - 0.5 * z + z * z * (4.16666666666665929218e-2 + z * (-1.38888888888730564116e-3 + z * p))
    quarter = turns - 4.0 * np.floor(0.25 * turns)
    odd = quarter == 1.0 or quarter == 3.0
    s, c = (cosine, sine) if odd else (sine, cosine)
    return -s if quarter >= 2.0 else s, -c if quarter == 1.0 or quarter == 2.0 else c


@compiled
def add(a, b):  # pragma: no cover - compiled
    """Returns the sum of two vectors, which are tuples of three numbers like all vectors of this module."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def scale(factor, a):  # pragma: no cover - compiled
    """Returns factor * a."""
    return factor * a[0], factor * a[1], factor * a[2]


@compiled
def dot(a, b):  # pragma: no cover - compiled
    """Returns the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a, b):  # pragma: no cover - compiled
    """Returns the vector product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def transposed_times(R, a):  # pragma: no cover - compiled
    """Returns R' a for a matrix R, which is a tuple of three rows."""
    return add(add(scale(a[0], R[0]), scale(a[1], R[1])), scale(a[2], R[2]))
