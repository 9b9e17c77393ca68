"""Messages of one line: on stderr of a command, and of an error."""

import re

import pytest

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


def assert_refused(error, message, call, *arguments, **options):
    """Asserts that a call raises an error of this type, whose message has one line and contains a pattern."""
    with pytest.raises(error, match=message) as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value), str(caught.value)
