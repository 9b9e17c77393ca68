"""The verbs that hand a model to other programs, and that judge what the dVRK's controller has installed."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from dvrk_drake.cli.support import add_overwrite, check_output
from dvrk_drake.errors import DvrkDrakeError, ModelError

if TYPE_CHECKING:
    from dvrk_drake.dynamics.identified_model import IdentifiedModel


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Adds the verbs and their options."""
    verb = verbs.add_parser(
        "export", help="write a model for other programs: SDF, URDF, dVRK", description=_export_help
    )
    verb.add_argument("model", metavar="MODEL", help=_model_help)
    verb.add_argument(
        "--sdf", metavar="OUT.sdf", help="the arm with the model's inertias, meshes in a folder beside it"
    )
    verb.add_argument("--urdf", metavar="OUT.urdf", help="the same as URDF, the linkage as mimic joints")
    verb.add_argument("--diff", action="store_true", help="print what differs from the arm's own SDF, line by line")
    verb.add_argument("--dvrk-gc", metavar="OUT.json", help=_gc_help)
    verb.add_argument("--dvrk-kinematic-gc", metavar="OUT.json", help="the controller's gravity compensation of a PSM")
    add_overwrite(verb)
    _add_gc_options(verb.add_argument_group("options of --dvrk-gc (the first also of --dvrk-kinematic-gc)"))
    verb.set_defaults(run=_export)

    verb = verbs.add_parser(
        "compare-gc",
        help="compare an installed gravity-compensation file of the dVRK with a model",
        description="Compares a gc-*.json of the dVRK's controller with a model over the whole joint box, at rest.",
    )
    verb.add_argument("file", metavar="GC.json")
    verb.add_argument("--model", required=True, metavar="MODEL", help=_model_help)
    verb.add_argument("--plot", metavar="OUT.png", help="draw both over the joint box")
    verb.add_argument("--json", metavar="FILE", help="write the table as JSON")
    add_overwrite(verb)
    verb.set_defaults(run=_compare)


def _add_gc_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--gc-tolerance", type=float, metavar="NM", help=_tolerance_help)
    group.add_argument("--friction", action="store_true", help="compensate the dry friction of the model's dynamics")
    for name, text in (
        ("--coulomb", "dry friction of the joints [N m], instead of --friction; default: none"),
        ("--friction-ratio", "share 0..1 of it to compensate; default: as in files in use"),
        ("--dead-band", "speeds up to which it is not [rad/s]; default: likewise"),
        ("--saturation", "speeds from which it is in full [rad/s]; default: likewise"),
    ):
        group.add_argument(name, nargs=7, type=float, metavar=tuple(f"J{i}" for i in range(1, 8)), help=text)


def _export(options: argparse.Namespace) -> None:
    writers = {"sdf": _sdf_writer, "urdf": _urdf_writer, "dvrk_gc": _gc_writer, "dvrk_kinematic_gc": _kinematic_writer}
    outputs = {name: path for name in writers if (path := getattr(options, name)) is not None}
    if not outputs and not options.diff:
        raise DvrkDrakeError(f"nothing to write; name {' or '.join('--' + name.replace('_', '-') for name in writers)}")
    model = _load_model(options.model)
    for path in outputs.values():
        check_output(path, options.model, overwrite=options.overwrite)
    # All are computed before the first is written: one that is refused leaves no other behind.
    for write in [writers[name](model, path, options) for name, path in outputs.items()]:
        write()
    if options.diff:
        _print_difference(model)


def _sdf_writer(model: IdentifiedModel, path: str, options: argparse.Namespace) -> Callable[[], None]:
    from dvrk_drake.dynamics.model_links import model_bodies
    from dvrk_drake.export.sdf import changed_links, write_sdf
    from dvrk_drake.reports.export import print_changed_links
    from dvrk_drake.reports.terminal_tables import make_console

    arm, bodies = model.load_arm(), model_bodies(model)

    def write() -> None:
        write_sdf(arm, bodies.links, path, options.model, bodies.rotors)
        console = make_console()
        print_changed_links(console, changed_links(arm, bodies.links), bodies)
        console.print(f"SDF: {path}", soft_wrap=True)

    return write


def _urdf_writer(model: IdentifiedModel, path: str, options: argparse.Namespace) -> Callable[[], None]:
    from dvrk_drake.dynamics.model_links import model_bodies
    from dvrk_drake.export.urdf import write_urdf

    bodies = model_bodies(model)

    def write() -> None:
        write_urdf(model.load_arm(), bodies.links, path, options.model, bodies.rotors)
        print(f"URDF: {path}")

    return write


