"""What the tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Recordings of real arms, which are not part of the project: `<repository>/../shared/data`.

    The environment variable DVRK_DRAKE_SHARED names another place of `shared`.
    """
    default = Path(__file__).resolve().parents[2] / "shared"
    data = Path(os.environ.get("DVRK_DRAKE_SHARED", default)) / "data"
    if not data.is_dir():
        pytest.skip(f"needs recordings of real arms in {data} (DVRK_DRAKE_SHARED names the folder above)")
    return data
