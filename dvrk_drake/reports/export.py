"""Prints exported models, and comparisons of gravity-compensation files of the dVRK with models, to a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import ModelBodies
from dvrk_drake.export.dvrk_mtm_controller import MTM_JOINTS
from dvrk_drake.export.dvrk_mtm_gravity_compensation import POSES, compensation_loss
from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import CompensationComparison
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.export.dvrk_psm_gravity_compensation import ARM_JOINTS, NAMES, KinematicCompensation
from dvrk_drake.export.gravity_compensation_loss import ROUNDING, CompensationLoss
from dvrk_drake.export.model_export import ModelExport
from dvrk_drake.export.sdf import LinkChange, changed_links
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note


def print_export(console: Console, path: str, export: ModelExport, *, verbose: bool = False) -> None:
    """Prints the content of an exported file, and the effects of the model that the file cannot represent.

    Args:
        console: Console to print to.
        path: Path of the file.
        export: Exported model.
        verbose: Whether to print all numbers of the file.
    """
    arm = export.model.arm
    if export.bodies is not None:
        _print_bodies(console, arm, export, export.bodies, verbose)
    elif isinstance(export.compensation, KinematicCompensation):
        _print_kinematic_compensation(console, path, export, export.compensation, verbose)
    else:
        written = GravityCompensationFile.load(path)
        _print_compensation(console, path, export, written, verbose)


def _source(model: IdentifiedModel, origin: str) -> str:
    """Returns the option that selects the model: --arm for the nominal model, otherwise --model."""
    return f"--{'arm' if origin == model.arm.source else 'model'} {origin}"


def _next_step(model: IdentifiedModel, origin: str) -> str:
    if origin == model.arm.source:  # the masses of a nominal model are estimates
        return f"dvrk-drake identify RECORDING.csv --arm {origin} --output MODEL.yaml"
    return f"dvrk-drake export --model {origin} --dvrk-gc NEW.json"


def _print_bodies(console: Console, arm: Arm, export: ModelExport, bodies: ModelBodies, verbose: bool) -> None:
    changes = changed_links(arm, bodies.links)
    answer = f"The {export.format.upper()} has the same inertias as the SDF of the arm."
    if changes:
        before, after = (sum(getattr(c, which).parameters[0] for c in changes) for which in ("before", "after"))
        answer = f"{len(changes)} links differ from the SDF of the arm. Their mass changes by {after - before:+.4f} kg."
    print_answer(console, answer, f"dvrk-drake export {_source(export.model, export.origin)} --diff")
    if changes:
        console.print(_mass_table(changes))
    if changes and verbose:
        console.print(_inertia_table(changes))
        console.print()
    if bodies.rotors:
        rotors = ", ".join(f"{name} {inertia:.3g}" for name, inertia in bodies.rotors.items())
        console.print(f"Reflected rotor inertias [kg m^2; kg if prismatic]: {rotors}", markup=False)
    for remark in bodies.left_out:
        console.print(f"Not exported: {remark}", markup=False)


def _mass_table(changes: Sequence[LinkChange]) -> Table:
    """Returns a table with the mass and the centre of mass of each changed link."""
    columns = ("mass, SDF [kg]", "mass [kg]", "centre of mass, SDF [mm]", "centre of mass [mm]")
    table = make_table("Links in the SDF of the arm and in the exported file, in link frames", "", *columns)
    for change in changes:
        bodies = [inertia.to_spatial_inertia() for inertia in (change.before, change.after)]
        masses = [f"{body.get_mass():.4f}" for body in bodies]
        table.add_row(change.link, *masses, *(_place(body.get_com()) for body in bodies))
    return table


def _inertia_table(changes: Sequence[LinkChange]) -> Table:
    title = "Principal moments of inertia about the centre of mass [kg cm^2]"
    table = make_table(title, "", "SDF of the arm", "exported")
    for change in changes:
        cells = []
        for inertia in (change.before, change.after):
            body = inertia.to_spatial_inertia()
            about_centre = body.Shift(body.get_com()).CalcRotationalInertia()
            moments = about_centre.CalcPrincipalMomentsAndAxesOfInertia()[0]
            cells.append(" ".join(f"{1e4 * x:9.4f}" for x in moments))
        table.add_row(change.link, *cells)
    return table


def _place(place: NDArray[np.float64]) -> str:
    return " ".join(f"{1e3 * x:+.1f}" for x in place)


def _print_compensation(
    console: Console, path: str, export: ModelExport, file: GravityCompensationFile, verbose: bool
) -> None:
    """Prints the largest differences between a written file and its model, and the torque limits of the file."""
    arm, loss = export.model.arm, compensation_loss(file, export.model)
    next_step = f"dvrk-drake compare-gc {path} {_source(export.model, export.origin)}"
    print_answer(console, _loss_text(loss), next_step)
    table = make_table("Torques at rest [N m]", "", "difference*", "% of limit", "torque limits", "friction")
    friction = np.append((file.positive - file.negative)[10::5] / 2, 0.0)
    for j, name in enumerate(MTM_JOINTS):
        limits = f"{file.torque_lower[j]:+.4f}..{file.torque_upper[j]:+.4f}"
        table.add_row(name, *_loss_cells(loss, j), limits, f"{friction[j]:.4f}")
    console.print(table)
    print_note(
        console,
        f"* largest difference between file and model at {POSES} random poses over the joint range, also in % of the "
        "effort limit. Friction: dry friction that the file compensates during a motion.",
    )
    _print_causes(console, loss)
    if verbose:
        table = make_table("Friction compensation", "", "ratio", "dead band [rad/s]", "saturation [rad/s]")
        for j, name in enumerate(MTM_JOINTS):
            table.add_row(name, *(f"{x[j]:g}" for x in (file.friction_ratio, file.dead_band, file.saturation)))
        console.print(table)
        console.print()
    _print_disabled_joints(console, export.model, MTM_JOINTS)
    largest = np.maximum(np.abs(file.torque_lower), np.abs(file.torque_upper))
    if short := [name for name, at_limit in zip(MTM_JOINTS, largest >= arm.effort_limits, strict=True) if at_limit]:
        console.print(f"Joints whose torque limit equals the effort limit of the arm: {', '.join(short)}.")
    _print_estimates(console, export)
    name = Path(path).name
    console.print(f'Install: enter "gravity_compensation": "{name}" in the JSON file of the arm.', markup=False)
    usual = f"gc-{arm.name}-"
    if not name.startswith(usual):
        console.print(f"The usual name of the file is {usual}<serial number>.json.", markup=False)


def _print_kinematic_compensation(
    console: Console, path: str, export: ModelExport, file: KinematicCompensation, verbose: bool
) -> None:
    """Prints the largest differences from the model, and the links of the kinematic chain in the file."""
    entries = f'"kinematic_gc": "{Path(path).name}", "mounting_pitch": {file.mounting_pitch:.6g}'
    where = "the arm's JSON" if export.configuration is None else f"{export.configuration}"
    print_answer(console, _loss_text(file.loss), f"enter {entries} in {where}")
    if file.configured_pitch is not None:
        what = f"mounting_pitch of {export.configuration}, {file.configured_pitch:.6g} rad (0 if it is not stated)"
        console.print(f"Compared with the {what}. The model requires {file.mounting_pitch:.6g}.\n", markup=False)
    locked = export.model.arm.locked_text
    columns = (f"with {locked}",) if locked else ("straight instrument", "change by a bent wrist")
    title = "Largest difference from the model at rest, also in % of the effort limit"
    table = make_table(title, "", "", columns[0], "%", *columns[1:])
    for j, (name, wrist) in enumerate(zip(ARM_JOINTS, file.wrist, strict=True)):
        cells = _loss_cells(file.loss, j)
        table.add_row(name, file.loss.units[j], *cells, *([] if locked else [f"{wrist:.2g}"]))
    console.print(table)
    if locked:
        print_note(console, "The torque for other positions of the instrument is not identified.")
    else:
        console.print()
    _print_causes(console, file.loss)
    if verbose:
        table = make_table("Links of the chain, centre of mass in the DH frame", "", "mass [kg]", "x, y, z [mm]")
        for name, mass, centre in zip(NAMES, file.mass, file.center, strict=True):
            table.add_row(name, f"{mass:.4f}", " ".join(f"{1e3 * x:+8.2f}" for x in centre))
        console.print(table)
        console.print()
    _print_disabled_joints(console, export.model, ARM_JOINTS)
    _print_estimates(console, export)


def _print_disabled_joints(console: Console, model: IdentifiedModel, names: Sequence[str]) -> None:
    """Prints the joints of the file whose feedforward is disabled."""
    if off := [joint.name for joint in model.joints if joint.name in names and joint.feedforward_scale == 0]:
        console.print(f"The file applies no torque because the feedforward scale is 0: {', '.join(off)}.")


def _loss_text(loss: CompensationLoss) -> str:
    j = loss.worst
    if loss.difference.max() <= ROUNDING:
        return "The torques of the file and the model are equal at rest."
    return (
        f"The file differs from the model by at most {100 * loss.share[j]:.1f} % of the effort limit "
        f"({loss.joints[j]}, {loss.difference[j]:.2g} {loss.units[j]}), at rest."
    )


def _loss_cells(loss: CompensationLoss, j: int) -> tuple[str, str]:
    """Returns the largest difference on a joint and its share of the effort limit [%]."""
    if loss.difference[j] <= ROUNDING:
        return "0", "0"
    return f"{loss.difference[j]:.2g}", f"{100 * loss.share[j]:.2g}"


def _print_causes(console: Console, loss: CompensationLoss) -> None:
    """Prints the cause of the difference on each joint, and the pose of the largest difference."""
    for cause in dict.fromkeys(filter(None, loss.causes)):
        joints = ", ".join(name for name, own in zip(loss.joints, loss.causes, strict=True) if own == cause)
        console.print(f"Cause ({joints}): {cause}.", markup=False)
    if any(loss.causes):
        pose = " ".join(f"{x:.2f}" for x in loss.poses[loss.worst])
        console.print(f"Pose of the largest difference ({loss.joints[loss.worst]}) [rad; m]: {pose}.\n", markup=False)


def _print_estimates(console: Console, export: ModelExport) -> None:
    if export.model.provenance.method == "nominal":
        console.print("The masses of the SDF are estimates. Identify your arm before you install a file.")


def print_comparison(
    console: Console, file_name: str, model_name: str, comparison: CompensationComparison, *, verbose: bool = False
) -> None:
    """Prints the differences between a gravity-compensation file and a model.

    Args:
        console: Console to print to.
        file_name: Path of the file.
        model_name: Path of the model, or name of the arm of a nominal model.
        comparison: Comparison to print.
        verbose: Whether to print the definitions of the columns and the ranges of the torques.
    """
    joints = comparison.joints
    difference = np.abs(comparison.clipped_torque - comparison.model_torque).max(axis=0)
    j = int(np.argmax(difference))
    faults = comparison.clipped | comparison.runaway | comparison.opposed
    marked = 100 * faults[:, : len(MTM_JOINTS) - 1].any(axis=1).mean()
    print_answer(
        console,
        f"Largest difference between file and model: {difference[j]:.3f} N m ({joints[j].name}). Poses with a torque "
        f"at limit, runaway or opposed: {marked:.3g} %.",
        _next_step(comparison.model, model_name),
        "yellow" if marked else "green",
    )
    table = make_table(
        f"Torque of the file minus model [N m], {len(comparison.q)} random static poses",
        *("", "largest", "RMS, in sweep", "RMS, outside", "at limit", "runaway", "opposed"),
    )
    for joint, largest in zip(joints, difference, strict=True):
        shares = (f"{100 * x:.0f} %" if x else "" for x in (joint.clipped, joint.runaway, joint.opposed))
        table.add_row(joint.name, f"{largest:.3f}", _number(joint.rms_inside), _number(joint.rms_outside), *shares)
    console.print(table)
    if not verbose:
        print_note(console, "--verbose explains these columns.")
        return
    console.print()
    print_note(
        console,
        f"Sweep: joint positions of the recording from which the file was computed ({_sweep(comparison)}). At "
        "limit, runaway, opposed: shares of the poses. At limit: the torque of the file is at a torque limit. Runaway: "
        "without the torque limits, the torque of the file is outside the torque range of the model by more than half "
        "of the width of this range. Opposed: the torques of file and model have opposite signs, and both exceed a "
        "tenth of the largest torque of the model.",
    )
    table = make_table(f"Torque ranges [N m] of {file_name}, {model_name}", "", "model", "file before limits", "limits")
    for joint in joints:
        table.add_row(
            joint.name,
            _range(joint.model_lower, joint.model_upper),
            _range(joint.file_lower, joint.file_upper),
            _range(joint.clip_lower, joint.clip_upper),
        )
    console.print(table)


def _sweep(comparison: CompensationComparison) -> str:
    if comparison.file.sweep is None:
        return "not stated in the file"
    return f"contains {100 * comparison.in_sweep.mean():.0f} % of the poses"


def _range(lower: float, upper: float) -> str:
    return "..".join(f"{round(x, 3) + 0.0:+.3f}" for x in (lower, upper))


def _number(x: float) -> str:
    return "-" if np.isnan(x) else f"{x:.3f}"
