"""The verbs that hand a model to other programs, and that judge what the dVRK's controller has installed."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from dvrk_drake.cli.support import add_overwrite, check_output, load_model, write_json
from dvrk_drake.errors import DvrkDrakeError, ModelError

if TYPE_CHECKING:
    from dvrk_drake.export.model_export import Format


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
    from dvrk_drake.dynamics.model_links import model_bodies
    from dvrk_drake.export.model_export import prepare_export
    from dvrk_drake.export.sdf import sdf_difference
    from dvrk_drake.reports.export import print_export
    from dvrk_drake.reports.terminal_tables import make_console

    formats: tuple[Format, ...] = ("sdf", "urdf", "dvrk-gc", "dvrk-kinematic-gc")
    named = [(format, getattr(options, format.replace("-", "_"))) for format in formats]
    outputs = [(format, path) for format, path in named if path is not None]
    if not outputs and not options.diff:
        raise DvrkDrakeError(f"nothing to write; name {' or '.join('--' + format for format in formats)}")
    if options.friction and options.coulomb is not None:
        raise DvrkDrakeError("--friction and --coulomb both say how large friction is; give one")
    model = load_model(options.model)
    for _, path in outputs:
        check_output(path, options.model, overwrite=options.overwrite)
    settings = {
        "tolerance": options.gc_tolerance,
        "friction": options.friction if options.coulomb is None else options.coulomb,
        "friction_ratio": options.friction_ratio,
        "dead_band": options.dead_band,
        "saturation": options.saturation,
    }
    # All are computed before the first is written: one that is refused leaves no other behind.
    exports = [prepare_export(model, format, origin=options.model, **settings) for format, _ in outputs]
    for (_, path), export in zip(outputs, exports, strict=True):
        export.write(path)
        print_export(make_console(), path, export)
    if options.diff:
        bodies = model_bodies(model)
        sys.stdout.write(sdf_difference(model.arm, bodies.links, bodies.rotors))


def _compare(options: argparse.Namespace) -> None:
    from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import compare_compensation
    from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
    from dvrk_drake.reports.export import print_comparison
    from dvrk_drake.reports.terminal_tables import make_console

    for path in (options.plot, options.json):
        if path is not None:
            check_output(path, options.file, options.model, overwrite=options.overwrite)
    file = GravityCompensationFile.load(options.file)
    model = load_model(options.model)
    try:
        comparison = compare_compensation(file, model)
    except ModelError as error:
        raise ModelError(f"{options.file}: {error}") from error
    console = make_console()
    print_comparison(console, options.file, options.model, comparison)
    for warning in comparison.warnings:
        print(f"dvrk-drake: warning: {options.file}: {warning}", file=sys.stderr, flush=True)
    if options.plot is not None:
        from dvrk_drake.reports.figures.export import plot_compensation

        plot_compensation(options.plot, comparison, f"{options.file} and {options.model} over the joint box, at rest")
        console.print(f"plot: {options.plot}", soft_wrap=True)
    if options.json is not None:
        write_json(options.json, comparison.as_dict())


_export_help = "Writes a model for other programs; several files at once if several are named."
_model_help = "MODEL.yaml, from identify; or mtml, mtmr, psm, an arm's YAML file: what the SDF of that arm states"
_gc_help = (
    "the controller's gravity compensation of an MTM; from mtml or mtmr, whose masses are estimates, only with "
    "--gc-tolerance: identify your arm first"
)
_tolerance_help = "error [N m] to accept where the file cannot hold what the model says; default: 1e-6"
