"""Writes tables of numbers as CSV files."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write

#: Units of the quantities in a CSV, for a revolute and for a prismatic joint.
UNITS = {
    "t": ("s", "s"),
    **dict.fromkeys(("q", "pose"), ("rad", "m")),
    "qd": ("rad/s", "m/s"),
    **dict.fromkeys(("force", "force_lower", "force_upper"), ("N", "N")),
    **dict.fromkeys(("tau", "lower", "upper", "lower_other_day", "upper_other_day", "friction"), ("N m", "N")),
}


def column_names(prefix: str, num_joints: int, arm: Arm | None = None) -> list[str]:
    """Returns the column names of a quantity in a CSV, e.g. "q1". With `arm`, they contain the units, e.g. "q1 [rad]".

    Args:
        prefix: Name of the quantity, a key of `UNITS` if `arm` is given.
        num_joints: Number of columns, except for the time t.
        arm: Arm that defines which joints are prismatic.
    """
    names = ["t"] if prefix == "t" else [f"{prefix}{i + 1}" for i in range(num_joints)]
    if arm is None:
        return names
    return [f"{name} [{UNITS[prefix][bool(arm.prismatic[i])]}]" for i, name in enumerate(names)]


def write_csv(
    path: str | Path, blocks: Mapping[str, NDArray[np.float64]], arm: Arm | None, stated: Mapping[str, str]
) -> None:
    """Writes a table of numbers atomically and with full precision.

    Args:
        path: Path of the file. An existing file is replaced.
        blocks: Mapping from the prefix of the columns (key of `UNITS`) to their numbers (m, n), or (m,) for the time t.
        arm: Arm that defines the units of the columns. None: the names of the columns have no units.
        stated: Mapping from the names of further columns to the text in each of their rows. Empty texts are omitted.

    Raises:
        DvrkDrakeError: The folder does not exist or cannot be written.
    """
    tables = {prefix: block if block.ndim == 2 else block[:, None] for prefix, block in blocks.items()}
    stated = {name: text for name, text in stated.items() if text}
    header = [name for prefix, table in tables.items() for name in column_names(prefix, table.shape[1], arm)]
    with atomic_write(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*header, *stated])
        writer.writerows([*map(repr, row), *stated.values()] for row in np.hstack(list(tables.values())).tolist())
