"""Colours of roles and series are different for people with and without deuteranopia, and in a grey print."""

from itertools import combinations

import numpy as np
import pytest

from dvrk_drake.reports import colours
from dvrk_drake.reports.colours import SERIES

ROLES = [value for name, value in vars(colours).items() if name.isupper() and isinstance(value, str)]
#: Linear RGB of a colour -> linear RGB that a deuteranope sees as the same colour. Machado, Oliveira and
#: Fernandes (2009), "A physiologically-based model for simulation of color vision deficiency", severity 1.0.
DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
#: Linear RGB -> XYZ (IEC 61966-2-1), and its white.
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = TO_XYZ.sum(axis=1)
#: Smallest colour difference Delta E (CIE 1976). A difference of 2.3 is just noticeable for adjacent areas. Thin lines
#: need about ten times this difference.
SMALLEST_DIFFERENCE = 30.0
#: Smallest difference of the lightness L*, for prints without colour.
SMALLEST_LIGHTNESS_DIFFERENCE = 6.0


def linear_rgb(colour):
    c = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """Returns L*, a*, b* (CIE 1976) of a colour in linear RGB."""
    x = TO_XYZ @ rgb / WHITE
    fx, fy, fz = np.where(x > 216 / 24389, np.cbrt(x), (24389 / 27 * x + 16) / 116)
    return np.array([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)])


def deuteranope(rgb):
    return np.clip(DEUTERANOPIA @ rgb, 0.0, 1.0)


@pytest.mark.parametrize("palette", [ROLES, SERIES], ids=["roles", "series"])
def test_all_colours_differ(palette):
    for one, other in combinations(palette, 2):
        a, b = linear_rgb(one), linear_rgb(other)
        assert np.linalg.norm(lab(a) - lab(b)) > SMALLEST_DIFFERENCE, (one, other)
        assert np.linalg.norm(lab(deuteranope(a)) - lab(deuteranope(b))) > SMALLEST_DIFFERENCE, (one, other)
        assert abs(lab(a)[0] - lab(b)[0]) > SMALLEST_LIGHTNESS_DIFFERENCE, (one, other)
