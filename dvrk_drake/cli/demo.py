"""The verbs `demo`, `teleop` and `reproduce`: experiments on simulated arms."""

from __future__ import annotations

import argparse

from dvrk_drake.cli.support import (
    ProgressBar,
    add_overwrite,
    check_output,
    made_folder,
    quiet_drake,
    seed,
)

NAMES = ("table1", "fig4", "fig5", "fig6", "fig7", "psm", "transparency")


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verbs and their options."""
    verb = verbs.add_parser("demo", help="simulate an arm, identify it, compensate it, hold it; writes a folder")
    verb.add_argument("--output", default="demo_output", metavar="DIR", help="default: demo_output")
    verb.add_argument("--arm", choices=("mtml", "mtmr", "psm"), default="mtml", help="default: mtml")
    verb.add_argument("--seed", type=seed, default=0, help="of the simulated arm, its poses and noise; default: 0")
    verb.set_defaults(run=_demo)

    verb = verbs.add_parser(
        "teleop", help="simulate a master arm that leads a PSM, with your hand on sliders or a played one"
    )
    verb.add_argument(
        "--html", metavar="FILE", help="play a hand, write the recording and say how well the PSM followed"
    )
    add_overwrite(verb)
    verb.add_argument("--port", type=int, help="of the page; default: a free one")
    verb.set_defaults(run=_teleop)

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


def _demo(options: argparse.Namespace) -> None:
    from dvrk_drake.experiments.demo.demo import run_demo
    from dvrk_drake.reports.demo import print_demo
    from dvrk_drake.reports.figures.demo import plot_demo
    from dvrk_drake.reports.terminal_tables import make_console

    quiet_drake()
    output = made_folder(options.output)
    with ProgressBar("") as bar:
        result = run_demo(output, options.arm, options.seed, bar)
        bar("drawing", 0.0)
        plot_demo(output, result)
        bar("drawing", 1.0)
    print_demo(make_console(), result, output)


def _teleop(options: argparse.Namespace) -> None:
    from dvrk_drake.experiments.demo.teleoperation import play_teleoperation, run_live_teleoperation, start_scene
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.demo import print_teleoperation
    from dvrk_drake.reports.terminal_tables import make_console

    quiet_drake()
    if options.html is None:
        meshcat = start_scene(options.port)
        print(
            f"MTML leads PSM at {meshcat.web_url()}; hand, clutch (Space), jaw and scale under Open Controls; the "
            "arms appear after some seconds; end with Stop, Escape or Ctrl-C",
            flush=True,
        )
        run_live_teleoperation(meshcat)
        return
    check_output(options.html, overwrite=options.overwrite)
    meshcat = start_scene(options.port)
    with ProgressBar("playing") as bar:
        result = play_teleoperation(meshcat, progress=bar.share)
    with atomic_write(options.html) as stream:
        stream.write(meshcat.StaticHtml())
    print_teleoperation(make_console(), result, options.html)


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
