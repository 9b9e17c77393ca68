"""The command line: one verb a command. Bad input gives one line on stderr and exit code 2."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib.metadata import version

from dvrk_drake.cli_lcm import add_arm, add_run
from dvrk_drake.cli_record import add_record
from dvrk_drake.cli_simulate import add_simulate
from dvrk_drake.cli_support import (
    ProgressBar,
    add_gravity,
    check_output,
    import_interruptibly,
    made_folder,
    mounted,
    print_notes,
    quiet_drake,
    seed,
    until_stopped,
)
from dvrk_drake.errors import DvrkDrakeError

# Verbs import what they need when they run: drake and numba take seconds, `--help` should not.


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one verb; returns the exit code: 0, or 2 for bad input."""
    options = _parser().parse_args(arguments)
    try:
        import_interruptibly()
        options.run(options)
    except DvrkDrakeError as error:
        print(f"dvrk-drake: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader (head, less) has seen enough.
        sys.stderr.close()
        return 0
    except KeyboardInterrupt:
        print("dvrk-drake: interrupted", file=sys.stderr)
        return 130
    return 0


def _model(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.tables import make_console, print_symbolic_model
    from dvrk_drake.dynamics import export
    from dvrk_drake.dynamics.symbolic_gravity import derive_gravity
    from dvrk_drake.dynamics.symbolic_plant import SymbolicPlant
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.models.atomic_file import atomic_write

    if options.output is not None:
        if options.format is None:
            raise DvrkDrakeError("--output needs to know what to write: --latex, --python or --c")
        check_output(options.output)
    arm = mounted(load_arm(options.arm), options.gravity)
    gravity = derive_gravity(arm, options.frames, options.serial)
    writers = {
        "latex": lambda gravity: export.to_latex(gravity, SymbolicPlant(arm, options.frames).frame_poses()),
        "python": export.to_python,
        "c": export.to_c,
    }
    if options.format is None:
        print_symbolic_model(make_console(), gravity)
        return
    text = writers[options.format](gravity)
    if options.output is None:
        sys.stdout.write(text)
    else:
        with atomic_write(options.output) as stream:
            stream.write(text)


def _identify(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.plots import plot_identification
    from dvrk_drake.analysis.poses import find_poses
    from dvrk_drake.analysis.static_identification import identify_static
    from dvrk_drake.analysis.tables import make_console, print_doubts, print_model
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.models.recording import read_recording

    arm = mounted(load_arm(options.arm), options.gravity)
    recording = read_recording(options.recording, arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    check_output(options.output, options.recording)
    console = make_console()
    recording, measured, note = find_poses(recording, arm, options.slow_parts)
    if note:
        console.print(note)
    with ProgressBar("identifying") as (progress, task):
        result = identify_static(
            recording, arm, options.method, lambda share: progress.update(task, completed=100 * share), measured
        )
    print_doubts(console, result.doubts)
    print_model(console, result.model)
    if len(result.recording) < len(recording):
        console.print(
            f"{len(recording)} rows are {len(result.recording)} distinct poses; samples of a pose are averaged"
        )
    result.model.save(options.output)
    console.print(f"model: {options.output}")
    if options.plots is not None:
        plot_identification(made_folder(options.plots), result)
        console.print(f"plots: {options.plots}")


def _validate(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.plots import plot_validation
    from dvrk_drake.analysis.poses import find_poses
    from dvrk_drake.analysis.tables import make_console, print_doubts, print_validation
    from dvrk_drake.analysis.validation import validate
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.atomic_file import atomic_write
    from dvrk_drake.models.recording import read_recording

    model = IdentifiedModel.load(options.model)
    arm = model.load_arm()
    recording = read_recording(options.recording, arm, options.coordinates)
    print_notes(options.recording, recording.notes)
    if options.json is not None:
        check_output(options.json, options.recording, options.model)
    console = make_console()
    recording, measured, note = find_poses(recording, arm, options.slow_parts)
    if note:
        console.print(note)
    if motion := recording.motion(arm):
        console.print(
            f"the arm moves in this recording ({motion}): the model holds poses, and "
            "knows nothing of inertia and of moving friction",
            style="yellow",
            soft_wrap=True,
        )
    validation = validate(model, recording, measured)
    print_doubts(console, validation.doubts)
    print_validation(console, validation)
    if options.plots is not None:
        plot_validation(made_folder(options.plots), model, validation, recording.in_joint_coordinates(arm))
        console.print(f"plots: {options.plots}")
    if options.json is not None:
        with atomic_write(options.json) as stream:
            json.dump(validation.as_dict(), stream, indent=2)
            stream.write("\n")


def _predict(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.validation import predict
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.recording import read_recording, write_csv

    check_output(options.output, options.recording, options.model)
    model = IdentifiedModel.load(options.model)
    recording = read_recording(options.recording, model.load_arm(), options.coordinates)
    print_notes(options.recording, recording.notes)
    tau = predict(model, recording)
    write_csv(options.output, [f"tau{i + 1}" for i in range(tau.shape[1])], tau)


def _convert(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.convert import convert
    from dvrk_drake.analysis.tables import make_console
    from dvrk_drake.models.arm import load_arm

    console = make_console()
    recording, notes = convert(
        options.input,
        options.output,
        format=options.format,
        variable=options.variable,
        rate=options.rate,
        arm=None if options.arm is None else load_arm(options.arm),
        skip_invalid=options.skip_invalid,
    )
    for note in notes:
        console.print(note, soft_wrap=True)
    console.print(f"{options.output}: {len(recording)} rows, {recording.coordinates} coordinates", soft_wrap=True)


def _view(options: argparse.Namespace) -> None:
    from dvrk_drake.models.arm import load_arm
    from dvrk_drake.systems.arm_view import ArmView, start_meshcat
    from dvrk_drake.systems.camera import framing

    quiet_drake()
    arm = load_arm(options.arm)
    meshcat = start_meshcat(*framing(arm), port=options.port)
    view = ArmView(arm, meshcat)
    view.add_sliders()
    print(
        f"{arm.name} at {meshcat.web_url()}; sliders under Open Controls; end with Stop, Escape or Ctrl-C", flush=True
    )
    until_stopped(meshcat, view.follow_sliders)


def _teleop(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.tables import make_console, print_teleoperation
    from dvrk_drake.analysis.teleoperation_demo import play_teleoperation, run_live_teleoperation, start_scene
    from dvrk_drake.models.atomic_file import atomic_write

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
    check_output(options.html)
    meshcat = start_scene(options.port)
    with ProgressBar("playing") as (progress, task):
        result = play_teleoperation(meshcat, progress=lambda share: progress.update(task, completed=100 * share))
    with atomic_write(options.html) as stream:
        stream.write(meshcat.StaticHtml())
    print_teleoperation(make_console(), result, options.html)


def _demo(options: argparse.Namespace) -> None:
    from dvrk_drake.analysis.demo import run_demo
    from dvrk_drake.analysis.tables import make_console, print_demo

    quiet_drake()
    output = made_folder(options.output)
    with ProgressBar("") as (progress, task):
        result = run_demo(
            output,
            options.arm,
            options.seed,
            lambda what, share: progress.update(task, description=what, completed=100 * share),
        )
    print_demo(make_console(), result, options.output)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="dvrk-drake", description="Model, identify, compensate and simulate da Vinci Research Kit arms with Drake."
    )
    parser.add_argument("--version", action="version", version=version("dvrk-drake"))
    verbs = parser.add_subparsers(required=True, metavar="VERB")

    verb = verbs.add_parser("model", help="show an arm's gravity torque and regressor", description=_model_help)
    verb.add_argument("arm", help="mtml, mtmr, psm, or the path of an arm's YAML file")
    shown = verb.add_mutually_exclusive_group()
    for name in ("latex", "python", "c"):
        shown.add_argument(f"--{name}", dest="format", action="store_const", const=name, help=f"write {name} source")
    verb.add_argument("--frames", default="dh", help="link frames of the parameters: dh (dVRK) or paper (Table I)")
    verb.add_argument("--serial", action="store_true", help="leave out the links of the linkage, as the paper does")
    verb.add_argument("--output", metavar="FILE", help="write to a file instead of standard output")
    add_gravity(verb)
    verb.set_defaults(run=_model)

    verb = verbs.add_parser("identify", help="identify a model from a recording of poses and holding torques")
    _add_recording(verb)
    verb.add_argument("--arm", required=True, help="the arm that was recorded: mtml, mtmr, psm, or a YAML file")
    verb.add_argument("--output", required=True, metavar="MODEL.yaml", help="the model file to write")
    verb.add_argument("--method", choices=("robust", "paper"), default="robust", help="default: robust")
    verb.add_argument("--plots", metavar="DIR", help="write plots into this folder")
    verb.add_argument("--slow-parts", action="store_true", help=_slow_parts_help)
    add_gravity(verb)
    verb.set_defaults(run=_identify)

    verb = verbs.add_parser("validate", help="compare a model with a recording that it was not made from")
    verb.add_argument("model", metavar="MODEL.yaml")
    _add_recording(verb)
    verb.add_argument("--json", metavar="FILE", help="write the errors as JSON")
    verb.add_argument("--slow-parts", action="store_true", help=_slow_parts_help)
    verb.add_argument("--plots", metavar="DIR", help="write plots into this folder")
    verb.set_defaults(run=_validate)

    verb = verbs.add_parser("predict", help="write a model's holding torques at a recording's poses")
    verb.add_argument("model", metavar="MODEL.yaml")
    _add_recording(verb)
    verb.add_argument("--output", required=True, metavar="FILE.csv", help="columns tau1.., one row a row")
    verb.set_defaults(run=_predict)
    verb = verbs.add_parser("convert", help="turn a recording (LCM log, team .mat, WPI 21-column CSV) into our CSV")
    verb.add_argument("input", metavar="INPUT")
    verb.add_argument("output", metavar="OUTPUT.csv")
    verb.add_argument("--format", choices=("team-mat", "wpi-csv", "lcm-log"), help="default: detected")
    verb.add_argument("--variable", metavar="NAME", help="the .mat's variable, where several fit")
    verb.add_argument(
        "--rate", type=float, default=200.0, metavar="HZ", help="samples a second of the CSV; default: 200"
    )
    verb.add_argument(
        "--arm", help="e.g. psm; WPI: write its joint coordinates instead of the actuators'; LCM log: which arm"
    )
    verb.add_argument("--skip-invalid", action="store_true", help="leave out rows that are not numbers, and count them")
    verb.set_defaults(run=_convert)
    verb = verbs.add_parser("view", help="show an arm in a browser, with sliders that keep its linkage together")
    verb.add_argument("arm", help="mtml, mtmr, psm, or the path of an arm's YAML file")
    verb.add_argument("--port", type=int, help="of the page; default: a free one")
    verb.set_defaults(run=_view)

    add_arm(verbs)
    add_run(verbs)
    add_record(verbs)
    add_simulate(verbs)
    verb = verbs.add_parser(
        "teleop", help="simulate a master arm that leads a PSM, with your hand on sliders or a played one"
    )
    verb.add_argument(
        "--html", metavar="FILE", help="play a hand, write the recording and say how well the PSM followed"
    )
    verb.add_argument("--port", type=int, help="of the page; default: a free one")
    verb.set_defaults(run=_teleop)

    verb = verbs.add_parser("demo", help="simulate an arm, identify it, compensate it, hold it; writes a folder")
    verb.add_argument("--output", default="demo_output", metavar="DIR", help="default: demo_output")
    verb.add_argument("--arm", choices=("mtml", "mtmr", "psm"), default="mtml", help="default: mtml")
    verb.add_argument("--seed", type=seed, default=0, help="of the simulated arm, its poses and noise; default: 0")
    verb.set_defaults(run=_demo)
    return parser


_model_help = (
    "Prints the base parameters; with --latex, --python or --c the gravity torque and its regressor as source."
)
_slow_parts_help = "of a motion without rests, take where a joint is slow as poses"


def _add_recording(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "recording", metavar="RECORDING", help="CSV with header q1..qn, tau1..taun; t, qd1.. optional; or an LCM log"
    )
    verb.add_argument(
        "--coordinates", choices=("joint", "actuator"), default="joint", help="what q and tau are of; default: joint"
    )


if __name__ == "__main__":
    sys.exit(main())
