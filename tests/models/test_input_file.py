"""Tests that each reader refuses missing, too large, deeply nested and unreadable files with a message of one line."""

import math
import os
import re
import tracemalloc

import numpy as np
import pytest
from arm_copies import copy_arm
from command_output import assert_refused
from recordings import HEADER, ROW, random_recording

from dvrk_drake.analysis.excitation.pose_file import CollectionFile, load_poses
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError, DvrkDrakeError, ModelError, RecordingError
from dvrk_drake.experiments.scenario import load_scenario
from dvrk_drake.experiments.study import load_study
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import load_gains
from dvrk_drake.models.files import MAX_TEXT
from dvrk_drake.models.sdf_model import compose_sdf
from dvrk_drake.models.typed_yaml import parse_yaml
from dvrk_drake.processes.simulated_arm import load_driver
from dvrk_drake.recordings import csv_files
from dvrk_drake.recordings.formats import read_recording, write_recording

ARM = load_arm("mtml")
#: Mapping from a file name to its reader.
READERS = {
    "a.yaml": load_arm,
    "model.yaml": IdentifiedModel.load,
    "gains.yaml": load_gains,
    "driver.yaml": load_driver,
    "poses.yaml": lambda path: load_poses(path, ARM),
    "scenario.yaml": load_scenario,
    "study.yaml": load_study,
    "gc.json": GravityCompensationFile.load,
    "recording.csv": lambda path: read_recording(path, ARM),
    "collection.csv": lambda path: CollectionFile(path, ARM, both_sides=True),
    "team.mat": read_recording,
    "wpi.csv": read_recording,
    "status.log": read_recording,
    "poses.mcap": lambda path: read_recording(path, ARM),
    "arm.sdf": lambda path: compose_sdf([path]),
}
#: Functions that create something other than a regular file at a path.
NO_FILES = {
    "FIFO": os.mkfifo,
    "folder": os.mkdir,
    "device": lambda path: os.symlink("/dev/zero", path),
    "link to itself": lambda path: os.symlink(path, path),
    "link to nothing": lambda path: os.symlink(f"{path}.gone", path),
}


@pytest.mark.parametrize("kind", NO_FILES)
@pytest.mark.parametrize("name", READERS)
def test_non_files_are_refused_in_one_line(name, kind, tmp_path):
    path = f"{tmp_path}/{name}"
    NO_FILES[kind](path)
    with pytest.raises(DvrkDrakeError) as refusal:
        READERS[name](path)
    assert name in str(refusal.value) or kind == "device"
    assert "\n" not in str(refusal.value)
    assert not os.path.exists(f"{path}.out")


@pytest.mark.parametrize("name", sorted(READERS.keys() - {"collection.csv"}))
def test_invalid_file_names_are_refused(name, tmp_path):
    for stem in ("x" * 300, "a\0b"):
        with pytest.raises(DvrkDrakeError):
            READERS[name](f"{tmp_path}/{stem}{name}")


@pytest.mark.parametrize("name", ["model.yaml", "gc.json", "arm.sdf"])
def test_too_large_file_is_refused(name, tmp_path):
    path = tmp_path / name
    with path.open("wb") as stream:
        stream.truncate(MAX_TEXT + 1)
    assert_refused(DvrkDrakeError, r"4\.0 MB; allowed: at most 4 MB", READERS[name], str(path))


def test_deeply_nested_files_are_refused_with_their_line(tmp_path):
    for text in ("[" * 100_000, "{a: " * 100_000, "- " * 100):
        with pytest.raises(ArmError, match="line 2: nested deeper than 50 levels"):
            parse_yaml(f"# deep\n{text}", "here", ArmError)
    path = tmp_path / "gc.json"
    path.write_text("[" * 100_000)
    assert_refused(ModelError, "nested too deeply", GravityCompensationFile.load, path)
    path = tmp_path / "deep.sdf"
    path.write_text('<sdf><model name="a">' + "<link>" * 100_000)
    assert_refused(ArmError, "nested deeper than 50 levels", compose_sdf, [str(path)])