def _print_difference(model: IdentifiedModel) -> None:
    from dvrk_drake.dynamics.model_links import model_bodies
    from dvrk_drake.export.sdf import sdf_difference

    bodies = model_bodies(model)
    sys.stdout.write(sdf_difference(model.load_arm(), bodies.links, bodies.rotors))


def _gc_writer(model: IdentifiedModel, path: str, options: argparse.Namespace) -> Callable[[], None]:
    from dvrk_drake.export.dvrk_mtm_gravity_compensation import (
        CompensationOptions,
        compensation_from_model,
        dry_friction,
        largest_differences,
    )
    from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
    from dvrk_drake.reports.export import print_compensation
    from dvrk_drake.reports.terminal_tables import make_console

    if options.friction and options.coulomb is not None:
        raise DvrkDrakeError("--friction and --coulomb both say how large friction is; give one")
    given = {
        "tolerance": options.gc_tolerance,
        "coulomb": dry_friction(model) if options.friction else options.coulomb,
        "friction_ratio": options.friction_ratio,
        "dead_band": options.dead_band,
        "saturation": options.saturation,
    }
    file = compensation_from_model(model, CompensationOptions(**{k: v for k, v in given.items() if v is not None}))
    arm = model.load_arm()

    def write() -> None:
        file.save(path, arm.name, f"dvrk-drake export of {options.model}")
        written = GravityCompensationFile.load(path)
        print_compensation(make_console(), path, arm, written, largest_differences(written, model))

    return write


def _kinematic_writer(model: IdentifiedModel, path: str, options: argparse.Namespace) -> Callable[[], None]:
    from dvrk_drake.export.dvrk_psm_gravity_compensation import kinematic_compensation
    from dvrk_drake.reports.export import print_kinematic_compensation
    from dvrk_drake.reports.terminal_tables import make_console

    given = {} if options.gc_tolerance is None else {"tolerance": options.gc_tolerance}
    file = kinematic_compensation(model, **given)

    def write() -> None:
        file.save(path)
        print_kinematic_compensation(make_console(), path, file)

    return write


def _compare(options: argparse.Namespace) -> None:
    from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import compare_compensation
    from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.export import plot_compensation, print_comparison
    from dvrk_drake.reports.terminal_tables import make_console

    for path in (options.plot, options.json):
        if path is not None:
            check_output(path, options.file, options.model, overwrite=options.overwrite)
    file = GravityCompensationFile.load(options.file)
    model = _load_model(options.model)
    try:
        comparison = compare_compensation(file, model)
    except ModelError as error:
        raise ModelError(f"{options.file}: {error}") from error
    console = make_console()
    print_comparison(console, options.file, options.model, comparison)
    if comparison.other_side:
        print(
            f"dvrk-drake: warning: {options.file}: the mirror image of the model fits better: the file is probably one "
            f"of the other side's arm, not of {model.load_arm().name}. Check ARM_NAME and the serial number",
            file=sys.stderr,
            flush=True,
        )
    if options.plot is not None:
        plot_compensation(options.plot, comparison, f"{options.file} and {options.model} over the joint box, at rest")
        console.print(f"plot: {options.plot}", soft_wrap=True)
    if options.json is not None:
        with atomic_write(options.json) as stream:
            json.dump(comparison.as_dict(), stream, indent=2)
            stream.write("\n")


def _load_model(name: str) -> IdentifiedModel:
    """The model of a file, or what the SDF of an arm states, known or of an arm's own file."""
    from dvrk_drake.dynamics.identified_model import IdentifiedModel
    from dvrk_drake.models.arm import known_arms, load_arm

    if name.lower() in known_arms() or _is_arm_file(name):
        return IdentifiedModel.from_arm(load_arm(name))
    return IdentifiedModel.load(name)


def _is_arm_file(name: str) -> bool:
    """An arm's YAML names its mechanism; a model's has no such field."""
    from dvrk_drake.models.files import read_text_input

    try:
        return any(line.startswith("mechanism:") for line in read_text_input(name, DvrkDrakeError).splitlines())
    except DvrkDrakeError:
        return False


_export_help = "Writes a model for other programs; several files at once if several are named."
_model_help = "MODEL.yaml, from identify; or mtml, mtmr, psm, an arm's YAML file: what the SDF of that arm states"
_gc_help = (
    "the controller's gravity compensation of an MTM; from mtml or mtmr, whose masses are estimates, only with "
    "--gc-tolerance: identify your arm first"
)
_tolerance_help = "error [N m] to accept where the file cannot hold what the model says; default: 1e-6"
