"""Regressor printed in the paper (section III.H), as an independent reference."""

import numpy as np


def paper_regressor(q):
    """Returns the gravity regressor (7, 12) at a pose q (7,) divided by g. Columns are in the order of the paper."""
    s2, s4, s5, s6, s7 = np.sin(q[[1, 3, 4, 5, 6]])
    c2, c4, c5, c6, c7 = np.cos(q[[1, 3, 4, 5, 6]])
    S, C = np.sin(q[1] + q[2]), np.cos(q[1] + q[2])
    B, A = C * s5 + S * c4 * c5, C * c5 - S * c4 * s5
    D, F = S * s4 * c6 + B * s6, B * c6 - S * s4 * s6
    w = [
        C,
        S,
        -(C * c4 * s5 + S * c5),
        C * (c4 * c5 * c6 - s4 * s6) - S * s5 * c6,
        C * c4,
        C * s4,
        S * s5 - C * c4 * c5,
        S * s5 * s6 - C * (s4 * c6 + c4 * c5 * s6),
        S * (c5 * s7 + s5 * s6 * c7) + C * (c4 * s5 * s7 - s4 * c6 * c7 - c4 * c5 * s6 * c7),
        S * (s5 * s6 * s7 - c5 * c7) - C * (c4 * s5 * c7 + s4 * c6 * s7 + c4 * c5 * s6 * s7),
    ]
    Y = np.zeros((7, 12))
    Y[1] = [s2, -c2, *w]
    Y[2, 2:] = w
    Y[3, 4:] = S * np.array(
        [
            s4 * s5,
            -(c4 * s6 + c5 * c6 * s4),
            -s4,
            c4,
            c5 * s4,
            -(c4 * c6 - c5 * s4 * s6),
            -(s4 * s5 * s7 + c4 * c6 * c7 - c5 * c7 * s4 * s6),
            c7 * s4 * s5 - c4 * c6 * s7 + c5 * s4 * s6 * s7,
        ]
    )
    Y[4, [4, 5, 8, 9, 10, 11]] = [-B, c6 * A, -A, -s6 * A, s7 * B - c7 * s6 * A, -(c7 * B + s6 * s7 * A)]
    Y[5, [5, 9, 10, 11]] = [-D, -F, -c7 * F, -s7 * F]
    Y[6, [10, 11]] = [s7 * D - c7 * A, -(s7 * A + c7 * D)]
    return Y
