"""Writes files of the cisst state collector for tests, with the layout of cisstMultiTask 1.4 (prmStateJoint)."""

import itertools
from pathlib import Path

import numpy as np


def joint_state(signal, names, t, q, qd, tau, valid=None):
    """Returns the column names of a signal of type prmStateJoint, and its cells row by row."""
    n = len(q[0])
    fields = [
        f"{signal}.{name}" for name in ("Timestamp:{d}", "AutomaticTimestamp:{b}", "Valid:{b}", "Name.size:{uli}")
    ]
    fields += [f"{signal}.Name[{i}]:{{str}}" for i in range(len(names))]
    for member in ("Position", "Velocity", "Effort"):
        fields += [f"{signal}.{member}.size:{{uli}}", *(f"{signal}.{member}[{i}]:{{d}}" for i in range(n))]
    valid = np.ones(len(t), int) if valid is None else valid
    rows = [
        [repr(float(t[k])), "0", str(int(valid[k])), str(len(names)), *names]
        + [cell for block in (q, qd, tau) for cell in (str(n), *(repr(float(x)) for x in block[k]))]
        for k in range(len(t))
    ]
    return fields, rows


def write_collection(folder: Path, name: str, *signals) -> Path:
    """Writes the signals to NAME.csv and NAME.desc. Returns the path of the CSV."""
    fields = ["Ticks", *(field for columns, _ in signals for field in columns)]
    path = folder / f"{name}.csv"
    rows = zip(*(rows for _, rows in signals), strict=True)
    path.write_text("".join(",".join([str(k), *itertools.chain(*cells)]) + "\n" for k, cells in enumerate(rows)))
    head = [f"/home/lab/{name}.csv", "2025-10-06-13-28-22 1759771686.1629452705", "CSV", ",", str(len(fields)), "0"]
    lines = [*head, str(len(fields)), *(f"Data: {field}" for field in fields)]
    path.with_suffix(".desc").write_text("\n".join(lines) + "\n")
    return path
