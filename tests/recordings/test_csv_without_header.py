"""CSV files of other programs: layouts without a header, columns of messages, times, and one line for each fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from public_files import NUMBERS, assert_refused, wpi_rows, write_text, write_wpi

from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording

ARM = load_arm("mtml")


def test_21_columns_are_motions_of_wpi_at_200_hz(tmp_path):
    rows = wpi_rows()
    path = write_wpi(tmp_path, rows)
    recording = read_recording(path, ARM).in_actuator_coordinates(ARM)
    np.testing.assert_allclose(recording.q, rows[:, :7], atol=1e-12)
    np.testing.assert_allclose(recording.qd, rows[:, 7:14], atol=1e-12)
    np.testing.assert_allclose(recording.tau, rows[:, 14:], atol=1e-12)
    np.testing.assert_array_equal(recording.t, [0, 0.005, 0.010, 0.015])
    assert recording.file_coordinates == "wpi"
    assert recording.where(3) == f"{path}, line 4"
    assert recording.notes == (
        "no header: columns read as q1..q7, qd1..qd7, tau1..tau7",
        "4 samples; the file has no times, so t = row / 200 Hz",
    )
    np.testing.assert_array_equal(read_recording(path, ARM, rate=10).t, [0, 0.1, 0.2, 0.3])


def test_wpi_coordinates_are_those_of_an_arm(tmp_path):
    path = write_wpi(tmp_path, wpi_rows())
    assert_refused("needs the arm whose joint states are read", read_recording, path)


def test_other_arms_with_seven_joints_have_no_wpi_file(tmp_path):
    arm = replace(load_arm("psm"), name="PANDA")
    path = write_wpi(tmp_path, 1e-2 * wpi_rows())
    recording = read_recording(path, arm)
    np.testing.assert_array_equal(recording.q, 1e-2 * wpi_rows()[:, :7])
    assert (recording.t, recording.coordinates, recording.file_coordinates) == (None, "joint", "")
    assert read_recording(path, arm, "wpi", rate=200).file_coordinates == "wpi"


def test_wpi_motions_have_the_roll_of_the_joint(tmp_path):
    psm = load_arm("psm")
    rows = 1e-2 * wpi_rows()
    recording = read_recording(write_wpi(tmp_path, rows), psm)
    assert recording.coordinates == "joint"
    np.testing.assert_array_equal(recording.q[:, :4], rows[:, :4])
    np.testing.assert_array_equal(recording.tau[:, :4], rows[:, 14:18])
    actuators = np.arange(7) != psm.joint_names.index("roll")
    back = recording.in_actuator_coordinates(psm)
    np.testing.assert_allclose(back.q[:, actuators], rows[:, :7][:, actuators], rtol=0, atol=1e-12)


def test_14_columns_are_static_poses(tmp_path):
    rows = wpi_rows()[:, :14]
    recording = read_recording(write_wpi(tmp_path, rows), ARM)
    np.testing.assert_array_equal(recording.q, rows[:, :7])
    np.testing.assert_array_equal(recording.tau, rows[:, 7:])
    assert (recording.qd, recording.t, recording.coordinates) == (None, None, "joint")


def test_files_of_the_dvrk_collection_script_have_three_joints(tmp_path):
    """The script dvrk_ecm_psm_gc_collect.py writes positions and efforts of yaw, pitch and insertion."""
    path = write_wpi(tmp_path, wpi_rows()[:, :6])
    assert_refused(
        r", line 1: the first row has 6 cells and no header.*14 \(q, tau\)\. If roll, .* were held",
        read_recording,
        path,
        load_arm("psm"),
    )


FAULTS = {
    "title": ("my motion\n" + NUMBERS, r", line 1: the first row has no comma"),
    "one number": ("1\n2\n", r", line 1: the first row has 1 cell and no header\. Allowed .* 21 columns \(q, qd,"),
    "planned motion": ("1,2,3,4,5,6,7,500\n" * 3, r", line 1: the first row has 8 cells and no header"),
    "ragged": (f"{NUMBERS}\n{NUMBERS}\n{NUMBERS},\n", r", line 3: the row has 22 cells, the first row has 21"),
    "text": (f"{NUMBERS}\n{NUMBERS[:-1]}abc\n", r", line 2: tau7 \(column 21\) is not a number: 'abc'"),
    "text first": ("x" + NUMBERS + "\n", r", line 1: q1 \(column 1\) is not a number: 'x1'"),
    "nan": (f"{NUMBERS}\n{NUMBERS}\nnan{NUMBERS[1:]}\n", r", line 3: q1 \(column 1\) is nan; only finite"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_name_file_line_and_column(tmp_path, case):
    text, match = FAULTS[case]
    assert_refused(match, read_recording, write_text(tmp_path, text))


@pytest.mark.parametrize("rate", [0, -200, np.nan, np.inf])
def test_other_rates_are_refused(tmp_path, rate):
    path = write_wpi(tmp_path, wpi_rows())
    assert_refused("rate is .* Hz; allowed: a positive number", read_recording, path, ARM, rate=rate)


def test_skips_invalid_rows_and_keeps_times(tmp_path):
    rows = wpi_rows(5)
    rows[1, 3] = np.nan
    rows[3, 20] = np.inf
    path = write_wpi(tmp_path, rows)
    path.write_text(path.read_text().replace("nan", ""))
    recording = read_recording(path, ARM, skip_invalid=True)
    np.testing.assert_array_equal(recording.t, [0, 0.01, 0.02])
    np.testing.assert_array_equal(recording.lines, [1, 3, 5])
    assert "2 of 5 rows skipped (empty, NaN or infinite): lines 2, 4" in recording.notes
    path = write_wpi(tmp_path, np.full((3, 21), np.nan))
    assert_refused("has no row of finite numbers", read_recording, path, skip_invalid=True)
    bad = write_text(tmp_path, f"{NUMBERS}\n{NUMBERS[:-1]}abc\n")
    assert_refused("tau7 .* is not a number", read_recording, bad, skip_invalid=True)


def test_a_real_motion_without_header_and_time_is_restored(shared_data, tmp_path):
    original = shared_data / "trajectories" / "mtm_one.csv"
    lines = original.read_text().splitlines()[1:]
    path = write_text(tmp_path, "\n".join(line.split(",", 1)[1] for line in lines))
    restored, expected = (read_recording(file, coordinates="actuator") for file in (path, original))
    for name in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(restored, name), getattr(expected, name))
    np.testing.assert_allclose(restored.t, expected.t, rtol=0, atol=1e-12)


def message_rows(layout, names, stamps, blocks):
    """Returns the text of a CSV with JointState messages in the layout of a program."""
    n = len(names)
    numbered = {"bagpy": "{}_{}", "echo": "field.{}{}"}.get(layout)
    fields = ("position", "velocity", "effort")
    if layout == "collection":
        header = "# Topic: /MTMR/measured_js\n# Type: sensor_msgs/msg/JointState\n"
        header += "timestamp,header.stamp.sec,header.stamp.nanosec,header.frame_id,name," + ",".join(fields)
    elif layout == "bagpy":
        header = "Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id,name"
    else:
        header = "%time,field.header.seq,field.header.stamp,field.header.frame_id"
        header += "".join(f",field.name{i}" for i in range(n))
    if numbered:
        header += "".join("," + numbered.format(field, i) for field in fields for i in range(n))
    lines = [header]
    for k, stamp in enumerate(stamps):
        values = [block[k].tolist() for block in blocks]
        sec, nanosec, quoted = stamp // 10**9, stamp % 10**9, f'"{list(names)}"'
        flat = ",".join(repr(x) for row in values for x in row)
        lines.append(
            {
                "collection": f"{stamp},{sec},{nanosec},,{quoted}," + ",".join(f'"{row}"' for row in values),
                "bagpy": f"{stamp / 1e9},{k},{sec},{nanosec},,{quoted},{flat}",
                "echo": f"{stamp},{k},{stamp},,{','.join(names)},{flat}",
            }[layout]
        )
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("layout", ["collection", "bagpy", "echo"])
def test_columns_of_messages_are_read_like_a_bag(tmp_path, layout):
    arm, blocks = load_arm("mtmr"), np.random.default_rng(0).uniform(-0.2, 0.2, (3, 5, 7))
    stamps = 1_700_000_000_000_000_001 + 10_000_000 * np.arange(5)
    text = message_rows(layout, arm.joint_names[::-1], stamps.tolist(), blocks)
    read = read_recording(write_text(tmp_path, text), arm)
    for name, block in zip(("q", "qd", "tau"), blocks, strict=True):
        np.testing.assert_array_equal(getattr(read, name), block[:, ::-1])
    np.testing.assert_allclose(read.t, 0.01 * np.arange(5), atol=1e-12)
    first = text.count("#") + 2
    np.testing.assert_array_equal(read.lines, range(first, first + 5))
    assert (read.file_coordinates, read.notes, read.times_from) == ("joint", (), "messages")
    if layout == "collection":
        assert_refused(
            "/MTMR is the namespace of the arm MTMR, not of MTML. Choose --arm mtmr.$", read_recording, read.source, ARM
        )
    broken = write_text(tmp_path, text.replace(repr(float(blocks[2, 3, 4])), "off"))
    assert_refused(f"line {first + 3}: .*effort.* is not a number: 'off'", read_recording, broken, arm)
    wrong = text.replace("header.stamp", "stamp").replace("field.stamp", "stamp")
    assert_refused(
        "these are columns of JointState messages .* the times `header.stamp` are missing",
        *(read_recording, write_text(tmp_path, wrong), arm),
    )


def test_a_header_in_a_comment_is_read(tmp_path):
    """np.savetxt writes the header as a comment."""
    names = ["t", *(f"q{i}" for i in range(1, 8))]
    table = np.random.default_rng(0).normal(size=(3, 8))
    np.savetxt(tmp_path / "motion.csv", table, delimiter=",", header=",".join(names))
    read = read_recording(tmp_path / "motion.csv")
    np.testing.assert_array_equal(np.column_stack([read.t, read.q]), table)
    np.testing.assert_array_equal(read.lines, [2, 3, 4])
