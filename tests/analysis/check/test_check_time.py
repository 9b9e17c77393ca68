"""Checks of the times of a motion: repeated rows, jitter, gaps and wrong units."""

from dataclasses import replace

import numpy as np
import pytest
from check_findings import ARMS, found
from synthetic_motion import RATE, clean_motion

from dvrk_drake.analysis.observations.true_time import true_time
from dvrk_drake.models.arm_files import load_arm

pytestmark = pytest.mark.slow


def test_detects_a_slower_effort_topic():
    whole = clean_motion()
    every_other = np.arange(len(whole)) // 2 * 2
    kinds = found(replace(whole, tau=whole.tau[every_other]))
    assert [f.where for f in kinds["repeated channel"]] == ["tau"]
    assert kinds["repeated channel"][0].size == pytest.approx(0.5, abs=0.01)
    assert "repeated rows" not in kinds


def test_detects_a_gap_in_the_times():
    whole = clean_motion()
    keep = np.ones(len(whole), bool)
    keep[1000:1100] = False
    cut = replace(whole, q=whole.q[keep], qd=whole.qd[keep], tau=whole.tau[keep], t=whole.t[keep])
    gap = found(cut)["gaps"][0]
    assert gap.size == pytest.approx(101 / RATE, abs=1e-9)
    assert "row 1001" in gap.what
    assert set(found(cut)) == {"gaps", "repetition"}


def test_refuses_decreasing_times():
    whole = clean_motion()
    t = whole.t.copy()
    t[500] = t[498]
    refusal = found(replace(whole, t=t))["time goes back"][0]
    assert refusal.severity == "refusal"
    assert "row 501" in refusal.what


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "milliseconds"), (1e9, "nanoseconds"), (7 / 6, "wrong rate")])
def test_refuses_times_in_another_unit(factor, unit):
    whole = clean_motion()
    refusal = found(replace(whole, t=whole.t * factor))["wrong time"][0]
    assert refusal.severity == "refusal"
    assert refusal.size == pytest.approx(factor, rel=1e-2)
    assert unit in refusal.what


@pytest.mark.parametrize("name", ARMS)
def test_finds_time_that_stalls_at_repeated_rows(name):
    """The rows are repeated while the recorded times continue, so the motion takes longer than in the arm."""
    whole, arm = clean_motion(name), load_arm(name)
    repeats = np.random.default_rng(6).random(len(whole)) < 0.12
    index = np.repeat(np.arange(len(whole)), 1 + repeats)
    t = np.arange(len(index)) / RATE
    stalled = replace(whole, q=whole.q[index], qd=whole.qd[index], tau=whole.tau[index], t=t)
    kinds = found(stalled, name)
    (finding,) = kinds["repeated rows"]
    assert finding.severity == "warning" and "removed from the times" in finding.advice
    assert finding.size == pytest.approx(1 - len(whole) / len(index), abs=0.005)
    assert "wrong time" not in kinds and "jitter" not in kinds
    clock = true_time(stalled.in_actuator_coordinates(arm))
    assert clock.t[-1] - clock.t[0] == pytest.approx(whole.t[-1] - whole.t[0], rel=0.005)
    # The recorded times of a topic that is polled too fast are correct.
    last = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(whole))))
    polled = replace(whole, q=whole.q[last], qd=whole.qd[last], tau=whole.tau[last])
    (finding,) = found(polled, name)["repeated rows"]
    assert "removed from the times" not in finding.advice and "line" not in finding.what


@pytest.mark.parametrize("with_velocities", [True, False])
def test_quantised_measurements_at_rest_are_not_repeated_rows(with_velocities):
    """Half of the recording is at rest: positions and efforts are equal, with occasional changes by one count."""
    whole = clean_motion()
    count, half = 1e-4, len(whole) // 2
    q, qd, tau = (np.array(x) for x in (whole.q, whole.qd, whole.tau))
    flicker = np.random.default_rng(7).random(len(q) - half) < 0.05
    q[half:], qd[half:], tau[half:] = q[half], 0.0, tau[half]
    q = np.round(q / count) * count
    q[half:, 0] += count * flicker
    quiet = replace(whole, q=q, qd=qd if with_velocities else None, tau=np.round(tau, 3))
    assert "repeated rows" not in found(quiet)
    rows = np.arange(len(q))
    rows[[100, 101, 300]] = 99, 99, 299
    repeated = replace(quiet, q=q[rows], tau=quiet.tau[rows], qd=quiet.qd[rows] if with_velocities else None)
    (finding,) = found(repeated)["repeated rows"]
    assert finding.severity == "note" and finding.what.startswith("3 rows (")
    assert f"first at {repeated.where(100)}" in finding.what
