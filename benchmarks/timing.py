"""Times of functions side by side, for the benchmarks."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def measured_times(functions: dict[str, Callable[[], object]], repetitions: int) -> dict[str, NDArray[np.float64]]:
    """(repetitions,) seconds of each function, called in turn so that drift of the machine's speed hits all alike."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repetitions):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in times.items()}
