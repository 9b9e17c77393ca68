"""What a command printed on stderr, without its progress."""

import re

#: A line of progress off a terminal, e.g. "1 of 3: reading", or "simulating" where there is one step.
STEP = re.compile(r"\d+ of \d+: .+|[a-z][^:]*")


def messages(errors):
    """The lines of stderr that are not progress."""
    return [line for line in errors.splitlines() if not STEP.fullmatch(line)]


def refusal(errors):
    """The one line on stderr of a command that was refused."""
    (line,) = messages(errors)
    assert line.startswith("dvrk-drake: error: "), line
    return line
