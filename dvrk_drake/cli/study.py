"""The verb `study` of the command line."""

from __future__ import annotations

import argparse

from dvrk_drake.cli.support import ProgressBar, check_output, made_folder, quiet_drake
from dvrk_drake.errors import StudyError


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser("study", help="simulate a scenario over many poses, seeds and errors, on all cores")
    verb.add_argument("study", metavar="STUDY.yaml")
    verb.add_argument(
        "--output", required=True, metavar="RESULTS.csv", help="or .parquet; begun with this study before: goes on"
    )
    verb.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="changes its scenario; again for more"
    )
    where = verb.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_workers, metavar="N", help="processes here; default: one a core")
    where.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster that runs it, e.g. tcp://host:8786")
    verb.add_argument("--plots", metavar="DIR", help="write study.png into this folder")
    verb.set_defaults(run=_study)


def _study(options: argparse.Namespace) -> None:
    from dvrk_drake.experiments.study.study import dask_executor, run_study, run_study_locally
    from dvrk_drake.experiments.study.study_file import load_study
    from dvrk_drake.reports.study import plot_study, print_study
    from dvrk_drake.reports.terminal_tables import make_console

    quiet_drake()
    study = load_study(options.study, options.set)
    if not options.output.endswith((".csv", ".parquet")):
        raise StudyError(f"{options.output}: must end in .csv or .parquet")
    check_output(options.output, overwrite=True)
    plots = None if options.plots is None else made_folder(options.plots)
    with ProgressBar("runs") as bar:

        def show(done: int, all_cases: int) -> None:
            bar(f"{done}/{all_cases} runs", done / all_cases)

        if options.scheduler is None:
            rows = run_study_locally(study, options.output, options.workers, show)
        else:
            with dask_executor(options.scheduler) as executor:
                rows = run_study(study, executor, options.output, show)
    print_study(make_console(), study, rows)
    print(f"results: {options.output}, {len(rows)} runs")
    if plots is not None:
        plot_study(plots / "study.png", study, rows)
        print(f"plots: {plots}")


def _workers(text: str) -> int:
    if not (text.isdigit() and 1 <= int(text) <= 1024):
        raise argparse.ArgumentTypeError(f'"{text}" is not a number of processes, 1..1024')
    return int(text)
