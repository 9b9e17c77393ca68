"""Shares of the effort error by cause, and structure in a residual."""

import numpy as np
import pytest

from dvrk_drake.analysis.error_shares import MIN_SHARE, SHARE_LABELS, ErrorShares, error_shares, residual_structure
from dvrk_drake.analysis.observations.signals import MOTION_FREQUENCY

pytestmark = pytest.mark.numeric

PERIOD, PASSES, RATE = 8.0, 4, 100.0
t = np.arange(PERIOD * PASSES * RATE) / RATE
OMEGA = 2 * np.pi / PERIOD


def motion():
    """Returns positions, velocities and accelerations (r, 3) of a periodic motion of three actuators."""
    rng = np.random.default_rng(3)
    k = np.arange(1, 6)[:, None]
    amplitude, phase = rng.uniform(0.2, 1.0, (5, 3)) / k, rng.uniform(0, 2 * np.pi, (5, 3))
    angle = OMEGA * k * t[:, None, None] + phase
    q = np.sum(amplitude * np.sin(angle), axis=1)
    v = np.sum(amplitude * OMEGA * k * np.cos(angle), axis=1)
    return q, v, -np.sum(amplitude * (OMEGA * k) ** 2 * np.sin(angle), axis=1)


Q, V, VD = motion()
NOISE = np.random.default_rng(0).normal(size=len(t))


def shares(error, period=PERIOD):
    return error_shares(error, 0, Q, V[:, 0], VD, t, period)


@pytest.mark.parametrize(
    ("cause", "error"),
    [
        ("bias", np.ones_like(t)),
        ("friction_like", np.sign(V[:, 0]) - np.mean(np.sign(V[:, 0]))),
        ("friction_like", V[:, 0]),
        ("position_dependent", np.sin(2 * Q[:, 0]) - np.mean(np.sin(2 * Q[:, 0]))),
        ("acceleration_dependent", VD[:, 0]),
        ("posture_dependent", np.sin(Q[:, 1]) * 3 + np.cos(Q[:, 2])),
        ("not_repeating", NOISE),
        ("fast", np.sin(2 * np.pi * 5.0 * t)),
    ],
)
def test_error_with_one_cause_has_no_share_of_later_causes(cause, error):
    # The previous causes explain a part by chance, because all signals are slow and have the same period.
    found, number = shares(error), ErrorShares._fields.index(cause)
    assert found[number] > 0.25
    if cause != "friction_like" or np.all(error == V[:, 0]):
        assert sum(found[: number + 1]) > 0.95


def test_sum_of_shares_is_one_and_no_share_is_negative():
    error = NOISE + np.sign(V[:, 0]) + 0.3 + np.sin(2 * np.pi * 5.0 * t)
    assert sum(shares(error)) == pytest.approx(1.0, abs=1e-9)
    assert min(shares(error)) > -1e-9
    assert len(SHARE_LABELS) == len(ErrorShares._fields)


def test_motion_without_period_has_no_share_that_does_not_repeat():
    found = shares(NOISE, period=None)
    assert found.not_repeating is None
    # White noise is above `MOTION_FREQUENCY`, except for the share of it in half the rate.
    assert found.fast == pytest.approx(1 - MOTION_FREQUENCY / (RATE / 2), abs=0.05)
    assert sum(x for x in found if x is not None) == pytest.approx(1.0, abs=1e-9)


def test_error_of_zero_has_no_shares():
    assert not any(shares(np.zeros_like(t)))


# Structure in a residual is found where it is, and nowhere else.


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("first harmonic of its position", lambda q, tau: np.sin(q + 0.3)),
        ("second harmonic of its position", lambda q, tau: np.cos(2 * q - 1.0)),
        ("load (the effort itself)", lambda q, tau: 0.5 * tau),
    ],
)
def test_structure_of_poses_is_named(name, make):
    generator = np.random.default_rng(0)
    q, tau = generator.uniform(-3, 3, 60), generator.normal(size=60)
    found = residual_structure(0.2 + make(q, tau) + 0.1 * generator.normal(size=60), q, tau)
    assert found[0][0] == name and 0.9 < found[0][1] <= 1.0
    assert len(found) == 1


@pytest.mark.parametrize("is_motion", [False, True])
def test_noise_has_no_structure(is_motion):
    for seed in range(20):
        generator = np.random.default_rng(seed)
        q, tau, error, v = generator.normal(size=(4, 60))
        found = residual_structure(error, q, tau, v if is_motion else None)
        assert all(share < 0.5 for _, share in found), "a share that is expected by chance is subtracted"
        assert all(share >= MIN_SHARE for _, share in found)


def test_hysteresis_of_a_motion_is_told_from_friction():
    t = np.linspace(0, 60, 12000)
    q = np.sin(t) * np.clip(np.sin(0.5 * t), 0, 1)  # the joint rests half of the time
    v = np.gradient(q, t)
    width = 0.1 * np.sqrt(np.mean(v**2))
    last = 0.0
    hysteresis = np.array([last := np.sign(x) if abs(x) > width else last for x in v])
    tau = np.cos(3 * t)
    assert residual_structure(hysteresis, q, tau, v)[0][0].startswith("hysteresis")
    assert residual_structure(np.tanh(v / width), q, tau, v)[0][0].startswith("friction (velocity)")
    by_load = residual_structure(np.abs(tau) * np.tanh(v / width), q, tau, v)
    assert by_load[0][0] == "friction that grows with the load"
