"""Messages of one line: on stderr of a command, and of an error."""

import re

import pytest

from dvrk_drake.cli import main

#: Line of progress if stderr is not a terminal, e.g. "1 of 3: reading", or "simulating" for a single step.
STEP = re.compile(r"\d+ of \d+: .+|[a-z][^:]*")


def messages(errors):
    """Returns the lines of stderr without progress lines."""
    return [line for line in errors.splitlines() if not STEP.fullmatch(line)]


def refusal(errors):
    """Returns the only message on stderr of a command that failed."""
    (line,) = messages(errors)
    assert line.startswith("dvrk-drake: error: "), line
    return line


def refused(capsys, *words):
    """Runs a command that must fail with exit code 2. Returns its only message."""
    assert main([str(word) for word in words]) == 2
    return refusal(capsys.readouterr().err)


def assert_refused(error, message, call, *arguments, **options):
    """Asserts that a call raises an error of this type, whose message has one line and contains a pattern."""
    with pytest.raises(error, match=message) as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value), str(caught.value)
