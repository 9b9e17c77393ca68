"""Output of a command on stderr, without its progress."""

import re

#: Line of progress if stderr is not a terminal, e.g. "1 of 3: reading", or "simulating" for a single step.
STEP = re.compile(r"\d+ of \d+: .+|[a-z][^:]*")


def messages(errors):
    """Returns the lines of stderr that are not progress."""
    return [line for line in errors.splitlines() if not STEP.fullmatch(line)]


def refusal(errors):
    """Returns the single line on stderr of a command that was refused."""
    (line,) = messages(errors)
    assert line.startswith("dvrk-drake: error: "), line
    return line
