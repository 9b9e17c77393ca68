"""Tests mirrored wrists of left and right arms: equations, files of real arms, exported models."""

import dataclasses

import numpy as np
import pytest
from command_output import messages, refusal

from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.analysis.validation import validate_static
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ModelError
from dvrk_drake.experiments.reproduction.published import PAPER
from dvrk_drake.export.dvrk_mtm_gravity_compensation import CompensationOptions, compensation_from_model
from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import compare_compensation
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile, controller_torque
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions
from dvrk_drake.recordings.reading import read_recording

pytestmark = pytest.mark.drake_api

#: Signs that mirror the joint angles and torques of an arm in the plane x = 0.
MIRROR = np.array([-1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0])


def torque(arm, q):
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    return holding_torque(plant, context, arm)


def test_left_and_right_are_mirror_images():
    left, right = load_arm("mtml"), load_arm("mtmr")
    for q in left.sample_poses(5, np.random.default_rng(0)):
        np.testing.assert_allclose(torque(left, q), MIRROR * torque(right, MIRROR * q), atol=1e-12)
        assert np.abs(torque(left, q) - torque(right, q)).max() > 0.01


@pytest.mark.slow
def test_the_papers_recording_is_of_a_right_arm(shared_data):
    """Checks that the model of a right arm predicts the recording better than the mirrored recording."""
    model = identify_static(
        read_recording(shared_data / "mtm_static/mtmr_2017_coupled12_may10.csv"), load_arm(PAPER.arm)
    ).model
    poses = read_recording(shared_data / "mtm_static/mtm_2015_good72.csv")
    mirrored = dataclasses.replace(poses, q=MIRROR * poses.q, tau=MIRROR * poses.measured_effort())
    right, left = (validate_static(model, recording).joints[1:4] for recording in (poses, mirrored))
    for as_it_is, as_mirrored in zip(right, left, strict=True):
        assert as_it_is.rms_error_included < 0.5 * as_mirrored.rms_error_included


def test_mirrored_file_of_a_right_arm_predicts_left_arms(shared_data):
    folder = shared_data / "gc_json"
    if not folder.is_dir():
        pytest.skip(f"needs {folder}")
    right = GravityCompensationFile.load(folder / "gc-MTMR-32336.json")
    for serial in ("MTML-22723", "MTML-34863"):
        left = GravityCompensationFile.load(folder / f"gc-{serial}.json")
        q = np.random.default_rng(0).uniform(*left.sweep, (2000, 7))
        q = q[np.abs(q[:, 1] + q[:, 2]) < 0.2]  # range of the parallelogram in the sweeps of both files
        tau = controller_torque(left, q)
        as_it_is = np.sqrt(np.mean((controller_torque(right, q) - tau) ** 2, axis=0))
        mirrored = np.sqrt(np.mean((MIRROR * controller_torque(right, MIRROR * q) - tau) ** 2, axis=0))
        assert np.all(mirrored[1:3] < 0.5 * as_it_is[1:3]) and mirrored[3] < as_it_is[3], (as_it_is, mirrored)


def stock(name):
    return IdentifiedModel.from_arm(load_arm(name))


def test_compare_gc_refuses_a_file_of_another_arm(tmp_path, capsys):
    path = tmp_path / "gc.json"
    file = compensation_from_model(stock("mtml"), CompensationOptions(tolerance=0.01))
    file.save(path, "MTML", "test")
    assert main(["export", "compare", str(path), "--arm", "mtmr"]) == 2
    error = refusal(capsys.readouterr().err)
    assert error.startswith(f"dvrk-drake: error: {path}: the file belongs to MTML") and "model belongs to MTMR" in error
    # A file with a wrong arm name is compared. A warning shows that the name is wrong.
    file.save(path, "MTMR", "test")
    assert main(["export", "compare", str(path), "--arm", "mtmr"]) == 0
    (warning,) = messages(capsys.readouterr().err)
    assert "the mirror image of the model fits better" in warning
    file.save(path, "MTML", "test")
    assert main(["export", "compare", str(path), "--arm", "mtml"]) == 0
    assert not messages(capsys.readouterr().err)


def test_arm_is_taken_from_the_file_name_if_missing(tmp_path):
    file = compensation_from_model(stock("mtml"), CompensationOptions(tolerance=0.01))
    for name, arm in (("gc-MTML-12345.json", "MTML"), ("gc-mtmr.json", "MTMR"), ("gc.json", "")):
        file.save(tmp_path / name, "", "test")
        assert GravityCompensationFile.load(tmp_path / name).arm_name == arm
    with pytest.raises(ModelError, match="the file belongs to MTMR"):
        compare_compensation(GravityCompensationFile.load(tmp_path / "gc-mtmr.json"), stock("mtml"))


#: The last file is labelled MTMR, but is of a left arm: docs/identification.md, Left and right.
REAL_FILES = [("MTML-22723", "mtml"), ("MTML-34863", "mtml"), ("MTMR-32336", "mtmr"), ("MTMR-22403", "mtml")]


@pytest.mark.slow
@pytest.mark.parametrize(("serial", "side"), REAL_FILES)
def test_side_is_detected_from_the_parameters_of_a_real_file(shared_data, serial, side):
    path = shared_data / "gc_json" / f"gc-{serial}.json"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    file = GravityCompensationFile.load(path)
    assert file.arm_name == serial.split("-")[0]
    for name in ("mtml", "mtmr"):
        comparison = compare_compensation(dataclasses.replace(file, arm_name=""), stock(name))
        assert comparison.other_side == (name != side)
