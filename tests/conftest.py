"""Fixtures and markers shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from chromium import chromium_browser, open_page  # noqa: F401
from own_network import pytest_terminal_summary  # noqa: F401

# Must be set before numpy is imported. The matrices are small and each core already has a test worker, so additional
# BLAS threads only wait for each other.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

TESTS = Path(__file__).resolve().parent

#: Prefixes of test files that CI runs with one Python version only, because they do not depend on the Drake version.
ONE_PYTHON = (
    *("recordings/test_collection_file", "recordings/test_lcm_log", "recordings/test_pose_file"),
    *("recordings/test_recording", "recordings/test_conversion", "recordings/test_public_recordings_document"),
    *("recordings/test_array_file", "recordings/test_csv_without_header", "recordings/test_cisst_collector"),
    *("recordings/test_reading", "recordings/test_ros_bag", "recordings/test_samples"),
    "export/test_dvrk_",
    "dynamics/test_nearest_links",
    "systems/guard/",
    *("analysis/check/", "analysis/dynamic/", "analysis/payload/", "analysis/test_recalibration", "analysis/signals/"),
    "analysis/static/",
    *("experiments/test_reproduction", "experiments/study/", "experiments/test_transparency"),
    "experiments/test_tuning",
    *("processes/test_collector", "processes/test_trajectory", "processes/test_live_line", "processes/test_teacher"),
    *("cli/test_collect", "cli/test_formats_in_commands", "test_fuzz_files"),
    *("systems/ros/test_arrival_clock", "systems/ros/test_confirmation", "systems/ros/test_crtk_bridge"),
    *("systems/ros/test_deadman", "systems/ros/test_discovery", "systems/ros/test_domain", "systems/ros/test_joint"),
    *("systems/ros/test_messages", "processes/test_crtk_coll", "processes/test_ros_", "processes/test_dvrk_console"),
    "processes/test_simulated_ros_arm",
    *("reports/", "systems/arm_view/test_view_in_browser"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tests in `ONE_PYTHON`, and runs files with slow tests first, which balances the load of workers."""
    for item in items:
        if item.path.relative_to(TESTS).as_posix().startswith(ONE_PYTHON):
            item.add_marker("one_python")
    long = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in long)


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
