"""Tables show all digits in terminals of any width, and are not wider than necessary."""

import pytest

from dvrk_drake.reports.page import Page, Section, Table
from dvrk_drake.reports.terminal import TABLE_WIDTH, make_console, print_page

NAME = "L4 (m4+...+m7) + m3 c3z + m4 c4y + m_crank c_crank_y"
CAPTION = "Estimates of the base parameters with their standard errors, and limits of the dead band and saturation"
CELLS = (NAME, "-0.0371 .. +0.0514", "+0.01277", "0.00303", "kg m^2")


def printed(capsys, monkeypatch, columns):
    if columns is None:
        monkeypatch.delenv("COLUMNS", raising=False)
    else:
        monkeypatch.setenv("COLUMNS", str(columns))
    header = ("", "clip [N m]", "dead band [rad/s]", "standard error", "saturation [rad/s]")
    table = Table(header, [CELLS], CAPTION)
    print_page(make_console(), Page("", "answer", [Section("", [table])]))
    answer, empty, *lines = capsys.readouterr().out.splitlines()
    assert answer == "answer" and not empty
    return lines


@pytest.mark.parametrize("columns", [64, 80, 100, 120, None])
def test_table_fits_and_numbers_are_complete(columns, capsys, monkeypatch):
    lines = printed(capsys, monkeypatch, columns)
    assert max(map(len, lines)) <= (columns or TABLE_WIDTH)
    text = "\n".join(lines)
    assert all(cell in text for cell in CELLS[1:])
    assert " ".join(CAPTION.split()) in " ".join(text.split())
    assert "[N m]" in text and "[rad/s]" in text and "…" not in text
    name = " ".join(line[: line.find("  ")].strip() if "  " in line else line for line in lines if line[:1].strip())
    assert "m_crank c_crank_y" in name


def test_narrow_terminal_shows_all_numbers(capsys, monkeypatch):
    text = "\n".join(printed(capsys, monkeypatch, 30))
    assert all(cell in text for cell in CELLS[1:])
