"""Fixtures and markers shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from chromium import chromium_browser, open_page  # noqa: F401
from identified_poses import identified_poses  # noqa: F401
from own_network import pytest_runtest_protocol, pytest_sessionfinish, pytest_terminal_summary, pytest_testnodedown  # noqa: F401

# Must be set before numpy is imported. The matrices are small and each core already has a test worker, so additional
# BLAS threads only wait for each other.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

TESTS = Path(__file__).resolve().parent


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Adds the markers `browser` and `slow` to tests in a browser. CI selects them by the first one."""
    for item in items:
        if "open_page" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Returns the folder with recordings of real arms, which are not part of the repository.

    The default is `<repository>/../shared/data`. The environment variable DVRK_DRAKE_SHARED replaces `shared`.
    """
    default = TESTS.parents[1] / "shared"
    data = Path(os.environ.get("DVRK_DRAKE_SHARED", default)) / "data"
    if not data.is_dir():
        pytest.skip(f"needs recordings of real arms in {data} (DVRK_DRAKE_SHARED names the folder above)")
    return data