def test_aliases_of_aliases_are_refused():
    lines = ["a0: &a0 [1, 1]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9))]
    assert_refused(ArmError, "more than 1000000 values", parse_yaml, "\n".join(lines), "here", ArmError)
    assert_refused(ArmError, "a contains itself", parse_yaml, "a: &a [*a]", "here", ArmError)
    assert parse_yaml("_t: &t [1, 2]\na: *t\nb: *t", "here", ArmError) == {"a": [1, 2], "b": [1, 2]}


def own_arm(folder, change):
    """Writes the files of an MTM. `change` is a pattern and the text that replaces all its matches in the SDF."""

    def changed(sdf):
        assert re.search(change[0], sdf, re.DOTALL)
        return re.sub(*change, sdf, flags=re.DOTALL)

    return copy_arm(folder, "mtmr", sdf=changed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("effort>", "ef>"), r"joint \S+ needs a positive effort limit"),
        (("<mass>", "<mass>nan "), r"link \S+: <mass> is 'nan .*'; allowed: a finite number"),
        (("<ixx>", "<ixx>inf"), r"link \S+: <ixx> is 'inf.*'; allowed: a finite number"),
        (('multiplier="', 'multiplier="x'), r"joint \S+: multiplier is 'x.*'; allowed: a finite number"),
        (("</model>", "<model name='a'/></model>"), r"model\.sdf: Drake cannot read this model: .*"),
        (('type="revolute"', 'type="ball"'), r"arm\.yaml: joint \S+ of the SDF has type 'ball'; allowed: revolute"),
        (("<mass>", "<mass>-"), r"link \S+: <mass> is -\S+; allowed: 1e-06\.\.200 kg"),
        (("<inertial>.*?</inertial>", ""), r"link \S+ of the SDF needs a positive <inertial><mass>"),
        (('multiplier="[^"]*"', 'multiplier="0"'), r"joint \S+ of the SDF has a mimic multiplier of 0"),
        (('"dh_2"', '"dh_x"'), r"model\.sdf: frame dh_2 is missing"),
        (
            (r'<joint name="\w+" type="revolute">(?:(?!</joint>).)*mimic.*?</joint>', ""),
            r"model\.sdf: no joint connects \w+",
        ),
        (("<child>upper_arm_link", "<child>no_link"), r"arm\.yaml: .*model\.sdf: Drake cannot load this model:"),
    ],
)
def test_sdf_without_a_valid_arm_is_refused(change, message, tmp_path):
    assert_refused(ArmError, message, load_arm, own_arm(tmp_path, change))


@pytest.mark.parametrize("key", ["base_parameters[3].value", "joints[2].feedforward_scale", "joints[0].rms_fit"])
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_model_with_an_invalid_number_is_not_saved(key, number, tmp_path):
    model = IdentifiedModel.from_arm(ARM)
    name, _, rest = key.partition("[")
    index, _, attribute = rest.partition("].")
    setattr(getattr(model, name)[int(index)], attribute, number)
    with pytest.raises(ModelError) as refusal:
        model.save(tmp_path / "model.yaml")
    assert f"{key} is {number}; allowed: " in str(refusal.value) and not list(tmp_path.iterdir())


# A large CSV.


def test_memory_for_a_large_csv_is_small(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_files, "_BLOCK", 1 << 16)
    path = tmp_path / "recording.csv"
    path.write_text(f"{HEADER}\n" + f"{ROW}\n" * 20_000)
    shares = []
    read_recording(path)
    tracemalloc.start()
    try:
        read = read_recording(path, progress=lambda step, share: shares.append(share))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    numbers = read.q.nbytes + read.tau.nbytes + read.lines.nbytes
    assert peak < 2 * numbers + 2_000_000
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 10


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("block", [1, 7, 64])
def test_block_size_does_not_change_the_rows(block, end, tmp_path, monkeypatch):
    original = random_recording(9)
    path = tmp_path / "recording.csv"
    write_recording(original, path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", end.encode()))
    monkeypatch.setattr(csv_files, "_BLOCK", block)
    read = read_recording(path)
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(read, name), getattr(original, name))
    np.testing.assert_array_equal(read.lines, np.arange(2, 11))
    path.write_bytes(path.read_bytes() + "0,\u00e4".encode()[:-1])
    with pytest.raises(RecordingError, match=f"is not a UTF-8 text file: .* at byte {path.stat().st_size - 1}"):
        read_recording(path)


def test_csv_with_too_many_rows_or_too_long_lines_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "recording.csv"
    path.write_text(f"{HEADER}\n" + f"{ROW}\n" * 4)
    monkeypatch.setattr(csv_files, "MAX_COUNT", 3)
    assert_refused(RecordingError, r", line 5: the file has more than 3 rows\. Split", read_recording, path)
    path.write_text(f"{HEADER}\n" + "1" * 3_000_000)
    assert_refused(RecordingError, "a line has more than 1048576 characters", read_recording, path)
