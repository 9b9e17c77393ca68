"""Recordings as text, and random recordings."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import Gains
from dvrk_drake.recordings.recording import Recording

Q_NAMES = [f"q{i}" for i in range(1, 8)]
TAU_NAMES = [f"tau{i}" for i in range(1, 8)]
HEADER = ",".join([*Q_NAMES, *TAU_NAMES])
ROW = ",".join(f"0.{i}" for i in range(1, 15))
# Published coupling q_joint = M_MTM q_actuator, independent of the arm files.
M_MTM = np.eye(7)
M_MTM[1:4, 1:4] = [[1, 0, 0], [-1, 1, 0], [0.6697, -0.6697, 1]]


def write_text(folder: Path, text: str | bytes) -> Path:
    path = folder / "recording.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def csv_block(path: Path | str, *prefixes: str) -> np.ndarray:
    """Returns the columns (m, k) of quantities in a CSV, e.g. "tau1 [N m]", "tau2 [N m]", ... for the prefix "tau"."""
    with open(path, newline="") as stream:
        header, *rows = csv.reader(stream)
    names = [name.partition(" [")[0].rstrip("0123456789") for name in header]
    columns = [column for prefix in prefixes for column, name in enumerate(names) if name == prefix]
    return np.array([[row[column] for column in columns] for row in rows], float)


def random_recording(num_rows: int = 20, **changes: object) -> Recording:
    q, qd, tau = np.random.default_rng(7).uniform(-0.2, 0.2, (3, num_rows, 7))
    return replace(Recording(q=q, tau=tau, qd=qd, t=np.arange(num_rows) / 3), **changes)


SIX = ",".join([*Q_NAMES[:6], *TAU_NAMES[:6]])


def six_joint_arm():
    psm = load_arm("psm")
    arrays = ("joint_names", "position_lower", "position_upper", "effort_limits", "prismatic")
    gains = Gains(psm.gains.kp[:6], psm.gains.kd[:6], psm.gains.ki[:6])
    return replace(psm, gains=gains, **{name: getattr(psm, name)[:6] for name in arrays})
