"""Live line: updated in place on a terminal, not written to other streams."""

import io

from dvrk_drake.processes.live_status import LiveLine


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_line_is_updated_four_times_per_second(monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    terminal, now = Terminal(), [0.0]
    line = LiveLine(terminal, clock=lambda: now[0])
    for k in range(1001):
        now[0] = 1e-3 * k
        line.show(lambda k=k: f"row {k} of a line that is too long")
    line.clear()
    shown = terminal.getvalue().split("\r\x1b[K")
    assert shown == ["", *(f"row {k} of a line that is too long"[:19] for k in (0, 250, 500, 750, 1000)), ""]


def test_line_is_not_written_to_a_file():
    stream = io.StringIO()
    line = LiveLine(stream)
    line.show(lambda: 1 / 0)
    line.clear()
    assert stream.getvalue() == ""
