"""Runs the dVRK's own gravity compensation (`judge`, `judge_psm`) on exported files, and skips where it is absent."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest


def judge(shared_data: Path, name: str, file: Path, rows: np.ndarray) -> np.ndarray:
    """Returns the torques that the dVRK's controller computes from `file` for rows of positions (and velocities)."""
    peer = shared_data.parent / "peers" / "dvrk_console"
    program = peer / "bin" / name
    if not program.is_file():
        pytest.skip(f"needs the dVRK's controller {program}")
    lines = "".join(" ".join(repr(float(x)) for x in row) + "\n" for row in rows)
    done = subprocess.run(
        [program, file],
        input=lines,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "LD_LIBRARY_PATH": str(peer / "lib")},
    )
    if done.returncode == 127:
        pytest.skip(f"{name} misses a library; see README.md in {peer}: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
