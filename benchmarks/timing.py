"""Times of functions side by side, and the tables and files in which the benchmarks give them."""

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
    """Seconds (repetitions,) of each function, called in turn: a change of the machine's speed hits all alike.

    One call of each comes before, which fills caches and does not count.

    Args:
        functions: what to measure, by name.
        repetitions: of all of them.
        prepare: called with the name before each call; its time does not count.
        clock: CPU time of this process, which other processes do not make longer; `time.perf_counter` is cheaper, for
            functions of some microseconds.
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
    """Median of the ratios within a repetition: what slows the machine for a moment slows both."""
    return float(np.median(times[name] / times[reference]))


def print_table(title: str, headings: Sequence[str], rows: Mapping[str, Sequence[object]]) -> None:
    """Prints a row for each name; numbers are printed as they are formatted by the caller."""
    cells = [["", *headings], *([name, *map(str, row)] for name, row in rows.items())]
    widths = [max(len(row[column]) for row in cells) for column in range(len(cells[0]))]
    print(title)
    for first, *others in cells:
        aligned = (cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))
        print("  " + "  ".join([first.ljust(widths[0]), *aligned]), flush=True)


def write_json(path: str | None, result: object) -> None:
    """Writes the numbers there too, if a path is given."""
    if path:
        Path(path).write_text(json.dumps(result, indent=2) + "\n")
