"""The live line: written over and over on a terminal, and nowhere else."""

import io

from dvrk_drake.processes.live_status import LiveLine


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_gets_the_line_four_times_a_second(monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    terminal, now = Terminal(), [0.0]
    line = LiveLine(terminal, clock=lambda: now[0])
    for k in range(1001):
        now[0] = 1e-3 * k
        line.show(lambda k=k: f"row {k} of a line that is too long")
    line.clear()
    shown = terminal.getvalue().split("\r\x1b[K")
    assert shown == ["", *(f"row {k} of a line that is too long"[:19] for k in (0, 250, 500, 750, 1000)), ""]


def test_a_file_gets_nothing():
    stream = io.StringIO()
    line = LiveLine(stream)
    line.show(lambda: 1 / 0)
    line.clear()
    assert stream.getvalue() == ""
