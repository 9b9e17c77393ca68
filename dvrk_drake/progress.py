"""Progress callbacks for functions that take seconds."""

from __future__ import annotations

from collections.abc import Callable

#: Callback that receives the name of the current step, e.g. "identifying", and the completed fraction of this step, 0
#: to 1.
Progress = Callable[[str, float], object]


def step_progress(
    progress: Progress | None, step: str, start: float = 0.0, end: float = 1.0
) -> Callable[[float], object]:
    """Returns a callback that receives the completed fraction (0 to 1) of one part of a step.

    Args:
        progress: Callback of the caller; None to disable reporting.
        step: Name of the step.
        start, end: Fractions of the step at which the part begins and ends.
    """
    if progress is None:
        return lambda share: None
    return lambda share: progress(step, start + (end - start) * share)
