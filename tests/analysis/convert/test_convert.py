"""Public recordings: files of the same layouts with known numbers, and what can be wrong with them."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io
from repository import ROOT

from dvrk_drake.analysis.convert.convert import convert, detect_format
from dvrk_drake.analysis.convert.team_mat import read_team_mat
from dvrk_drake.analysis.convert.wpi_csv import read_wpi_csv
from dvrk_drake.errors import DvrkDrakeError, RecordingError
from dvrk_drake.models.recording import read_recording

DOCUMENT = ROOT / "docs" / "public_recordings.md"


def team_array(num_poses: int = 5) -> np.ndarray:
    """(8, 2, N): position j + k/100 of joint j at pose k, counted from 1; effort -10 times the position."""
    joint, pose = np.meshgrid(np.arange(1, 9), np.arange(1, num_poses + 1) / 100, indexing="ij")
    return np.stack([joint + pose, -10 * (joint + pose)], axis=1)


def wpi_rows(num_rows: int = 4) -> np.ndarray:
    return np.arange(21 * num_rows).reshape(num_rows, 21) / 7


def write_mat(folder: Path, **variables: object) -> Path:
    path = folder / "poses.mat"
    scipy.io.savemat(path, variables)
    return path


def write_text(folder: Path, text: str) -> Path:
    path = folder / "motion.csv"
    path.write_bytes(text.encode())
    return path


def write_wpi(folder: Path, rows: np.ndarray) -> Path:
    return write_text(folder, "".join(",".join(repr(float(x)) for x in row) + "\n" for row in rows))


def assert_refused(match: str, function, *args, **kwargs) -> None:
    with pytest.raises(RecordingError, match=match) as caught:
        function(*args, **kwargs)
    assert "\n" not in str(caught.value)


# The 8 x 2 x N arrays.


@pytest.mark.parametrize("compressed", [False, True])
def test_team_mat_takes_joints_from_axis_0_and_position_and_effort_from_axis_1(tmp_path, compressed):
    path = tmp_path / "poses.mat"
    scipy.io.savemat(path, {"any_name": team_array(), "n": 5, "label": "x"}, do_compression=compressed)
    recording = read_team_mat(path)
    assert recording.q.shape == recording.tau.shape == (5, 7)
    assert recording.q[2, 3] == 4.03
    assert recording.tau[4, 6] == -10 * 7.05
    assert recording.t is None
    assert recording.qd is None
    assert recording.coordinates == "joint"
    assert recording.where(2) == f"{path}:3"
    assert len(recording.sha256) == 64


@pytest.mark.parametrize("poses", [team_array(1), team_array(1)[:, :, 0]])
def test_team_mat_of_one_pose(tmp_path, poses):
    np.testing.assert_array_equal(read_team_mat(write_mat(tmp_path, a=poses)).q, [np.arange(1, 8) + 0.01])


@pytest.mark.parametrize("kind", [np.float32, np.int16, np.uint8])
def test_team_mat_of_other_real_types(tmp_path, kind):
    array = np.arange(1, 33).reshape(8, 2, 2).astype(kind)
    np.testing.assert_array_equal(read_team_mat(write_mat(tmp_path, a=array)).tau, array[:7, 1].T)


def test_team_mat_of_matlab_4_has_no_signature_but_its_name(tmp_path):
    path = tmp_path / "old.mat"
    scipy.io.savemat(path, {"a": team_array(1)[:, :, 0]}, format="4")
    assert detect_format(path) == "team-mat"
    assert len(read_team_mat(path)) == 1


def test_team_mat_with_several_candidates_lists_them_and_takes_a_choice(tmp_path):
    path = write_mat(tmp_path, data=team_array(10), saved_data=team_array(3), n=10)
    assert_refused(r"poses\.mat: several variables fit: data, saved_data; .*--variable NAME", read_team_mat, path)
    assert len(read_team_mat(path, variable="saved_data")) == 3


def test_team_mat_refuses_a_variable_that_is_absent_or_does_not_fit(tmp_path):
    path = write_mat(tmp_path, a=team_array(), b=np.ones((8, 10, 4)))
    assert_refused(r"has no variable c; it has: a \(8 x 2 x 5 double\)", read_team_mat, path, variable="c")
    assert_refused(r"variable b must be 8 x 2 x N .* b \(8 x 10 x 4 double\)", read_team_mat, path, variable="b")


@pytest.mark.parametrize(
    "wrong",
    [
        np.ones((7, 2, 5)),
        np.ones((8, 3, 5)),
        np.ones((2, 8, 5)),
        np.ones((8, 2, 5, 2)),
        np.ones((8, 2, 5), bool),
        "text",
    ],
)
def test_team_mat_refuses_other_shapes_and_types(tmp_path, wrong):
    assert_refused(
        r"no variable is 8 x 2 x N real numbers .*; it has: a \(", read_team_mat, write_mat(tmp_path, a=wrong)
    )


def test_team_mat_refuses_complex_and_empty_arrays(tmp_path):
    assert_refused("variable a is complex", read_team_mat, write_mat(tmp_path, a=1j * team_array()))
    assert_refused("variable a has no poses", read_team_mat, write_mat(tmp_path, a=np.ones((8, 2, 0))))
    assert_refused("no variable is 8 x 2 x N.*; it has: no variables", read_team_mat, write_mat(tmp_path))


def test_team_mat_of_version_7_3_is_refused_with_a_remedy(tmp_path):
    path = tmp_path / "new.mat"
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    for content in (header.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + b"\0" * 600):
        path.write_bytes(content)
        assert detect_format(path) == "team-mat"
        assert_refused(r"new\.mat: is a MATLAB v7\.3 \(HDF5\) file.*-v7'", read_team_mat, path)


@pytest.mark.parametrize("damage", ["empty", "cut", "short", "text", "noise"])
def test_team_mat_that_is_damaged_is_refused(tmp_path, damage):
    path = tmp_path / "poses.mat"
    scipy.io.savemat(path, {"a": team_array(50)}, do_compression=True)
    whole = path.read_bytes()
    noise = bytes(np.random.default_rng(1).integers(0, 256, len(whole) - 200, np.uint8))
    path.write_bytes(
        {
            "empty": b"",
            "cut": whole[:-30],
            "short": whole[:100],
            "text": b"q1,q2\n1,2\n" * 50,
            "noise": whole[:200] + noise,
        }[damage]
    )
    assert_refused(r"poses\.mat: (not a MATLAB file|no variable)", read_team_mat, path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_team_mat_refuses_invalid_poses_or_skips_and_counts_them(tmp_path, value):
    array = team_array(6)
    array[4, 1, 2] = value
    array[0, 0, 5] = np.nan
    path = write_mat(tmp_path, a=array)
    pattern = rf"poses\.mat:3: tau5 is {value}; only finite.*; 2 of 6 poses are invalid \(--skip-invalid"
    assert_refused(pattern, read_team_mat, path)
    assert not (tmp_path / "out.csv").exists()
    recording = convert(path, tmp_path / "out.csv", skip_invalid=True)
    notes = recording.notes
    np.testing.assert_array_equal(recording.lines, [1, 2, 4, 5])
    np.testing.assert_array_equal(recording.q, array[:7, 0][:, [0, 1, 3, 4]].T)
    assert "2 of 6 poses skipped (NaN, infinite or all zeros): 3, 6" in notes


def test_team_mat_refuses_poses_that_were_never_recorded(tmp_path):
    array = team_array(30)
    array[:, :, 12:] = 0
    path = write_mat(tmp_path, a=array)
    assert_refused(r"poses\.mat:13: pose has only zeros.*18 of 30 poses", read_team_mat, path)
    recording = convert(path, tmp_path / "out.csv", skip_invalid=True)
    notes = recording.notes
    assert len(recording) == 12
    assert notes[-1].endswith("13, 14, 15, 16, 17, 18, 19, 20, 21, 22, ...")
    nothing = write_mat(tmp_path, a=np.zeros((8, 2, 3)))
    assert_refused("variable a has no valid pose among its 3", read_team_mat, nothing, skip_invalid=True)


def test_team_mat_does_not_mind_the_gripper(tmp_path):
    array = team_array()
    array[7] = np.nan
    assert len(read_team_mat(write_mat(tmp_path, a=array))) == 5


def test_a_home_pose_is_valid_if_it_has_an_effort(tmp_path):
    array = np.zeros((8, 2, 1))
    array[1, 1, 0] = 0.4
    assert len(read_team_mat(write_mat(tmp_path, a=array))) == 1


# The CSV of 21 columns.


def test_wpi_csv_columns_time_and_coordinates(tmp_path):
    rows = wpi_rows()
    path = write_wpi(tmp_path, rows)
    recording = read_wpi_csv(path)
    np.testing.assert_array_equal(recording.q, rows[:, :7])
    np.testing.assert_array_equal(recording.qd, rows[:, 7:14])
    np.testing.assert_array_equal(recording.tau, rows[:, 14:])
    np.testing.assert_array_equal(recording.t, [0, 0.005, 0.010, 0.015])
    assert recording.coordinates == "actuator"
    assert recording.where(3) == f"{path}:4"
    np.testing.assert_array_equal(read_wpi_csv(path, rate=10).t, [0, 0.1, 0.2, 0.3])


def test_wpi_csv_with_crlf_bom_blank_lines_and_spaces(tmp_path):
    line = ", ".join(str(i) for i in range(21))
    path = write_text(tmp_path, f"\ufeff\r\n{line}\r\n\r\n{line}\r\n \r\n")
    recording = read_wpi_csv(path)
    np.testing.assert_array_equal(recording.lines, [2, 4])
    np.testing.assert_array_equal(recording.t, [0, 0.005])


NUMBERS = ",".join(["1"] * 21)
WPI_ERRORS = {
    "empty": ("", r"motion\.csv: is empty; needs 21 numbers a row"),
    "blank": ("\n \n,,\n", r"motion\.csv: is empty"),
    "header": (
        ",".join(f"q{i}" for i in range(21)) + f"\n{NUMBERS}\n",
        r":1: has a header, which wpi-csv has not .*needs no conv",
    ),
    "title": ("my motion\n" + NUMBERS, r":1: no comma in the first row"),
    "one number": (
        "1\n2\n",
        r":1: has 1 cells; wpi-csv has 21 numbers a row: q1\.\.q7, qd1\.\.qd7, tau1\.\.tau7",
    ),
    "planned motion": ("1,2,3,4,5,6,7,500\n" * 3, ":1: has 8 cells; wpi-csv has 21"),
    "ragged": (f"{NUMBERS}\n{NUMBERS}\n{NUMBERS},\n", ":3: has 22 cells"),
    "text": (f"{NUMBERS}\n{NUMBERS[:-1]}abc\n", r":2: tau7 \(column 21\) is not a number: 'abc'"),
    "text first": ("x" + NUMBERS + "\n", r":1: q1 \(column 1\) is not a number: 'x1'"),
    "empty cell": (f"{NUMBERS}\n{NUMBERS[:-1]}\n", r":2: tau7 \(column 21\) is empty"),
    "underscore": (f"{NUMBERS}_0\n", r":1: tau7 \(column 21\) is not a number: '1_0'"),
    "nan": (f"{NUMBERS}\n{NUMBERS}\nnan{NUMBERS[1:]}\n", r":3: q1 \(column 1\) is nan; only finite"),
    "inf": (f"{NUMBERS[:-1]}-inf\n", r":1: tau7 \(column 21\) is -inf; only finite"),
    "one row": (NUMBERS, r"motion\.csv: has 1 valid row; a motion needs at least 2"),
    "semicolons": (
        NUMBERS.replace(",", ";"),
        ":1: no comma in the first row; cells must be separated by commas",
    ),
    "spaces": (NUMBERS.replace(",", " "), ":1: no comma in the first row"),
    "open quote": (f'{NUMBERS}\n"{NUMBERS}\n{NUMBERS}\n', ":3: not CSV: unexpected end of data"),
}


@pytest.mark.parametrize("case", WPI_ERRORS)
def test_wpi_csv_errors_name_file_line_and_column(tmp_path, case):
    text, match = WPI_ERRORS[case]
    path = write_text(tmp_path, text)
    assert_refused(match, read_wpi_csv, path)
    assert_refused(match, convert, path, tmp_path / "out.csv")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["motion.csv"]


@pytest.mark.parametrize("rate", [0, -200, np.nan, np.inf])
def test_wpi_csv_refuses_other_rates(tmp_path, rate):
    assert_refused("rate must be a positive number of Hz", read_wpi_csv, write_wpi(tmp_path, wpi_rows()), rate=rate)


def test_wpi_csv_skips_invalid_rows_and_keeps_the_time_of_the_others(tmp_path):
    rows = wpi_rows(5)
    rows[1, 3] = np.nan
    rows[3, 20] = np.inf
    path = write_wpi(tmp_path, rows)
    recording = convert(path, tmp_path / "out.csv", skip_invalid=True)
    notes = recording.notes
    np.testing.assert_array_equal(recording.t, [0, 0.01, 0.02])
    np.testing.assert_array_equal(recording.lines, [1, 3, 5])
    assert "2 of 5 rows skipped (NaN or infinite): lines 2, 4" in notes
    rows[2:] = np.nan
    assert_refused("has 1 valid row;", read_wpi_csv, write_wpi(tmp_path, rows), skip_invalid=True)
    bad = write_text(tmp_path, f"{NUMBERS}\n{NUMBERS[:-1]}abc\n")
    assert_refused("tau7 .* is not a number", read_wpi_csv, bad, skip_invalid=True)


# convert() and detect_format().


def test_convert_team_mat_round_trip_is_exact(tmp_path):
    array = np.random.default_rng(2).normal(size=(8, 2, 72))
    path = write_mat(tmp_path, saved=array)
    recording = convert(path, tmp_path / "out.csv")
    notes = recording.notes
    again = read_recording(tmp_path / "out.csv")
    np.testing.assert_array_equal(again.q, array[:7, 0].T)
    np.testing.assert_array_equal(again.tau, recording.tau)
    assert again.t is None
    assert again.qd is None
    assert list(notes) == [
        "72 static poses from variable saved, in joint coordinates",
        "the eighth row (gripper, not actuated) is dropped",
    ]


def test_convert_wpi_csv_round_trip_is_exact(tmp_path):
    rows = np.random.default_rng(3).normal(size=(50, 21))
    rows[[10, 11]] = rows[9]
    path = write_wpi(tmp_path, rows)
    recording = convert(path, tmp_path / "out.csv", rate=100)
    notes = recording.notes
    again = read_recording(tmp_path / "out.csv", coordinates="actuator")
    for name in ("t", "q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recording, name))
    np.testing.assert_array_equal(np.hstack([again.q, again.qd, again.tau]), rows)
    assert notes[0] == "50 samples; the file has no time stamps, so t = row / 100 Hz"
    assert "--coordinates actuator" in notes[1]
    assert notes[2].startswith("2 of 50 rows repeat the row before")


def test_detect_format(tmp_path):
    assert detect_format(write_mat(tmp_path, a=1.0)) == "team-mat"
    renamed = write_mat(tmp_path, a=1.0).rename(tmp_path / "poses.bin")
    assert detect_format(renamed) == "team-mat"
    assert detect_format(write_wpi(tmp_path, wpi_rows())) == "wpi-csv"
    binary = tmp_path / "model.pkl"
    binary.write_bytes(b"\x80\x04\x95\0\0\0")
    assert_refused(r"model\.pkl: neither an LCM log, a MATLAB file .* nor a text file", detect_format, binary)
    assert_refused("nowhere: no such file", detect_format, tmp_path / "nowhere")
    assert_refused("is not a file", detect_format, tmp_path)


def test_an_explicit_format_wins_over_the_name(tmp_path):
    path = write_wpi(tmp_path, wpi_rows()).rename(tmp_path / "motion.mat")
    assert len(convert(path, tmp_path / "out.csv", format="wpi-csv")) == 4


def test_convert_refuses_options_that_do_not_apply_and_unknown_formats(tmp_path):
    mat, text, output = (
        write_mat(tmp_path, a=team_array()),
        write_wpi(tmp_path, wpi_rows()),
        tmp_path / "out.csv",
    )
    assert_refused("--rate does not apply to team-mat", convert, mat, output, rate=100)
    assert_refused("--variable does not apply to wpi-csv", convert, text, output, variable="a")
    assert_refused('unknown format "rosbag"; known formats: team-mat, wpi-csv', convert, text, output, format="rosbag")
    assert not output.exists()


def test_convert_does_not_overwrite_its_input(tmp_path):
    path = write_wpi(tmp_path, wpi_rows())
    before = path.read_bytes()
    assert_refused("is the recording itself", convert, path, tmp_path / "." / "motion.csv")
    assert path.read_bytes() == before


def test_convert_leaves_an_old_output_alone_when_it_fails(tmp_path):
    output = tmp_path / "out.csv"
    output.write_text("old")
    assert_refused("has 1 valid row", convert, write_text(tmp_path, NUMBERS), output)
    assert output.read_text() == "old"
    with pytest.raises(DvrkDrakeError, match="cannot be written: No such file or directory"):
        convert(write_wpi(tmp_path, wpi_rows()), tmp_path / "no" / "out.csv")


def test_a_real_motion_without_its_header_and_time_converts_back(shared_data, tmp_path):
    original = (shared_data / "trajectories" / "mtm_one.csv").read_text().splitlines()[1:]
    path = write_text(tmp_path, "\n".join(line.split(",", 1)[1] for line in original))
    notes = convert(path, tmp_path / "out.csv").notes
    ours = read_recording(tmp_path / "out.csv", coordinates="actuator")
    theirs = read_recording(shared_data / "trajectories" / "mtm_one.csv", coordinates="actuator")
    for name in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    np.testing.assert_allclose(ours.t, theirs.t, rtol=0, atol=1e-12)
    assert notes[-1].startswith("795 of 5999 rows repeat")


# The lines of Python that the document offers.


def document_functions() -> dict[str, object]:
    namespace: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, namespace)
    return namespace


def test_the_document_writes_measured_js_as_a_recording_that_reads_back(tmp_path):
    q, qd, tau = np.random.default_rng(4).normal(size=(3, 6, 8))
    messages = [
        SimpleNamespace(
            header=SimpleNamespace(stamp=SimpleNamespace(sec=100, nanosec=10_000_000 * i)),
            position=q[i],
            velocity=qd[i],
            effort=tau[i],
        )
        for i in range(6)
    ]
    document_functions()["write_measured_js"](messages, tmp_path / "ros.csv")
    recording = read_recording(tmp_path / "ros.csv")
    np.testing.assert_array_equal(recording.q, q[:, :7])
    np.testing.assert_array_equal(recording.qd, qd[:, :7])
    np.testing.assert_array_equal(recording.tau, tau[:, :7])
    np.testing.assert_allclose(recording.t, np.arange(6) / 100, atol=1e-9)


@pytest.mark.parametrize("average", [False, True])
def test_the_document_writes_the_2017_pairs_as_a_recording_that_reads_back(tmp_path, average):
    position, effort = np.random.default_rng(5).normal(size=(2, 8, 10, 4))
    effort[:, :, 3] = 0
    document_functions()["write_2017"](position, effort, tmp_path / "poses.csv", average)
    recording = read_recording(tmp_path / "poses.csv")
    assert len(recording) == (3 if average else 30)
    if average:
        np.testing.assert_allclose(recording.q[2], position[:7, :, 2].mean(axis=1))
    else:
        np.testing.assert_array_equal(recording.tau[13], effort[:7, 3, 1])
