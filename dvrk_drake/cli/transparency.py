"""The verb `transparency`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from dvrk_drake.cli.support import ProgressBar, made_folder, quiet_drake

if TYPE_CHECKING:
    from dvrk_drake.experiments.transparency import Compensation
    from dvrk_drake.models.arm import Arm


def add_verbs(verbs: argparse._SubParsersAction) -> None:
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
    from dvrk_drake.reports.terminal_tables import make_console
    from dvrk_drake.reports.transparency import plot_transparency, print_transparency, write_transparency

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
        models[name] = IdentifiedModel.load(path)
        if models[name].load_arm().name != arm.name:
            raise ModelError(f"{path}: is of {models[name].arm}, not of {arm.name}")
    if not models:
        models["SDF"] = IdentifiedModel.from_arm(arm)
    listed = [Compensation("nothing")]
    for name, model in models.items():
        listed.append(Compensation(name, model))
        if options.friction_ratio:
            listed.append(Compensation(f"{name}, friction {options.friction_ratio:g}", model, options.friction_ratio))
    return listed
