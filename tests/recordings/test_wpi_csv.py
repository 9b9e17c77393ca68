"""Tests reading CSVs of 21 columns without a header."""

from __future__ import annotations

import numpy as np
import pytest
from public_files import NUMBERS, assert_refused, wpi_rows, write_text, write_wpi

from dvrk_drake.recordings.conversion import convert
from dvrk_drake.recordings.public_formats import read_wpi_csv


def test_wpi_csv_columns_time_and_coordinates(tmp_path):
    rows = wpi_rows()
    path = write_wpi(tmp_path, rows)
    recording = read_wpi_csv(path)
    np.testing.assert_array_equal(recording.q, rows[:, :7])
    np.testing.assert_array_equal(recording.qd, rows[:, 7:14])
    np.testing.assert_array_equal(recording.tau, rows[:, 14:])
    np.testing.assert_array_equal(recording.t, [0, 0.005, 0.010, 0.015])
    assert recording.coordinates == "actuator"
    assert recording.where(3) == f"{path}, line 4"
    np.testing.assert_array_equal(read_wpi_csv(path, rate=10).t, [0, 0.1, 0.2, 0.3])


def test_wpi_csv_with_crlf_bom_blank_lines_and_spaces(tmp_path):
    line = ", ".join(str(i) for i in range(21))
    path = write_text(tmp_path, f"\ufeff\r\n{line}\r\n\r\n{line}\r\n \r\n")
    recording = read_wpi_csv(path)
    np.testing.assert_array_equal(recording.lines, [2, 4])
    np.testing.assert_array_equal(recording.t, [0, 0.005])


WPI_ERRORS = {
    "empty": ("", r"motion\.csv is empty; needs 21 numbers per row"),
    "blank": ("\n \n,,\n", r"motion\.csv is empty"),
    "header": (
        ",".join(f"q{i}" for i in range(21)) + f"\n{NUMBERS}\n",
        r", line 1: unexpected header; .*needs no conv",
    ),
    "title": ("my motion\n" + NUMBERS, r", line 1: the first row has no comma"),
    "one number": (
        "1\n2\n",
        r", line 1: the row has 1 cells, wpi-csv files have 21 numbers per row: q1\.\.q7, qd1\.\.qd7, tau1\.\.tau7",
    ),
    "planned motion": ("1,2,3,4,5,6,7,500\n" * 3, r", line 1: the row has 8 cells, wpi-csv files have 21"),
    "ragged": (f"{NUMBERS}\n{NUMBERS}\n{NUMBERS},\n", r", line 3: the row has 22 cells"),
    "text": (f"{NUMBERS}\n{NUMBERS[:-1]}abc\n", r", line 2: tau7 \(column 21\) is not a number: 'abc'"),
    "text first": ("x" + NUMBERS + "\n", r", line 1: q1 \(column 1\) is not a number: 'x1'"),
    "empty cell": (f"{NUMBERS}\n{NUMBERS[:-1]}\n", r", line 2: tau7 \(column 21\) is empty"),
    "underscore": (f"{NUMBERS}_0\n", r", line 1: tau7 \(column 21\) is not a number: '1_0'"),
    "nan": (f"{NUMBERS}\n{NUMBERS}\nnan{NUMBERS[1:]}\n", r", line 3: q1 \(column 1\) is nan; only finite"),
    "inf": (f"{NUMBERS[:-1]}-inf\n", r", line 1: tau7 \(column 21\) is -inf; only finite"),
    "one row": (NUMBERS, r"motion\.csv has 1 valid row; a motion needs at least 2"),
    "semicolons": (
        NUMBERS.replace(",", ";"),
        r", line 1: the first row has no comma\. Separate cells by commas",
    ),
    "spaces": (NUMBERS.replace(",", " "), r", line 1: the first row has no comma"),
    "open quote": (f'{NUMBERS}\n"{NUMBERS}\n{NUMBERS}\n', r", line 3: invalid CSV: unexpected end of data"),
}


@pytest.mark.parametrize("case", WPI_ERRORS)
def test_wpi_csv_errors_name_file_line_and_column(tmp_path, case):
    text, match = WPI_ERRORS[case]
    path = write_text(tmp_path, text)
    assert_refused(match, read_wpi_csv, path)
    assert_refused(match, convert, path, tmp_path / "out.csv", format="wpi-csv")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["motion.csv"]


@pytest.mark.parametrize("rate", [0, -200, np.nan, np.inf])
def test_wpi_csv_refuses_other_rates(tmp_path, rate):
    assert_refused(
        "rate is .* Hz; allowed: a positive number", read_wpi_csv, write_wpi(tmp_path, wpi_rows()), rate=rate
    )


def test_wpi_csv_skips_invalid_rows_and_keeps_times(tmp_path):
    rows = wpi_rows(5)
    rows[1, 3] = np.nan
    rows[3, 20] = np.inf
    path = write_wpi(tmp_path, rows)
    path.write_text(path.read_text().replace("nan", ""))
    recording = convert(path, tmp_path / "out.csv", skip_invalid=True)
    notes = recording.notes
    np.testing.assert_array_equal(recording.t, [0, 0.01, 0.02])
    np.testing.assert_array_equal(recording.lines, [1, 3, 5])
    assert "2 of 5 rows skipped (empty, NaN or infinite): lines 2, 4" in notes
    rows[2:] = np.nan
    assert_refused("has 1 valid row;", read_wpi_csv, write_wpi(tmp_path, rows), skip_invalid=True)
    bad = write_text(tmp_path, f"{NUMBERS}\n{NUMBERS[:-1]}abc\n")
    assert_refused("tau7 .* is not a number", read_wpi_csv, bad, skip_invalid=True)
