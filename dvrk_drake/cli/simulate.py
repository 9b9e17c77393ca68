"""The commands that simulate an arm: simulate, study, tune, transparency."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import dvrk_drake as dvrk
from dvrk_drake.cli.support import ProgressBar, add_overwrite, check_output, made_folder, quiet_drake, until_stopped
from dvrk_drake.errors import StudyError

if TYPE_CHECKING:
    from dvrk_drake.experiments.transparency import Compensation
    from dvrk_drake.models.arm import Arm


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the commands and their options."""
    _add_simulate(verbs)
    _add_study(verbs)
    _add_tune(verbs)
    _add_transparency(verbs)


def _add_simulate(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser("simulate", help="simulate an arm under control, as a scenario file says, and record it")
    verb.add_argument("scenario", metavar="ARM_OR_SCENARIO", help="mtml, mtmr, psm: holds its home; or scenario.yaml")
    verb.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="changes the scenario, e.g. controller.mode=gravity; again for more",
    )
    verb.add_argument("--output", metavar="RECORDING.csv", help="write t, q, qd and tau")
    add_overwrite(verb)
    verb.add_argument("--plots", metavar="DIR", help="write plots into this folder")
    verb.add_argument("--meshcat", action="store_true", help="show it in a browser, in real time")
    verb.set_defaults(run=_simulate)


def _simulate(options: argparse.Namespace) -> None:
    from dvrk_drake.reports.figures.simulation import plot_simulation
    from dvrk_drake.reports.simulation import print_simulation
    from dvrk_drake.reports.terminal_tables import make_console

    quiet_drake()
    scenario = dvrk.load_scenario(options.scenario, options.set)
    plots = None if options.plots is None else made_folder(options.plots)
    if options.output is not None:
        check_output(options.output, options.scenario, scenario.controller.model, overwrite=options.overwrite)
    meshcat = dvrk.start_meshcat(scenario.mounted_arm) if options.meshcat else None
    if meshcat is not None:
        print(f"{scenario.mounted_arm.name} at {meshcat.web_url()}", flush=True)
    with ProgressBar("simulating") as bar:
        simulation = dvrk.simulate(scenario, meshcat=meshcat, progress=bar)
    print_simulation(make_console(), simulation, scenario.mounted_arm)
    if options.output is not None:
        dvrk.write_recording(simulation.recording, options.output)
        print(f"recording: {options.output}, {len(simulation.recording)} rows")
    if plots is not None:
        plot_simulation(plots / "positions.png", simulation, scenario)
        print(f"plots: {plots}")
    if meshcat is not None:
        print("the page can play the motion again; end with Stop, Escape or Ctrl-C", flush=True)
        until_stopped(meshcat)


def _add_study(verbs: argparse._SubParsersAction) -> None:
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
    from dvrk_drake.reports.figures.study import plot_study
    from dvrk_drake.reports.study import print_study
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


def _add_tune(verbs: argparse._SubParsersAction) -> None:
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
    from dvrk_drake.reports.figures.tuning import plot_steps
    from dvrk_drake.reports.terminal_tables import make_console
    from dvrk_drake.reports.tuning import print_tuning

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


def _add_transparency(verbs: argparse._SubParsersAction) -> None:
    """Adds the verb and its options."""
    verb = verbs.add_parser("transparency", help="force and torque that a hand feels of a simulated arm it leads")
    verb.add_argument("--arm", required=True, help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument("--path", metavar="RECORDING", help="the motion to follow; default: through random poses")
    verb.add_argument(
        "--coordinates", choices=("joint", "actuator"), default="joint", help="what its q are of; default: joint"
    )
    verb.add_argument("--speed", type=float, metavar="S", help="S times as fast as recorded; default: 1")
    verb.add_argument(
        "--model",
        action="append",
        default=[],
        metavar="NAME=MODEL.yaml",
        help="compensate with this model; again for more; default: what the arm's SDF states",
    )
    verb.add_argument(
        "--friction-ratio", type=float, default=0.5, metavar="R", help="share of the friction; default: 0.5"
    )
    verb.add_argument(
        "--real-arm",
        nargs="+",
        default=["all"],
        metavar="PART",
        help="parts of the real arm that the simulation has, as in a scenario; default: all",
    )
    verb.add_argument(
        "--frame",
        default="",
        help="the SDF's frame of the handle; default: dh_7 of an MTM, dh_6 of a PSM",
    )
    verb.add_argument("--output", metavar="DIR", help="write the table and a plot into this folder")
    verb.set_defaults(run=_transparency)


def _transparency(options: argparse.Namespace) -> None:
    from dvrk_drake.errors import ScenarioError
    from dvrk_drake.experiments.transparency import feel, rambling_path, recorded_path
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.recordings.recording import read_recording
    from dvrk_drake.reports.figures.transparency import plot_transparency
    from dvrk_drake.reports.terminal_tables import make_console
    from dvrk_drake.reports.transparency import print_transparency, write_transparency

    quiet_drake()
    arm = load_arm(options.arm)
    effects = arm.effects.only(options.real_arm)
    path = rambling_path(arm)
    if options.path is not None:
        recording = read_recording(options.path, arm, options.coordinates)
        path = recorded_path(arm, recording, 1.0 if options.speed is None else options.speed)
    elif options.speed is not None:
        raise ScenarioError("--speed is that of a recorded motion; name one with --path")
    compensations = _compensations(options, arm)
    folder = None if options.output is None else made_folder(options.output)
    felt = []
    for compensation in compensations:
        with ProgressBar(compensation.name) as bar:
            felt.append(feel(arm, path, compensation, effects=effects, frame_name=options.frame, progress=bar.share))
    print_transparency(make_console(), arm, felt)
    if folder is not None:
        write_transparency(folder / "transparency.csv", felt)
        plot_transparency(folder / "transparency.png", arm, felt)
        print(f"written: {folder}/transparency.csv, transparency.png")


def _compensations(options: argparse.Namespace, arm: Arm) -> list[Compensation]:
    """Nothing, each model, and each model with friction compensation.

    Raises:
        ModelError: a model that is not of this arm.
        ControllerError: a friction ratio that is not allowed.
    """
    from dvrk_drake.dynamics.friction_compensation import check_ratios
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.errors import ModelError
    from dvrk_drake.experiments.transparency import Compensation

    check_ratios(options.friction_ratio)
    models = {}
    for given in options.model:
        name, equals, path = given.partition("=")
        if not equals or not name or name in models:
            raise ModelError(f"--model {given}: must be NAME=MODEL.yaml, each name once")
        models[name] = IdentifiedModel.load(path, arm)
    if not models:
        models["SDF"] = IdentifiedModel.from_arm(arm)
    listed = [Compensation("nothing")]
    for name, model in models.items():
        listed.append(Compensation(name, model))
        if options.friction_ratio:
            listed.append(Compensation(f"{name}, friction {options.friction_ratio:g}", model, options.friction_ratio))
    return listed
