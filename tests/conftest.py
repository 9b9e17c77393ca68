"""What the tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

#: Files of which CI runs one Python only: what they test uses nothing of Drake that differs between its versions.
ONE_PYTHON = (
    *(
        "test_collect",
        "test_command_guard",
        "test_convert",
        "test_guard_",
        "test_lcm_log",
        "test_payload",
        "test_pose_file",
    ),
    *(
        "test_recalibration",
        "test_record",
        "test_static_identification",
        "test_slow_parts",
        "test_study",
        "test_teacher",
    ),
    *("test_gravity_compensation", "test_kinematic_compensation", "test_reproduction", "test_transparency", "test_leg"),
    *("test_parameter_uncertainty", "test_nearest_links", "test_measures", "test_live_line", "test_dynamic_statics"),
    *("test_tuning", "test_whitening", "test_dynamic_identification", "test_dynamic_choice", "test_psm_identification"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tests of these files."""
    for item in items:
        if item.path.name.startswith(ONE_PYTHON):
            item.add_marker("one_python")


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
