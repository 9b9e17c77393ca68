"""Sample recordings: files, equality of formats, results of an identification, and refused folders."""

from __future__ import annotations

import importlib.util
import re

import numpy as np
import pytest
from command_output import assert_refused
from forked import public_folder, run_unprivileged
from repository import ROOT

import dvrk_drake as dvrk
from dvrk_drake.cli import main
from dvrk_drake.recordings.formats import SAMPLES, SAMPLES_FOLDER, read_recording

FILES = {f"{name}{suffix}" for name in SAMPLES for suffix in (".csv", ".mcap")}
#: Largest tracking error of the simulated motions [rad, m]: friction stops the light wrist joints of an MTM.
TRACKING = {"mtmr": 0.2, "psm": 0.05}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("samples") / "new" / "samples"
    files = dvrk.write_samples(folder)
    assert {path.name for path in files} == {path.name for path in folder.iterdir()} == FILES
    return folder


def test_files_of_the_package_are_small_ascii_text(folder):
    assert {path.name for path in SAMPLES_FOLDER.iterdir()} == {f"{name}.csv" for name in SAMPLES}
    for path in SAMPLES_FOLDER.iterdir():
        assert path.stat().st_size < 1e6
    for name in SAMPLES:
        assert (folder / f"{name}.csv").read_bytes() == (SAMPLES_FOLDER / f"{name}.csv").read_bytes()
        assert (folder / f"{name}.csv").read_bytes().isascii()


@pytest.mark.parametrize("name", SAMPLES)
def test_bag_equals_the_csv(folder, name):
    arm = dvrk.load_arm(SAMPLES[name])
    csv, bag = (dvrk.read_recording(folder / f"{name}{suffix}", arm) for suffix in (".csv", ".mcap"))
    assert not bag.notes
    np.testing.assert_array_equal(bag.q, csv.q)
    np.testing.assert_array_equal(bag.tau, csv.tau)
    if name.endswith("motion"):
        np.testing.assert_array_equal(bag.qd, csv.qd)
        np.testing.assert_allclose(bag.t, csv.t, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", SAMPLES)
def test_check_reports_no_warnings(name):
    arm = dvrk.load_arm(SAMPLES[name])
    report = dvrk.check(dvrk.read_recording(SAMPLES_FOLDER / f"{name}.csv", arm), arm)
    assert not report.warnings and not report.refusals


@pytest.mark.slow
def test_identified_model_is_better_than_the_nominal_model():
    """The model of the motion is validated with the poses, which are not used for the identification."""
    arm = dvrk.load_arm("mtmr")
    poses, motion = (dvrk.read_recording(SAMPLES_FOLDER / f"mtm_{what}.csv", arm) for what in ("poses", "motion"))
    identified = dvrk.validate(dvrk.identify(motion, arm).model, poses)
    nominal = dvrk.validate(dvrk.IdentifiedModel.from_arm(arm), poses)
    assert (identified.verdict, nominal.verdict) == ("usable", "do not use")
    for name in ("shoulder_pitch", "elbow_pitch", "wrist_platform"):
        assert identified.relative_errors[name] < 0.5 * nominal.relative_errors[name]


@pytest.mark.parametrize("name", ["mtm_motion", "psm_motion"])
def test_motion_is_that_of_the_script(name):
    spec = importlib.util.spec_from_file_location("make_samples", ROOT / "tools/make_samples.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    arm = dvrk.load_arm(SAMPLES[name])
    recording = dvrk.read_recording(SAMPLES_FOLDER / f"{name}.csv", arm)
    desired = script.desired_motion(arm).vector_values(script.LEAD_IN + recording.t).T
    assert np.abs(recording.q - desired).max() < TRACKING[arm.name.lower()]
    A, lower, upper = arm.limit_matrix()
    assert np.all((recording.q @ A.T > lower) & (recording.q @ A.T < upper))


def test_folder_with_files_is_kept(tmp_path, capsys):
    mine = tmp_path / "mtm_poses.csv"
    mine.write_text("mine")
    assert_refused(dvrk.DvrkDrakeError, "folder is not empty", dvrk.write_samples, tmp_path)
    assert mine.read_text() == "mine" and len(list(tmp_path.iterdir())) == 1
    assert main(["samples", str(tmp_path), "--overwrite"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == FILES and mine.read_text() != "mine"
    assert "dvrk-drake check" in capsys.readouterr().out


def test_folder_without_write_permission_is_refused():
    with public_folder() as folder:
        folder.chmod(0o555)

        def check():
            for path in (folder, folder / "new"):
                with pytest.raises(dvrk.DvrkDrakeError, match="the samples cannot be written: Permission denied"):
                    dvrk.write_samples(path)

        run_unprivileged(check)
        assert not list(folder.iterdir())


def test_failed_write_leaves_no_files(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dvrk_drake.recordings.formats.write_recording", full)
    assert_refused(dvrk.DvrkDrakeError, "No space left on device", dvrk.write_samples, tmp_path)
    assert not list(tmp_path.iterdir())


# Tests the Python code in docs/public_recordings.md.


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
