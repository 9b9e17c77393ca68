"""The verb that redoes the paper's experiments."""

from __future__ import annotations

import argparse

from dvrk_drake.cli.support import ProgressBar, made_folder, quiet_drake, seed

NAMES = ("table1", "fig4", "fig5", "fig6", "fig7", "psm", "transparency")


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser(
        "reproduce", help="redo the paper's figures and tables beside its published numbers; writes a folder"
    )
    verb.add_argument("what", nargs="?", choices=(*NAMES, "all"), default="all", help="default: all")
    verb.add_argument("--output", default="reproduction", metavar="DIR", help="default: reproduction")
    verb.add_argument(
        "--data",
        metavar="DIR",
        help="folder with the paper's recording mtm_2015_good72.csv (docs/reproduction.md); default: "
        "$DVRK_DRAKE_SHARED/data/mtm_static; without it Fig. 4 cannot be made and others have another arm",
    )
    verb.add_argument("--seed", type=seed, default=0, help="of simulated arms, poses and noise; default: 0")
    verb.set_defaults(run=_reproduce)


def _reproduce(options: argparse.Namespace) -> None:
    from dvrk_drake.experiments.reproduction.published import PaperRecordings
    from dvrk_drake.reports.reproduction.run import reproduce

    quiet_drake()
    recordings = PaperRecordings.find(options.data)
    if options.what == "fig4":
        _ = recordings.poses  # refuses before a folder is made
    output = made_folder(options.output)
    names = NAMES if options.what == "all" else (options.what,)
    with ProgressBar("") as bar:
        page = reproduce(names, output, recordings, bar, seed=options.seed)
    print(f"written: {page}")
