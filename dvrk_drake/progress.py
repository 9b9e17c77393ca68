"""Progress callbacks for functions that take seconds."""

from __future__ import annotations

from collections.abc import Callable

#: Callback that receives the name of the current step, e.g. "identifying", and its completed share, 0..1.
Progress = Callable[[str, float], object]


def step_progress(
    progress: Progress | None, step: str, start: float = 0.0, end: float = 1.0
) -> Callable[[float], object]:
    """Returns a callback for the shares 0..1 of one part of a step.

    Args:
        progress: Callback of the caller; None to disable reporting.
        step: Name of the step.
        start, end: Shares of the step at which the part begins and ends.
    """
    if progress is None:
        return lambda share: None
    return lambda share: progress(step, start + (end - start) * share)
