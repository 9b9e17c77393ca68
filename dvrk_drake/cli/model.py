"""Commands that show an arm or its equations, write an arm file, and export a model for other programs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

import dvrk_drake as dvrk
from dvrk_drake.cli import options, support
from dvrk_drake.cli.support import ResultsAndJson
from dvrk_drake.errors import DvrkDrakeError, ModelError

if TYPE_CHECKING:
    from dvrk_drake.export.model_export import Format


@options.app.command(group=options.MODEL)
def equations(
    *,
    arm: options.Arm,
    instrument: options.Instrument = "",
    format: Literal["latex", "python", "c"] | None = None,
    output: Annotated[str | None, Parameter(metavar="FILE")] = None,
    overwrite: options.Overwrite = False,
    gravity: options.Gravity = None,
) -> None:
    """Show the base parameters of gravity, or generate source code.

    Args:
        format: Generate source code of the gravity torque and its regressor in this language.
        output: File for the source code. Default: standard output.
    """
    from dvrk_drake.dynamics.symbolic_gravity import SymbolicPlant, derive_gravity
    from dvrk_drake.export import gravity_sources
    from dvrk_drake.models.files import atomic_write
    from dvrk_drake.reports.parameters import symbolic_model_page

    if output is not None:
        if format is None:
            raise DvrkDrakeError("--output requires --format latex, python or c")
        support.check_output(output, overwrite=overwrite)
    shown = support.mounted(dvrk.load_arm(arm, instrument), gravity)
    with support.Steps("deriving the gravity torque"):
        derived = derive_gravity(shown)
    if format is None:
        support.show_page(symbolic_model_page(derived, command=support.command_again("--format", "latex")))
        return
    writers = {
        "latex": lambda: gravity_sources.to_latex(derived, SymbolicPlant(shown).frame_poses()),
        "python": lambda: gravity_sources.to_python(derived),
        "c": lambda: gravity_sources.to_c(derived),
    }
    text = writers[format]()
    if output is None:
        sys.stdout.write(text)
        return
    with atomic_write(output) as stream:
        stream.write(text)
    support.print_written(output)


@options.app.command(group=options.MODEL)
def arm_file(
    model_file: Annotated[str, Parameter(metavar="MODEL_FILE")],
    /,
    *,
    output: Annotated[str, Parameter(metavar="FILE.yaml")],
    overwrite: options.Overwrite = False,
) -> None:
    """Write an arm file that describes a model file.

    It contains everything that is derived from the model file, so that you can change it. Commands also accept the
    model file itself as --arm.

    Args:
        model_file: URDF, SDF, MJCF (.xml), or Drake's model directives (.dmd.yaml).
        output: Arm file to write.
    """
    from dvrk_drake.models.arm_files import derived_arm_file
    from dvrk_drake.models.files import atomic_write

    if not output.lower().endswith((".yaml", ".yml")):
        raise DvrkDrakeError(f"--output {output}: the name of an arm file ends in .yaml")
    support.check_output(output, overwrite=overwrite)
    text = derived_arm_file(model_file, Path(output).parent)
    with atomic_write(output) as stream:
        stream.write(text)
    support.print_written(output, f"use it as --arm {output}")


@options.app.command(group=options.MODEL)
def view(
    *,
    arm: options.Arm,
    instrument: options.Instrument = "",
    live: Annotated[bool, Parameter(show_default=False)] = False,
    lcm_url: options.LcmUrl = "",
    port: options.Port = None,
) -> None:
    """Show an arm in a web browser.

    The controls are under Open Controls. Sliders set the joint positions, and the linkage stays closed. Buttons move
    the camera. Sliders from 0 to 1 show frames and gravity efforts, and select degrees.

    Args:
        live: Show the measured pose and efforts from the LCM messages of the arm, the commanded pose as a ghost, and
            the external force if it is published (--publish-force of control and bridge).
    """
    from dvrk_drake.processes.live_view import LiveForce, show_status
    from dvrk_drake.systems.arm_view.arm_view import ArmView
    from dvrk_drake.systems.lcm.arm_link import LcmArmLink
    from dvrk_drake.systems.lcm.messages import usable_lcm_url

    if lcm_url and not live:
        raise DvrkDrakeError("--lcm-url requires --live")
    shown = dvrk.load_arm(arm, instrument)
    url = usable_lcm_url(lcm_url) if live else ""
    meshcat = dvrk.start_meshcat(shown, port=port)
    arm_view = ArmView(shown, meshcat)
    arm_view.add_view_buttons()
    ending = "press Stop, Escape or Ctrl-C to end"
    if live:
        link, force = LcmArmLink(shown, url, replays=True), LiveForce(shown, url)
        print(f"{shown.name} live at {meshcat.web_url()}; {ending}", flush=True)
        support.until_stopped(meshcat, lambda: show_status(arm_view, link, force))
        return
    arm_view.add_sliders()
    print(f"{shown.name} at {meshcat.web_url()}; the controls are under Open Controls; {ending}", flush=True)
    support.until_stopped(meshcat, arm_view.follow_controls)


_RESULTS = ResultsAndJson()
_SOURCE = options.one_of("Source (one is required)")
_GRAVITY_COMPENSATION = Group("Options for --dvrk-gc (--gc-tolerance: also for --dvrk-kinematic-gc)")
SourceArm = Annotated[
    options.Arm | None, Parameter(group=_SOURCE, help="Use the nominal model of this arm, with the masses of the SDF.")
]
SourceModel = Annotated[options.Model | None, Parameter(group=_SOURCE)]
PerJoint = Annotated[
    tuple[float, float, float, float, float, float, float] | None,
    Parameter(metavar="J1 .. J7", group=_GRAVITY_COMPENSATION),
]


@options.export.default
def export_model(
    *,
    model: SourceModel = None,
    arm: SourceArm = None,
    instrument: options.Instrument = "",
    sdf: Annotated[str | None, Parameter(metavar="FILE.sdf")] = None,
    urdf: Annotated[str | None, Parameter(metavar="FILE.urdf")] = None,
    mjcf: Annotated[str | None, Parameter(metavar="FILE.xml")] = None,
    dvrk_gc: Annotated[str | None, Parameter(metavar="FILE.json")] = None,
    dvrk_kinematic_gc: Annotated[str | None, Parameter(metavar="FILE.json")] = None,
    configuration: Annotated[str | None, Parameter(metavar="ARM.json")] = None,
    meshes: Literal["gltf", "obj"] = "gltf",
    overwrite: options.Overwrite = False,
    verbose: options.Verbose = False,
    gc_tolerance: Annotated[float | None, Parameter(metavar="NM", group=_GRAVITY_COMPENSATION)] = None,
    friction: Annotated[bool, Parameter(show_default=False, group=_GRAVITY_COMPENSATION)] = False,
    coulomb: PerJoint = None,
    friction_ratio: PerJoint = None,
    dead_band: PerJoint = None,
    saturation: PerJoint = None,
) -> None:
    """Export a model as SDF, URDF or file of the dVRK.

    One call can write several files. Export an identified model, because the masses in the SDF are only estimates.

    Args:
        sdf: SDF file to write, with the inertias of the model. The meshes are copied to a folder next to the file.
        urdf: URDF file to write, with the inertias of the model. Joints of the linkage become mimic joints.
        mjcf: MJCF file of MuJoCo to write, with the inertias, friction, springs and linkage of the model.
        dvrk_gc: Gravity-compensation file to write for an MTM, in the format of the dVRK controller.
        dvrk_kinematic_gc: Gravity-compensation file to write for a PSM, in the format of the dVRK controller.
        configuration: Configuration of the PSM in the dVRK, whose mounting_pitch is checked. Default: the JSON file
            beside --dvrk-kinematic-gc that names this file under kinematic_gc.
        meshes: Format of the meshes of the SDF and URDF. PyBullet and MuJoCo require obj.
        gc_tolerance: Largest accepted torque difference between the file and the model [N m; N]. Default: the dry
            friction of each joint, which holds a joint at rest despite such a difference.
        friction: Also compensate the dry friction of the model. The model must be identified from a motion. SDF and
            URDF: add the friction of the joints, for other programs than Drake.
        coulomb: Also compensate Coulomb friction with these values, one per joint [N m]. Not allowed with --friction.
        friction_ratio: Share of the friction of each joint to compensate, 0 to 1. Default: 0.8 0.8 0.8 0.4 0.6 0.6 0.
        dead_band: Speed below which no friction is compensated [rad/s]. Default: 0.02 0.02 0.02 0.01 0.008 0.008 0.01.
        saturation: Speed above which the full --friction-ratio applies [rad/s]. Default: 0.4 0.2 0.2 0.4 0.4 0.2 0.4.
    """
    from dvrk_drake.export.model_export import MODEL_FORMATS, configuration_beside, prepare_export
    from dvrk_drake.export.model_writer import mesh_folder, refuse_existing_meshes
    from dvrk_drake.reports.export import export_page

    requested: dict[Format, str | None] = {
        "sdf": sdf,
        "urdf": urdf,
        "mjcf": mjcf,
        "dvrk-gc": dvrk_gc,
        "dvrk-kinematic-gc": dvrk_kinematic_gc,
    }
    outputs = {format: path for format, path in requested.items() if path is not None}
    if not outputs:
        raise DvrkDrakeError(f"no output is given; use {', '.join('--' + format for format in requested)}")
    if friction and coulomb is not None:
        raise DvrkDrakeError("--friction and --coulomb exclude each other; give one of them")
    if configuration is not None and dvrk_kinematic_gc is None:
        raise DvrkDrakeError("--configuration requires --dvrk-kinematic-gc; only the file of a PSM uses mounting_pitch")
    if instrument and arm is None:
        raise DvrkDrakeError("--instrument requires --arm; a model contains its instrument")
    arm = options.with_instrument(arm, instrument) if arm else None
    loaded = support.load_model(model, arm)
    for format, path in outputs.items():
        suffix = {"sdf": ".sdf", "urdf": ".urdf", "mjcf": ".xml"}.get(format, "")  # --arm recognises models by it
        support.check_output(path, model or "", configuration or "", overwrite=overwrite, suffix=suffix)
        if format in MODEL_FORMATS:
            refuse_existing_meshes(path, overwrite)
    settings: dict[str, Any] = {
        "tolerance": gc_tolerance,
        "friction": friction if coulomb is None else coulomb,
        "friction_ratio": friction_ratio,
        "dead_band": dead_band,
        "saturation": saturation,
        "meshes": meshes,
        "configuration": configuration or (configuration_beside(dvrk_kinematic_gc) if dvrk_kinematic_gc else None),
    }
    # All files are computed before the first file is written, so that an error leaves no partial output.
    origin = model or arm or ""
    with support.Steps(f"exporting {loaded.arm.name}"):
        exports = {format: prepare_export(loaded, format, origin=origin, **settings) for format in outputs}
    for format, path in outputs.items():
        exports[format].write(path)
    for format, path in outputs.items():
        if format != "urdf" or "sdf" not in outputs:  # both formats contain the same model
            support.show_page(export_page(path, exports[format]), verbose=verbose)
    for format, path in outputs.items():
        support.print_written(path)
        if format in MODEL_FORMATS and Path(path).with_name(mesh_folder(Path(path))).is_dir():
            support.print_written(Path(path).with_name(mesh_folder(Path(path))), "meshes")
    if tilt := loaded.provenance.base_tilt:
        what = f"the base of the recorded arm seems to be tilted, but the model assumes that it is not ({tilt})"
        advice = "Identify again with --gravity before you use an exported file."
        support.print_warning(f"{origin}: {what}. {advice}")


@options.export.command(name="compare")
def compare(
    file: str,
    /,
    *,
    model: SourceModel = None,
    arm: SourceArm = None,
    results: ResultsAndJson = _RESULTS,
) -> None:
    """Compare a gravity-compensation file of the dVRK with a model.

    The comparison covers random static poses over the full range of all joints.

    Args:
        file: Gravity-compensation file (gc-*.json) of the dVRK controller.
    """
    from dvrk_drake.export.dvrk_mtm_gravity_compensation import compare_compensation
    from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
    from dvrk_drake.reports.export import compensation_page

    results.check(file, model)
    installed = GravityCompensationFile.load(file)
    loaded, origin = support.load_model(model, arm), model or arm or ""
    try:
        with support.Steps(f"comparing with {origin}"):
            comparison = compare_compensation(installed, loaded)
    except ModelError as error:
        raise ModelError(f"{file}: {error}") from error
    page = compensation_page(comparison, file_name=file, model_name=origin)
    for warning in comparison.warnings:
        support.print_warning(f"{file}: {warning}")
    results.show(page, file, model, content=comparison.as_dict())
