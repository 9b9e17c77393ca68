"""Selects messages in the output of a command on stderr."""

import re

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
