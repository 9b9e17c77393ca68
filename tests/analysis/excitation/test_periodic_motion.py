"""Periodic motions that start and end at rest, and their files."""

import numpy as np
import pytest
import yaml

from dvrk_drake.analysis.excitation.motion_limits import spectral_derivative
from dvrk_drake.analysis.excitation.periodic_motion import FourierBasis, PeriodicMotion
from dvrk_drake.errors import DvrkDrakeError, ExcitationError
from dvrk_drake.models.arm_files import load_arm

ARM = load_arm("psm")
PERIOD, HARMONICS = 4.0, 5


@pytest.fixture
def motion():
    coefficients = np.random.default_rng(0).normal(size=(ARM.num_joints, 2 * HARMONICS - 1))
    return PeriodicMotion.of_coefficients(ARM, FourierBasis.of(PERIOD, HARMONICS), coefficients, 2)


def test_functions_of_the_basis_are_independent_and_at_rest():
    basis = FourierBasis.of(PERIOD, HARMONICS)
    start = basis.values(np.array([0.0, PERIOD]))
    np.testing.assert_allclose(start[1:3], 0.0, atol=1e-11)  # velocities and accelerations
    values = basis.values(np.linspace(0, PERIOD, 50, endpoint=False))
    assert np.linalg.matrix_rank(values[0]) == values.shape[2] == 2 * HARMONICS - 1
    weights = np.vstack([basis.sines, basis.cosines])
    np.testing.assert_allclose(weights.T @ weights, np.eye(2 * HARMONICS - 2), atol=1e-12)


def test_motion_is_the_weighted_sum_of_the_basis():
    basis, generator = FourierBasis.of(PERIOD, HARMONICS), np.random.default_rng(1)
    coefficients = generator.normal(size=(ARM.num_joints, 2 * HARMONICS - 1))
    motion = PeriodicMotion.of_coefficients(ARM, basis, coefficients, 1)
    t = generator.uniform(0, PERIOD, 20)
    for found, expected in zip(motion.evaluate(t), basis.values(t) @ coefficients.T, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_derivatives_match_the_positions(motion):
    t = np.arange(1000) * PERIOD / 1000
    q, *derivatives = motion.evaluate(t)
    for order, found in enumerate(derivatives, start=1):
        expected = spectral_derivative(q, PERIOD, order)
        # At time 0, the jerk of the motion is 0, and the jerk of the periodic function is not.
        np.testing.assert_allclose(found[1:], expected[1:], atol=1e-9 * np.abs(expected).max())


def test_motion_repeats_and_is_at_rest_outside(motion):
    t = np.linspace(0.1, 3.9, 7)
    first, second = motion.evaluate(t), motion.evaluate(t + PERIOD)
    np.testing.assert_allclose(first.q, second.q, atol=1e-12)
    assert motion.duration == 2 * PERIOD
    outside = motion.evaluate([-1.0, 0.0, motion.duration, motion.duration + 5])
    np.testing.assert_allclose(outside.q, outside.q[:1] * np.ones((4, 1)), atol=1e-12)
    assert not np.any(outside.v) and not np.any(outside.vd)
    # There is no step of velocity or acceleration at the ends.
    near = motion.evaluate([1e-7, motion.duration - 1e-7])
    assert np.abs(near.v).max() < 1e-5 and np.abs(near.vd).max() < 1e-3


def test_file_contains_the_motion(motion, tmp_path):
    path = tmp_path / "motion.yaml"
    motion.save(path)
    assert PeriodicMotion.load(path, ARM) == motion
    with pytest.raises(DvrkDrakeError, match="exists"):
        motion.save(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arm": "MTML"}, 'arm is "MTML", but the selected arm is PSM'),
        ({"format": "dvrk_drake motion 2"}, 'format is "dvrk_drake motion 2"; allowed: "dvrk_drake motion 1"'),
        ({"format": "dvrk_drake poses 1", "poses": []}, 'format is "dvrk_drake poses 1"; allowed'),
        ({"period": 0}, "period"),
        ({"period": ...}, "period is missing"),
        ({"center": [0.0] * 6}, "must have 7 elements each"),
        ({"sine": [[0.1, 0.2]] * 7}, "the same number of coefficients"),
        ({"sine": [[0.1] * 5] * 7}, "does not begin at rest"),
        ({"colour": 1}, "colour"),
    ],
)
def test_wrong_files_are_rejected(motion, tmp_path, change, message):
    path = tmp_path / "motion.yaml"
    motion.save(path)
    content = yaml.safe_load(path.read_text()) | change
    path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not ...}))
    with pytest.raises(ExcitationError) as error:
        PeriodicMotion.load(path, ARM)
    assert message in str(error.value) and str(path) in str(error.value)
