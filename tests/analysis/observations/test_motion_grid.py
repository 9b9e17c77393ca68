"""Resampling of known motions to a grid, folds, and predicted efforts."""

from dataclasses import replace

import numpy as np
import pytest
from motions import friction_everywhere, true_dynamics

import dvrk_drake.analysis.observations.motion_grid as motion_grid_module
from dvrk_drake.analysis.observations.motion_difference import drive_efforts
from dvrk_drake.analysis.observations.motion_grid import GRID_RATE
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import CORRELATION_TIME, FOLDS, phase_folds
from dvrk_drake.dynamics.dynamic_section import SignalSettings
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.recording import Recording

pytestmark = pytest.mark.numeric

ARM = load_arm("mtml")
N = ARM.num_joints
PERIOD = 4.0


def motion(t):
    """Returns q, v, vd (m, n) within the arm's limits, with a period of 4 s."""
    middle, half = (ARM.position_upper + ARM.position_lower) / 2, (ARM.position_upper - ARM.position_lower) / 2
    w, size = 2 * np.pi / PERIOD * np.array([1, 2, 1, 3, 2, 1, 2]), 0.3 * np.minimum(half, 1.0)
    wt = w * t[:, None] + np.arange(N)
    return middle + size * np.sin(wt), size * w * np.cos(wt), -size * w**2 * np.sin(wt)


def recorded(seconds=12.0, rate=200.0):
    t = 5.0 + np.arange(round(seconds * rate) + 1) / rate
    q, v, vd = motion(t)
    return Recording(q=q, qd=v, tau=vd, t=t, source="motion.csv")


@pytest.fixture(scope="module")
def observations():
    return Observations(recorded(), ARM)


@pytest.fixture(scope="module")
def grid(observations):
    return observations.grid


def test_grid_reproduces_the_motion(grid):
    inner = slice(400, -400)
    for found, true in zip((grid.q, grid.v, grid.vd), motion(grid.t), strict=True):
        np.testing.assert_allclose(found[inner], true[inner], atol=0.02 * np.abs(true - true.mean(axis=0)).max())
    assert grid.rate == pytest.approx(200.0)
    np.testing.assert_allclose(np.diff(grid.t), 1 / GRID_RATE, atol=1e-9)
    np.testing.assert_allclose(grid.row_times, 5.0 + np.arange(2401) / 200, atol=1e-9)
    assert grid.inner == slice(120, 2281, 1)  # a twentieth of the motion is left out at each end


def test_parts_give_the_filtered_values_of_the_whole_motion(grid, monkeypatch):
    thinned = replace(Observations(recorded(40.0), ARM).grid, step=3)
    monkeypatch.setattr(motion_grid_module, "PART_ROWS", 1500)
    parts = list(thinned.parts())
    assert len(parts) == 5
    # The square wave has all frequencies, so errors at the ends of the parts would be visible.
    square = np.sign(np.sin(3 * thinned.t))
    expected = thinned.filter_efforts(thinned.at_rows(square, 0))
    found = []
    for part, rows in parts:
        of_part = np.sign(np.sin(3 * part.t))
        found.append(part.filter_rows(part.at_rows(of_part, 0), rows))
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=1e-9)
    assert len(expected) == len(thinned.inner_rows) and np.all(np.diff(thinned.inner_rows) == 3)


def test_predicted_efforts_have_the_effort_delay(grid):
    delays = [0.0, 0.004, -0.01, 0.0, 0.02, 0.0, 0.0]
    settings = SignalSettings(50.0, [20.0] * N, 20.0, delays)
    late = replace(grid, settings=settings)
    lines = np.tile((grid.t - 5.0)[:, None], (1, N))
    rows = late.efforts_at_rows(lines)[late.inner]
    np.testing.assert_allclose(rows, grid.row_times[grid.inner, None] - 5.0 - np.array(delays), atol=1e-9)
    # The low-pass filter does not change a straight line.
    np.testing.assert_allclose(late.filter_efforts(late.efforts_at_rows(lines)), rows, atol=1e-3)


@pytest.mark.parametrize(("seconds", "rate"), [(1.9, 200.0), (12.0, 45.0)])
def test_short_and_coarse_motions_are_rejected(seconds, rate):
    with pytest.raises(RecordingError, match=rf"motion\.csv: .* {seconds} s at {rate:g} Hz. .* at least 2 s"):
        _ = Observations(recorded(seconds, rate), ARM).grid


# Folds


def test_folds_of_a_periodic_motion_follow_the_phase(observations, grid):
    assert observations.period == pytest.approx(PERIOD, abs=1e-3)
    fold, edge = phase_folds(grid, PERIOD)
    t = grid.row_times[grid.inner]
    # With 200 rows per second and 800 per period, a row and the row one period later are in the same fold.
    np.testing.assert_array_equal(fold[800:1600], fold[:800])
    np.testing.assert_allclose(np.bincount(fold[:800]), 800 / FOLDS, atol=1)
    phase = (t - t[0]) % PERIOD
    since = phase - fold * PERIOD / FOLDS
    # Without the rows at the end of the time, which rounding errors assign.
    inside, outside = CORRELATION_TIME - 1e-6, CORRELATION_TIME + 1e-6
    assert np.all(edge[:, 0][since < inside]) and not np.any(edge[:, 0][since > outside])
    until = PERIOD / FOLDS - since
    assert np.all(edge[:, 1][until < inside]) and not np.any(edge[:, 1][until > outside])


def test_folds_of_an_aperiodic_motion_are_contiguous(grid):
    fold, _ = phase_folds(grid, None, 5)
    assert np.all(np.diff(fold) >= 0)
    np.testing.assert_allclose(np.bincount(fold), len(fold) / 5, atol=1)
    slow = Observations(recorded(), ARM)
    slow.grid = replace(grid, q=np.linspace(0, 1, 4000)[:, None] * np.ones(N))
    assert slow.period is None


# Efforts


def test_parts_of_the_efforts_add_up_to_the_model(grid):
    t = np.arange(0, 8, 1e-3)
    effects = friction_everywhere(ARM, (t, *motion(t)))
    model = true_dynamics(ARM, np.random.default_rng(0), effects)
    efforts = drive_efforts(model, grid)
    whole = grid.filter_efforts(grid.efforts_at_rows(model.effort(grid.q, grid.v, grid.vd)))
    size = np.sqrt(np.mean(whole**2, axis=0))
    np.testing.assert_allclose(efforts.total() / size, whole / size, atol=1e-6)
    parts = efforts.friction_part("dry") + efforts.friction_part("viscous")
    np.testing.assert_allclose((efforts.other + parts) / size, whole / size, atol=1e-6)
    # Viscous friction is proportional to the actuators' speeds.
    speed = grid.filter_efforts(grid.efforts_at_rows(ARM.transmission.velocity(grid.v)))
    viscous = [effect.coefficient for effect in effects if effect.kind == "viscous"]
    np.testing.assert_allclose(efforts.friction_part("viscous") / size, speed * viscous / size, atol=1e-6)
    assert set(efforts.friction) == {(effect.coordinate, part) for effect in effects for part in ("dry", "viscous")}
    assert np.all(efforts.friction_part("dry").std(axis=0) > 0.1 * size)
