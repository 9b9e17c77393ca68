"""Measures the times of functions alternately, and prints and writes the results of the benchmarks."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def measured_times(
    functions: Mapping[str, Callable[[], object]],
    repetitions: int,
    prepare: Callable[[str], object] | None = None,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, NDArray[np.float64]]:
    """Calls all functions alternately, so that a change of the computer's speed affects all of them.

    Each function is called once before the measurement, to fill caches.

    Args:
        functions: Functions by name.
        repetitions: Number of measured calls of each function.
        prepare: Function called with the name before each call. The time of `prepare` is not included.
        clock: Clock [s]. Default: CPU time of this process. `time.perf_counter` has a lower overhead, so it is better
            for functions that take a few microseconds.

    Returns:
        Times (repetitions,) of each function [s], by name.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    for repetition in range(repetitions + 1):
        for name, function in functions.items():
            if prepare is not None:
                prepare(name)
            start = clock()
            function()
            if repetition > 0:
                times[name].append(clock() - start)
    return {name: np.array(values) for name, values in times.items()}


def median_ratio(times: Mapping[str, NDArray[np.float64]], name: str, reference: str) -> float:
    """Returns the median over the repetitions of the time of `name` divided by the time of `reference`."""
    return float(np.median(times[name] / times[reference]))


def print_table(title: str, headings: Sequence[str], rows: Mapping[str, Sequence[object]]) -> None:
    """Prints a title, the headings, and one row per name as a table in Markdown. The caller formats the numbers."""
    cells = [["", *headings], *([name, *map(str, row)] for name, row in rows.items())]
    widths = [max(3, *(len(row[column]) for row in cells)) for column in range(len(cells[0]))]
    cells.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    print(title, end="\n\n")
    for first, *others in cells:
        aligned = (cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))
        print("| " + " | ".join([first.ljust(widths[0]), *aligned]) + " |", flush=True)
    print(flush=True)


def write_json(path: str | None, result: object) -> None:
    """Writes the result to a JSON file if a path is given."""
    if path:
        Path(path).write_text(json.dumps(result, indent=2) + "\n")
