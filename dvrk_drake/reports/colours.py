"""Colours of figures and pages: one colour per role, and a palette for series without a role.

People with deuteranopia (missing green receptors) can distinguish the colours: `tests/reports/test_image_files.py`
simulates their vision. The lightness also differs, for prints without colour. This module imports no plotting library.
"""

from __future__ import annotations

#: Measured values.
MEASURED = "#1f1f1f"
#: Values of a model at the data it was fitted to, and predictions of a model.
FITTED = "#397bdc"
#: Values of a model at data that were not used to fit it.
HELD_OUT = "#e8a532"
#: Commanded values, for example desired positions.
COMMANDED = "#780477"
#: Values to compare with: a nominal model, another method, a published value, a settling band.
REFERENCE = "#2caa67"
#: Limits of the arm, thresholds, and values beyond them.
LIMIT = "#b42508"
#: Context without a message of its own, for example zero torque or a tolerance band.
NEUTRAL = "#c4c8cf"

#: Colours of series without a role, for example variations or joints in one plot. Use them in this order.
SERIES = ("#1a429b", "#eb9804", "#cd1265", "#84ddb8", "#4e5d02", "#976a9f", "#fb6b5f", "#570e2d")

#: Mapping from a colour to its replacement on a dark page. The other colours are visible on both.
DARK = {
    MEASURED: "#e4e8ec",
    "rgba(31,31,31,0.35)": "rgba(228,232,236,0.4)",
    COMMANDED: "#d67ad2",
    LIMIT: "#ff7a5c",
    "#1a429b": "#7ea2f0",
    "#cd1265": "#f0569a",
    "#4e5d02": "#b3c75b",
    "#570e2d": "#d98aa8",
    "#1b2733": "#dfe5ea",
    "#6b7785": "#9aa6b2",
    "#e3e7eb": "#34404b",
}
