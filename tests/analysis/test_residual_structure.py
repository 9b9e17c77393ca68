"""Structure in a residual is found where it is, and nowhere else."""

import numpy as np
import pytest

from dvrk_drake.analysis.error_shares import MIN_SHARE, residual_structure


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
