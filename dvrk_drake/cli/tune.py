"""The verb `tune` of the command line."""

from __future__ import annotations

import argparse

from dvrk_drake.cli.support import ProgressBar, add_overwrite, check_output, made_folder, quiet_drake


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser("tune", help="find gains on the simulated arm, and compare them with the arm's own")
    verb.add_argument("--arm", required=True, help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument(
        "--method",
        choices=("paper", "model", "both"),
        default="both",
        help="paper: Kp up until it oscillates, Kv, Ki; model: from inertia, friction and delay; default: both",
    )
    verb.add_argument("--output", metavar="GAINS.yaml", help="write the gains found; of both methods the better ones")
    add_overwrite(verb)
    verb.add_argument("--plots", metavar="DIR", help="write step responses into this folder")
    verb.set_defaults(run=_tune)


def _tune(options: argparse.Namespace) -> None:
    from dvrk_drake.experiments.tuning.tuning import Method, tune_arm
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.models.arm_schema import save_gains
    from dvrk_drake.reports.terminal_tables import make_console
    from dvrk_drake.reports.tuning import plot_steps, print_tuning

    quiet_drake()
    arm = load_arm(options.arm)
    if options.output is not None:
        check_output(options.output, options.arm, overwrite=options.overwrite)
    plots = None if options.plots is None else made_folder(options.plots)
    methods: list[Method] = ["paper", "model"] if options.method == "both" else [options.method]
    with ProgressBar(f"tuning {arm.name}") as bar:
        tuning = tune_arm(options.arm, methods, bar.share)
    print_tuning(make_console(), tuning)
    best = tuning.comparison.best(tuning.found)
    print(f"of the gains found, those of method {best} settle most often, and then fastest")
    if options.output is not None:
        save_gains(
            tuning.found[best], options.output, f"{arm.name}: dvrk-drake tune --arm {options.arm}, method {best}."
        )
        print(f"gains: {options.output}")
    if plots is not None:
        plot_steps(plots / "steps.png", tuning.comparison)
        print(f"plots: {plots}")
