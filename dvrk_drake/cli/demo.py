"""Commands that run experiments on simulated arms: demo, simulate teleop and reproduce."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from dvrk_drake.cli import options, support
from dvrk_drake.progress import step_progress

_DEMO_STEPS = "collecting poses", "identifying", "collecting fresh poses", "simulating the release", "drawing"
Folder = Annotated[str, Parameter(metavar="FOLDER", help="Write into this folder, which must be new or empty.")]


@options.app.command(group=options.SIMULATE)
def demo(
    *,
    arm: Literal["mtml", "mtmr", "psm"] = "mtml",
    folder: Folder = "demo_output",
    seed: options.Seed = 0,
    overwrite: options.Overwrite = False,
    verbose: options.Verbose = False,
) -> None:
    """Identify a model of a simulated arm, and test it.

    Args:
        arm: Arm to simulate.
    """
    from dvrk_drake.experiments.demo import run_demo
    from dvrk_drake.reports.demo import write_demo

    output = support.new_folder(folder, overwrite=overwrite)
    with support.Steps(*_DEMO_STEPS) as steps:
        result = run_demo(output, arm, seed, steps)
        steps("drawing", 0.0)
        page = write_demo(result, output, support.command_words)
    support.show_page(page, verbose=verbose)
    support.print_written(output / "report.html", "open it in a browser")


@options.simulate.command
def teleop(
    *,
    output: Annotated[str | None, Parameter(metavar="FILE.html")] = None,
    force_feedback: Annotated[bool, Parameter(show_default=False)] = False,
    overwrite: options.Overwrite = False,
    port: options.Port = None,
    verbose: options.Verbose = False,
) -> None:
    """Simulate a PSM that is teleoperated with an MTM.

    Move the MTM with sliders in a browser, or play a recorded hand motion with --output.

    Args:
        output: Play a recorded hand motion, write an animation to this HTML file, and print the PSM's tracking error.
        force_feedback: Place an object below the instrument, and reflect the estimated force of the contact to the MTM.
    """
    from dvrk_drake.experiments.teleoperation import PHASES, play_teleoperation, run_live_teleoperation, start_scene
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.demo import teleoperation_page
    from dvrk_drake.systems.arm_view.efforts import FORCE_COLOR, FORCE_SCALE
    from dvrk_drake.systems.arm_view.page import page_html

    if output is None:
        meshcat = start_scene(port)
        print(
            f"MTML controls PSM at {meshcat.web_url()}; hand, clutch (Space), jaw and scale are under Open Controls; "
            "the arms appear after some seconds; press Stop, Escape or Ctrl-C to end",
            flush=True,
        )
        run_live_teleoperation(meshcat, force_feedback=force_feedback)
        return
    support.check_output(output, overwrite=overwrite)
    meshcat = start_scene(port)
    with support.Steps("playing") as steps:
        progress = step_progress(steps, "playing")
        result = play_teleoperation(meshcat, progress=progress, force_feedback=force_feedback)
    with atomic_write(output) as stream:
        colors = {FORCE_COLOR: FORCE_SCALE} if force_feedback else {}
        stream.write(page_html(meshcat, "MTML teleoperates PSM", phases=PHASES, colors=colors, effort_scale=True))
    support.show_page(teleoperation_page(result, output), verbose=verbose)
    support.print_written(output)


@options.app.command(group=options.SIMULATE)
def reproduce(
    what: Literal["table1", "fig4", "fig5", "fig6", "fig7", "psm", "transparency", "all"] = "all",
    /,
    *,
    folder: Folder = "reproduction",
    data: Annotated[str | None, Parameter(metavar="FOLDER")] = None,
    seed: options.Seed = 0,
    overwrite: options.Overwrite = False,
) -> None:
    """Reproduce the results of the paper (Rutfield et al., 2015).

    The command writes an HTML page that compares published and reproduced numbers.
    Without the recording of the paper, Fig. 4 is omitted and a different MTM is simulated.

    Args:
        what: Table, figure or experiment to reproduce.
        data: Folder with mtm_2015_good72.csv (docs/public_recordings.md). Default: $DVRK_DRAKE_SHARED/data/mtm_static.
    """
    from dvrk_drake.experiments.paper import PaperRecordings
    from dvrk_drake.reports.reproduction import NAMES
    from dvrk_drake.reports.reproduction import reproduce as reproduce_paper
    from dvrk_drake.reports.terminal import make_console

    recordings = PaperRecordings.find(data)
    if what == "fig4":
        _ = recordings.poses  # rejects a missing recording before the folder is created
    output = support.new_folder(folder, overwrite=overwrite)
    names = NAMES if what == "all" else (what,)
    with support.Steps(*names) as steps:
        page = reproduce_paper(names, output, recordings, steps, seed=seed, command=support.command_words)
    console = make_console()
    for section in page.sections[1:]:
        console.print(f"{section.title}: {section.finding}", markup=False)
    support.print_written(output / "index.html")
