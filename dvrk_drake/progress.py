"""Progress of functions that take seconds, as a callback."""

from __future__ import annotations

from collections.abc import Callable

#: Called with the name of the step that runs, e.g. "identifying", and its finished share, 0..1.
Progress = Callable[[str, float], object]


def step_progress(
    progress: Progress | None, step: str, start: float = 0.0, end: float = 1.0
) -> Callable[[float], object]:
    """Returns a callback for the shares 0..1 of one part of a step.

    Args:
        progress: what the caller gave; None for no report.
        step: name of the step.
        start, end: shares of the step between which the part lies.
    """
    if progress is None:
        return lambda share: None
    return lambda share: progress(step, start + (end - start) * share)
