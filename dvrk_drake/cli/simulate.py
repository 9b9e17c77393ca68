"""Commands that simulate an arm: simulate with its subcommands, demo and reproduce."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.cli.support import Results
from dvrk_drake.errors import ScenarioError, StudyError
from dvrk_drake.progress import step_progress

_FILE = options.FileOptions()
_RESULTS = Results()
_SCENARIO = options.one_of("Source (one is required)")


@options.simulate.default
def simulate_scenario(
    scenario: Annotated[str | None, Parameter(group=_SCENARIO)] = None,
    /,
    *,
    arm: Annotated[
        options.Arm | None,
        Parameter(group=_SCENARIO, help="Regulate this arm at its home position."),
    ] = None,
    instrument: options.Instrument = "",
    set: options.Set = None,
    output: Annotated[str | None, Parameter(metavar="RECORDING")] = None,
    meshcat: Annotated[bool, Parameter(show_default=False)] = False,
    results: Results = _RESULTS,
) -> None:
    """Simulate a controlled arm and record its motion.

    Args:
        scenario: YAML file with the arm, controller, motion and simulated effects.
        output: File to write: a CSV with t [s], and q, qd and tau of all joints [rad, m, N m, N], or an .mcap bag.
        meshcat: Show the simulation in a web browser, in real time.
    """
    from dvrk_drake.models.arm_files import known_arms
    from dvrk_drake.reports.simulation import simulation_page

    if scenario in known_arms():
        raise ScenarioError(f"{scenario} is an arm, not a scenario; use --arm {scenario}")
    if instrument and arm is None:
        raise ScenarioError(
            "--instrument requires --arm; a scenario states it as e.g. arm: psm+PROGRASP_FORCEPS_400093"
        )
    arm = options.with_instrument(arm, instrument) if arm else None
    source = arm or scenario or ""
    loaded = dvrk.load_scenario(source, set or [])
    results.check(source, loaded.controller.model, output=output)
    page = dvrk.start_meshcat(loaded.mounted_arm) if meshcat else None
    if page is not None:
        print(f"{loaded.mounted_arm.name} at {page.web_url()}", flush=True)
    with support.Steps("simulating") as steps:
        simulation = dvrk.simulate(loaded, meshcat=page, progress=steps)
    command = f"dvrk-drake simulate {scenario or f'--arm {arm}'}{_set_options(set)}"
    if output is not None:
        dvrk.write_recording(simulation.recording, output, loaded.mounted_arm, simulation.setpoints)
    next_step = f"{command} --plots FOLDER" if results.plots is None else "" if meshcat else f"{command} --meshcat"
    result = simulation_page(simulation, loaded.mounted_arm, next_step=next_step)
    results.show(result, scenario, saved=output)
    if page is not None:
        print("the page can replay the motion; press Stop, Escape or Ctrl-C to end", flush=True)
        support.until_stopped(page)


def _set_options(values: Sequence[str] | None) -> str:
    """Returns the options --set for a command line, beginning with a space, or ""."""
    return "".join(f" --set {shlex.quote(value)}" for value in values or ())


@options.simulate.command
def study(
    study: str,
    /,
    *,
    output: Annotated[str, Parameter(metavar="RESULTS.csv")],
    set: options.Set = None,
    workers: Annotated[
        int | None, Parameter(metavar="N", converter=options.whole_number, validator=validators.Number(gte=1, lte=1024))
    ] = None,
    results: Results = _RESULTS,
) -> None:
    """Simulate a scenario with many poses, seeds and variations.

    Args:
        study: YAML file of the study.
        output: Results file (.csv). If it exists, only missing runs of the study are simulated.
        workers: Number of processes on this computer, 1 to 1024. Default: one per core.
    """
    from dvrk_drake.experiments.study import load_study
    from dvrk_drake.experiments.study_run import run_study_locally
    from dvrk_drake.reports.study import study_page

    loaded = load_study(study, set or [])
    if not output.lower().endswith(".csv"):
        raise StudyError(f"{output}: must end in .csv")
    support.check_output(output, overwrite=True)
    results.check(study)
    step = f"simulating {len(loaded.cases)} runs"
    with support.Steps(step) as steps:

        def show(done: int, all_cases: int) -> None:
            steps(step, done / all_cases)

        rows = run_study_locally(loaded, output, workers, show)
    page = study_page(loaded, rows, study_path=study + _set_options(set) if results.plots is None else None)
    results.show(page, study, output, saved=output)


@options.simulate.command
def tune(
    *,
    arm: options.Arm,
    method: Annotated[
        Literal["paper", "model", "both"],
        Parameter(
            help="paper: raise Kp until the joint oscillates, then set Kv (kd) and Ki. model: design gains from "
            "inertia, friction and delay."
        ),
    ] = "both",
    output: Annotated[str | None, Parameter(metavar="GAINS.yaml")] = None,
    results: Results = _RESULTS,
) -> None:
    """Tune controller gains on a simulated arm.

    The command compares the new gains with the gains of the arm file.

    Args:
        output: File for the gains. With method both, the better gains are written.
    """
    from dvrk_drake.experiments.tuning import Method, tune_arm
    from dvrk_drake.models.arm_schema import save_gains
    from dvrk_drake.reports.tuning import tuning_page

    tuned = dvrk.load_arm(arm)
    results.check(arm, output=output)
    methods: list[Method] = ["paper", "model"] if method == "both" else [method]
    step = f"tuning {tuned.name}"
    with support.Steps(step) as steps:
        tuning = tune_arm(arm, methods, step_progress(steps, step))
    best = tuning.comparison.best(tuning.found)
    if output is not None:
        save_gains(tuning.found[best], output, f"{tuned.name}: dvrk-drake simulate tune --arm {arm}, method {best}.")
    results.show(tuning_page(tuning, gains_path=output), saved=output)


@options.simulate.command
def transparency(
    *,
    arm: options.Arm,
    path: Annotated[str | None, Parameter(metavar="RECORDING")] = None,
    file: options.FileOptions = _FILE,
    speed: Annotated[float | None, Parameter(metavar="S")] = None,
    model: Annotated[list[str] | None, Parameter(metavar="MODEL.yaml")] = None,
    friction_ratio: Annotated[float | None, Parameter(metavar="R", show_default=False)] = None,
    simulated_effects: Annotated[list[str] | None, Parameter(metavar="EFFECT ..", consume_multiple=True)] = None,
    frame: Annotated[str, Parameter(metavar="NAME", show_default=False)] = "",
    output: Annotated[str | None, Parameter(metavar="FILE.csv")] = None,
    results: Results = _RESULTS,
) -> None:
    """Simulate the interaction force when an operator moves an arm.

    Args:
        path: Recording of the motion of the operator. Default: a motion through random poses.
        speed: Speed factor of the recorded motion. 2 doubles the speed.
        model: Model for gravity compensation. Repeat the option to compare models. Default: the nominal model.
        friction_ratio: Share of the friction to compensate, 0 to 0.6. Default: 0.5, or 0 for an arm file without
            friction.
        simulated_effects: Effects to simulate (docs/simulated_effects.md), e.g. friction cables. Default: all.
        frame: SDF frame at which the operator holds the arm. Default: frames.hand of the arm
            file, or the last link.
        output: CSV file for the results.
    """
    from dvrk_drake.experiments.transparency import listed_compensations, random_path, recorded_path, simulate_operator
    from dvrk_drake.reports.transparency import transparency_page, write_transparency

    moved_arm = dvrk.load_arm(arm)
    effects = moved_arm.effects.only(simulated_effects or ["all"])
    followed = random_path(moved_arm)
    if path is not None:
        motion = file.read(path, moved_arm, lambda step, share: None)
        followed = recorded_path(moved_arm, motion, 1.0 if speed is None else speed)
    elif speed is not None:
        raise ScenarioError("--speed requires --path with a recorded motion")
    if friction_ratio is None:
        friction_ratio = 0.5 if moved_arm.effects.friction else 0.0
    compensations = listed_compensations(moved_arm, model or [], friction_ratio)
    if output is not None and not output.lower().endswith(".csv"):
        raise ScenarioError(f"{output}: --output must end in .csv; figures are written to --plots FOLDER")
    results.check(path, *(model or []), output=output)
    forces = []
    names = [f"compensation by {one.name}" if one.model else "no compensation" for one in compensations]
    with support.Steps(*names) as steps:
        for name, compensation in zip(names, compensations, strict=True):
            progress = step_progress(steps, name)
            forces.append(
                simulate_operator(
                    moved_arm, followed, compensation, effects=effects, frame_name=frame, progress=progress
                )
            )
    if output is not None:
        write_transparency(Path(output), forces)
    results.show(
        transparency_page(moved_arm, forces, command=support.command_again()), path, *(model or []), saved=output
    )


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
