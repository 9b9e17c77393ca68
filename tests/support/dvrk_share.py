"""Reads the dVRK's configuration files in the shared folder, and evaluates their DH tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dvrk_drake.errors import ArmError
from dvrk_drake.models.files import read_json_input

#: Largest rounding error of an angle in the files [rad], e.g. 1.5708 for a quarter turn.
ROUNDING = 1e-5


def dvrk_share(shared_data: Path) -> Path:
    """Returns the folder with the dVRK's configuration files. Skips the test if it is absent."""
    share = shared_data.parent / "peers" / "dvrk_console" / "share"
    if not share.is_dir():
        pytest.skip(f"needs the configuration files of the dVRK in {share}")
    return share


def dh_rows(path: Path) -> list[dict[str, Any]]:
    """Returns the rows of the DH table in a file, with exact eighths of a turn in place of e.g. 1.5708."""
    table = read_json_input(path, ArmError)["DH"]
    assert table["convention"] == "modified"
    return [exact_eighths(row) for row in table.get("joints") or table["links"]]


def exact_eighths(row: dict[str, Any]) -> dict[str, Any]:
    """Returns a row of a DH table with exact eighths of a turn."""
    row = dict(row)
    for key in {"alpha", "theta", "offset"} & row.keys():
        exact = round(row[key] / (np.pi / 4)) * np.pi / 4
        row[key] = exact if abs(row[key] - exact) < ROUNDING else row[key]
    return row


def craig(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    """Returns the transformation (4, 4) of modified DH parameters."""
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    X_alpha = np.array([[1, 0, 0, a], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
    return X_alpha @ np.array([[ct, -st, 0, 0], [st, ct, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]])


def dh_poses(rows: list[dict[str, Any]], q: np.ndarray) -> list[np.ndarray]:
    """Returns the pose (4, 4) of each DH frame in the base frame, at the positions q (n,) [rad, m]."""
    X, poses = np.eye(4), []
    for row, position in zip(rows, q, strict=True):
        prismatic = row["type"] == "prismatic"
        offset = position + row.get("offset", 0.0)
        theta = row["theta"] + (0.0 if prismatic else offset)
        X = X @ craig(row["alpha"], row["A"], theta, row["D"] + (offset if prismatic else 0.0))
        poses.append(X)
    return poses
