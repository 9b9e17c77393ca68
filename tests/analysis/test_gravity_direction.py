"""Direction of gravity from static poses: estimate, interval, warning, and poses that do not determine it."""

import re

import numpy as np
import pytest
from command_output import refusal

import dvrk_drake as dvrk
from dvrk_drake.analysis.identification import LARGE_TILT, gravity_direction
from dvrk_drake.cli import main
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.errors import IdentificationError
from dvrk_drake.recordings.formats import write_recording
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.answers import answer_of

#: The first three joints of a PSM, because their gravity model is derived quickly.
LOCKED = {"roll": 0.0, "wrist_pitch": 0.0, "wrist_yaw": 0.0, "jaw": 0.0}
ARM = dvrk.lock_joints(dvrk.load_arm("psm"), LOCKED)
TILTED = [4.905, 0.0, -8.4957]


def poses(gravity, seed=0, count=40, share=1.0, noise=0.001):
    """Returns poses of an arm with this gravity vector and links that are 10 % heavier than in the SDF.

    The poses cover a share of the range of each joint.
    """
    generator = np.random.default_rng(seed)
    q = ARM.sample_poses(count, generator, margin=0.02)
    q = q.mean(axis=0) + share * (q - q.mean(axis=0))
    regressor = DynamicRegressor(ARM).with_gravity(gravity)
    heavier = regressor.values * 1.1
    tau = regressor.torque(q, 0 * q, 0 * q, heavier) + 0.02 * ARM.effort_limits
    return Recording(q=q, tau=tau + noise * ARM.effort_limits * generator.normal(size=q.shape), source="poses.csv")


@pytest.mark.slow
def test_interval_contains_the_tilt():
    """If 95 % of the intervals contain the tilt, fewer than 5 of 8 do so in 4e-4 of all cases."""
    found = [gravity_direction(poses(TILTED, seed), ARM) for seed in range(8)]
    tilts = np.array([direction.tilt for direction in found])
    half_widths = np.array([direction.half_width for direction in found])
    assert np.sum(np.abs(tilts - np.deg2rad(30.0)) < half_widths) >= 5
    assert np.all(half_widths < np.deg2rad(5.0)) and all(direction.is_large for direction in found)
    errors = [np.linalg.norm(direction.gravity - TILTED) / 9.81 for direction in found]
    assert max(errors) < np.deg2rad(5.0)
    assert np.linalg.norm(found[0].gravity) == pytest.approx(9.81, abs=1e-9)


def test_upright_arm_is_not_reported():
    for seed in range(2):
        direction = gravity_direction(poses(ARM.gravity, seed), ARM)
        assert direction.tilt < LARGE_TILT and not direction.is_large


@pytest.mark.slow
def test_forgotten_tilt_is_reported_and_estimated(tmp_path, capsys):
    recording = poses(TILTED)
    result = dvrk.identify(recording, ARM)
    (warning,) = [w for w in result.warnings if w.kind == "base tilt"]
    assert " --gravity estimate --output MODEL.yaml" in answer_of(result).next_command
    tilt, low, high = map(
        float, re.search(r"([\d.]+) deg \(95 % interval ([\d.]+) to ([\d.]+) deg\)", str(warning)).groups()
    )
    assert low < 30 < high and low < tilt < high and "--gravity estimate" in str(warning)
    write_recording(recording, path := str(tmp_path / "poses.csv"))
    model = tmp_path / "model.yaml"
    result.save(model)
    export = ["export", "--model", str(model), "--gc-tolerance", "9", "--dvrk-kinematic-gc"]
    assert main([*export, str(tmp_path / "gc.json")]) == 0
    assert (
        "the base of the recorded arm seems to be tilted, but the model assumes that it is not (gravity estimated"
        in (capsys.readouterr().err)
    )
    words = ["identify", path, "--arm", "psm", "--locked", *(f"{name}=0" for name in LOCKED), "--output", str(model)]
    assert main([*words, "--gravity", "estimate", "--overwrite"]) == 0
    output = capsys.readouterr()
    assert "base seems to be tilted" not in output.err
    assert "Gravity in the base frame, estimated from the poses: (" in " ".join(output.out.split())
    assert main([*export, str(tmp_path / "other.json")]) == 0
    assert "tilted" not in capsys.readouterr().err
    loaded = dvrk.IdentifiedModel.load(model)
    np.testing.assert_allclose(loaded.arm.gravity, TILTED, atol=9.81 * np.deg2rad(3.0))
    assert dvrk.validate(loaded, poses(TILTED, seed=7)).verdict == "good"
    assert main([*words, "--overwrite", "--gravity", "0", "4.9"]) == 2
    assert "--gravity needs three numbers [m/s^2], or the word estimate" in refusal(capsys.readouterr().err)


def test_narrow_poses_do_not_determine_the_direction():
    recording = poses(TILTED, share=0.05, noise=0.01)
    with pytest.raises(IdentificationError, match=r"do not determine the direction of gravity: .* Measure the tilt"):
        dvrk.identify(recording, ARM, estimate_gravity=True)
    upright = poses(ARM.gravity, share=0.05, noise=0.01)
    assert not gravity_direction(upright, ARM).is_large
