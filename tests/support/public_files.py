"""Creates files with the layouts of public recordings and known numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from dvrk_drake.errors import RecordingError


def team_array(num_poses: int = 5) -> np.ndarray:
    """Returns an array (8, 2, N): position j + k/100 of joint j at pose k (from 1), effort -10 times the position."""
    joint, pose = np.meshgrid(np.arange(1, 9), np.arange(1, num_poses + 1) / 100, indexing="ij")
    return np.stack([joint + pose, -10 * (joint + pose)], axis=1)


def wpi_rows(num_rows: int = 4) -> np.ndarray:
    return np.arange(21 * num_rows).reshape(num_rows, 21) / 7


def write_mat(folder: Path, **variables: object) -> Path:
    path = folder / "poses.mat"
    scipy.io.savemat(path, variables, do_compression=True)
    return path


def write_text(folder: Path, text: str) -> Path:
    path = folder / "motion.csv"
    path.write_bytes(text.encode())
    return path


def write_wpi(folder: Path, rows: np.ndarray) -> Path:
    return write_text(folder, "".join(",".join(repr(float(x)) for x in row) + "\n" for row in rows))


def assert_refused(match: str, function, *args, **kwargs) -> None:
    with pytest.raises(RecordingError, match=match) as caught:
        function(*args, **kwargs)
    assert "\n" not in str(caught.value)


NUMBERS = ",".join(["1"] * 21)
