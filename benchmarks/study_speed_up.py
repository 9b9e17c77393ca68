"""Measures the speed-up of a study with several workers, and checks that the results are identical.

    python benchmarks/study_speed_up.py [STUDY.yaml] [--workers 1 2] [--set duration=11]

The times include starting the workers. Each worker imports Drake.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

from timing import print_table

from dvrk_drake.experiments.study import load_study
from dvrk_drake.experiments.study_run import run_study_locally

EXAMPLE = Path(__file__).parent.parent / "examples" / "release_study.yaml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", nargs="?", default=str(EXAMPLE), help="study file")
    parser.add_argument(
        "--workers",
        nargs="+",
        type=int,
        default=[1, os.cpu_count() or 1],
        help="numbers of worker processes; default: %(default)s",
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="setting of the scenario")
    options = parser.parse_args()
    study = load_study(options.study, options.set)
    first, table = None, {}
    for workers in options.workers:
        with tempfile.TemporaryDirectory() as folder:
            results = Path(folder, "results.csv")
            start = time.perf_counter()
            rows = run_study_locally(study, results, workers, lambda done, total: None)
            took, content = time.perf_counter() - start, results.read_bytes()
        first = first or (took, content)
        same = "identical" if content == first[1] else "DIFFERENT"
        table[f"{workers} workers"] = [len(rows), f"{took:.1f}", f"{first[0] / took:.2f}", same]
    print_table(Path(options.study).name, ["runs", "time [s]", "speed-up", "results"], table)


if __name__ == "__main__":
    main()
