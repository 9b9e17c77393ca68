"""Tests of the progress display: bars on a terminal, otherwise one line per step."""

import io

import pytest
from command_output import messages
from rich.console import Console

from dvrk_drake.cli import support
from dvrk_drake.cli.support import Steps


def test_each_step_is_one_line_without_a_terminal(capsys):
    with Steps("reading", "identifying", "validating") as steps:
        for share in (0.0, 0.5, 1.0):
            steps("reading", share)
        steps("identifying", 0.0)
        steps("validating", 1.0)
    captured = capsys.readouterr()
    assert captured.err == "1 of 3: reading\n2 of 3: identifying\n3 of 3: validating\n"
    assert not captured.out and not messages(captured.err)


def test_a_part_of_a_step_has_the_number_of_the_step(capsys):
    with Steps("fig4", "fig5") as steps:
        steps("fig4", 0.0)
        steps("fig5: releasing", 0.3)
        steps("fig5: drawing", 0.0)
    assert capsys.readouterr().err == "1 of 2: fig4\n2 of 2: fig5: releasing\n2 of 2: fig5: drawing\n"


@pytest.fixture
def terminal(monkeypatch):
    """Returns the output of `Steps` on a terminal."""
    screen = io.StringIO()
    monkeypatch.setattr(support, "Console", lambda **_: Console(file=screen, force_terminal=True, width=100))
    return screen


def test_each_step_has_a_numbered_bar_on_a_terminal(terminal, capsys):
    with Steps("reading", "identifying") as steps:
        steps("reading", 0.5)
        steps("identifying", 0.25)
        steps._progress.refresh()
        drawn = terminal.getvalue()
    for part in ("1 of 2: reading", "100%", "2 of 2: identifying", "25%", "elapsed", "left"):
        assert part in drawn
    captured = capsys.readouterr()
    assert not captured.err and not captured.out
