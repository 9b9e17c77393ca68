"""Colours of all figures, and a function that saves a figure."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

from dvrk_drake.models.files import atomic_write

matplotlib.use("Agg")

MODEL_COLOUR, ZERO_COLOUR, MEASURED_COLOUR = "#1f6f8b", "#c9c9c9", "#d1495b"


def save_figure(figure: plt.Figure, path: Path) -> None:
    """Writes a PNG file atomically and closes the figure."""
    with atomic_write(path, "wb") as stream:
        figure.savefig(stream, dpi=110, format="png")
    plt.close(figure)
