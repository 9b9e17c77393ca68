"""Tests the Python code in docs/public_recordings.md."""

from __future__ import annotations

import re

import numpy as np
import pytest
from repository import ROOT

from dvrk_drake.recordings.reading import read_recording

DOCUMENT = ROOT / "docs" / "public_recordings.md"


def document_functions() -> dict[str, object]:
    namespace: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, namespace)
    return namespace


@pytest.mark.parametrize("average", [False, True])
def test_documented_code_for_2017_pairs(tmp_path, average):
    position, effort = np.random.default_rng(5).normal(size=(2, 8, 10, 4))
    effort[:, :, 3] = 0
    document_functions()["write_2017"](position, effort, tmp_path / "poses.csv", average)
    recording = read_recording(tmp_path / "poses.csv")
    assert len(recording) == (3 if average else 30)
    if average:
        np.testing.assert_allclose(recording.q[2], position[:7, :, 2].mean(axis=1), atol=1e-12)
    else:
        np.testing.assert_array_equal(recording.tau[13], effort[:7, 3, 1])
