"""Sine and cosine for compiled code, without function calls and branches, so that the compiler can vectorise loops."""

from __future__ import annotations

import numba
import numpy as np

# "contract" allows fused multiply-add instructions, which round once instead of twice.
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


@_compiled
def sin_cos(x):  # pragma: no cover - compiled
    """Returns sin(x) and cos(x) with an error below 3e-16 for |x| < 1e6, or NaN if x is not finite.

    The nearest multiple of pi/2 is subtracted from x in three parts. These parts and the polynomials are from Moshier's
    Cephes library (sin.c).
    """
    turns = np.floor(x * (2 / np.pi) + 0.5)
    y = ((x - turns * 1.57079625129699707031) - turns * 7.54978941586159635336e-8) - turns * 5.39030285815811905290e-15
    z = y * y
    p = -2.50507477628578072866e-8 + z * 1.58962301576546568060e-10
    p = -1.98412698295895385996e-4 + z * (2.75573136213857245213e-6 + z * p)
    sine = y + y * z * (-1.66666666666666307295e-1 + z * (8.33333333332211858878e-3 + z * p))
    p = 2.08757008419747316778e-9 - z * 1.13585365213876817300e-11
    p = 2.48015872888517045348e-5 + z * (-2.75573141792967388112e-7 + z * p)
    cosine = 1.0 - 0.5 * z + z * z * (4.16666666666665929218e-2 + z * (-1.38888888888730564116e-3 + z * p))
    quarter = turns - 4.0 * np.floor(0.25 * turns)
    odd = quarter == 1.0 or quarter == 3.0
    s, c = (cosine, sine) if odd else (sine, cosine)
    return -s if quarter >= 2.0 else s, -c if quarter == 1.0 or quarter == 2.0 else c


@_compiled
def sin(x):  # pragma: no cover - compiled
    """Returns sin(x), see `sin_cos`."""
    return sin_cos(x)[0]


@_compiled
def cos(x):  # pragma: no cover - compiled
    """Returns cos(x), see `sin_cos`."""
    return sin_cos(x)[1]
