"""Tests of the preparation of a recording."""

from collections import Counter

import pytest

import dvrk_drake as dvrk
from dvrk_drake.analysis.observations import observations as module
from dvrk_drake.recordings.samples import SAMPLES_FOLDER

#: Functions that `Observations` calls at most once per recording.
PREPARATIONS = ("true_time", "source_fault", "time_fault", "jump_fault", "static_poses", "find_period")


@pytest.fixture
def calls(monkeypatch):
    """Number of calls of each preparation."""
    counts = Counter()

    def counted(name, function):
        def call(*arguments):
            counts[name] += 1
            return function(*arguments)

        return call

    for name in PREPARATIONS:
        monkeypatch.setattr(module, name, counted(name, getattr(module, name)))
    grid = module.Observations._segment_grid
    monkeypatch.setattr(module.Observations, "_segment_grid", counted("grid", grid))
    return counts


class PreparedError(Exception):
    """The recording is prepared."""


def test_a_recording_is_prepared_once(calls, monkeypatch):
    arm = dvrk.load_arm("psm")
    recording = dvrk.read_recording(SAMPLES_FOLDER / "psm_motion.csv", arm).select(slice(3000))

    def stop(*_):
        raise PreparedError

    # Hypotheses about exchanged and inverted channels are other recordings. The other two only need time.
    monkeypatch.setattr("dvrk_drake.analysis.check.channel_check._hypotheses", lambda *_: [])
    for name in ("_scales", "_offsets"):
        monkeypatch.setattr(f"dvrk_drake.analysis.check.channel_check.{name}", lambda *_: ([], set()))
    monkeypatch.setattr("dvrk_drake.analysis.motion_identification.dynamic_columns", stop)
    with pytest.raises(PreparedError):
        dvrk.identify(recording, arm)
    assert calls == dict.fromkeys([*PREPARATIONS, "grid"], 1)
    calls.clear()
    dvrk.validate(dvrk.IdentifiedModel.from_arm(arm, dynamics=True), recording)
    assert calls == dict.fromkeys([*PREPARATIONS, "grid"], 1)
