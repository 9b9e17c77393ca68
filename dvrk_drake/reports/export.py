"""Exported files, and the dVRK's installed gravity compensation beside a model's, as text in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import ModelBodies
from dvrk_drake.export.dvrk_mtm_gravity_compensation import MTM_JOINTS, largest_differences
from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import CompensationComparison
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.export.dvrk_psm_gravity_compensation import ARM_JOINTS, NAMES, KinematicCompensation
from dvrk_drake.export.model_export import ModelExport
from dvrk_drake.export.sdf import LinkChange, changed_links
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.terminal_tables import make_table, print_answer, print_note


def print_export(console: Console, path: str, export: ModelExport, *, verbose: bool = False) -> None:
    """Prints what a written file has of a model, and what it cannot state.

    Args:
        console: to print to.
        path: of the file.
        export: what was written.
        verbose: also print all numbers of the file.
    """
    arm = export.model.arm
    if export.bodies is not None:
        _print_bodies(console, arm, export, export.bodies, verbose)
    elif isinstance(export.compensation, KinematicCompensation):
        _print_kinematic_compensation(console, export, export.compensation, verbose)
    else:
        written = GravityCompensationFile.load(path)
        _print_compensation(console, path, export, written, verbose)


def _source(model: IdentifiedModel, origin: str) -> str:
    """Returns the option that names a model: --arm if it is what the arm's SDF states."""
    return f"--{'arm' if origin == model.arm.source else 'model'} {origin}"


def _next_step(model: IdentifiedModel, origin: str) -> str:
    if origin == model.arm.source:  # whose masses are estimates
        return f"dvrk-drake identify RECORDING.csv --arm {origin} --output MODEL.yaml"
    return f"dvrk-drake export --model {origin} --dvrk-gc NEW.json"


def _print_bodies(console: Console, arm: Arm, export: ModelExport, bodies: ModelBodies, verbose: bool) -> None:
    changes = changed_links(arm, bodies.links)
    answer = f"The {export.format.upper()} states the inertias of the arm's own SDF."
    if changes:
        before, after = (sum(getattr(c, which).parameters[0] for c in changes) for which in ("before", "after"))
        answer = f"{len(changes)} links differ from the arm's own SDF, their total mass by {after - before:+.4f} kg."
    print_answer(console, answer, f"dvrk-drake export {_source(export.model, export.origin)} --diff")
    if changes:
        console.print(_mass_table(changes))
    if changes and verbose:
        console.print(_inertia_table(changes))
        print_note(console, "Principal moments about the centre of mass.")
    if bodies.rotors:
        rotors = ", ".join(f"{name} {inertia:.3g}" for name, inertia in bodies.rotors.items())
        console.print(f"Inertia that motors add to joints [kg m^2; kg if prismatic]: {rotors}", markup=False)
    for remark in bodies.left_out:
        console.print(f"Left out: {remark}", markup=False)


def _mass_table(changes: Sequence[LinkChange]) -> Table:
    """Mass and centre of mass of every changed link; the latter in the link's frame."""
    columns = ("mass, SDF [kg]", "mass [kg]", "centre of mass, SDF [mm]", "centre of mass [mm]")
    table = make_table("Links in the arm's SDF and as exported", "", *columns)
    for change in changes:
        bodies = [inertia.to_spatial_inertia() for inertia in (change.before, change.after)]
        masses = [f"{body.get_mass():.4f}" for body in bodies]
        table.add_row(change.link, *masses, *(_place(body.get_com()) for body in bodies))
    return table


def _inertia_table(changes: Sequence[LinkChange]) -> Table:
    title = "Principal moments of inertia [kg cm^2]"
    table = make_table(title, "", "arm's SDF", "exported")
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
    """Prints how far a written file differs from its model, and at which torques it clips."""
    arm, off = export.model.arm, largest_differences(file, export.model)
    j = int(np.argmax(off))
    print_answer(
        console,
        f"The file differs from the model by at most {off[j]:.1e} N m ({MTM_JOINTS[j]}), at rest.",
        f"dvrk-drake compare-gc {path} {_source(export.model, export.origin)}",
    )
    table = make_table("Torques [N m]", "", "largest difference*", "clip", "dry friction")
    friction = np.append((file.positive - file.negative)[10::5] / 2, 0.0)
    for j, name in enumerate(MTM_JOINTS):
        clip = f"{file.torque_lower[j]:+.4f}..{file.torque_upper[j]:+.4f}"
        table.add_row(name, f"{off[j]:.1e}", clip, f"{friction[j]:.4f}")
    console.print(table)
    print_note(console, "* at 4000 random poses of the joint box")
    if verbose:
        table = make_table("Friction compensation", "", "ratio", "dead band [rad/s]", "saturation [rad/s]")
        for j, name in enumerate(MTM_JOINTS):
            table.add_row(name, *(f"{x[j]:g}" for x in (file.friction_ratio, file.dead_band, file.saturation)))
        console.print(table)
        console.print()
    largest = np.maximum(np.abs(file.torque_lower), np.abs(file.torque_upper))
    if short := [name for name, at_limit in zip(MTM_JOINTS, largest >= arm.effort_limits, strict=True) if at_limit]:
        console.print(f"Clipped at the motor's limit somewhere in the joint box: {', '.join(short)}")
    console.print('Name the file as "gravity_compensation" in the JSON file of the arm.')


def _print_kinematic_compensation(
    console: Console, export: ModelExport, file: KinematicCompensation, verbose: bool
) -> None:
    """Largest differences from the model; the chain's links."""
    j = int(np.argmax(file.error / export.model.arm.effort_limits[: len(ARM_JOINTS)]))
    units = ("N m", "N m", "N")
    print_answer(
        console,
        f"The file differs from the model by at most {file.error[j]:.1e} {units[j]} ({ARM_JOINTS[j]}), at rest.",
        "name the file in the JSON file of the arm",
    )
    table = make_table("Largest difference from the model", "", "instrument straight", "more with the wrist bent", "")
    for name, error, wrist, unit in zip(ARM_JOINTS, file.error, file.wrist, units, strict=True):
        table.add_row(name, f"{error:.1e}", f"{wrist:.1e}", unit)
    console.print(table)
    if verbose:
        console.print()
        table = make_table("Links of the chain, centre of mass in the DH frame", "", "mass [kg]", "x, y, z [mm]")
        for name, mass, centre in zip(NAMES, file.mass, file.center, strict=True):
            table.add_row(name, f"{mass:.4f}", " ".join(f"{1e3 * x:+8.2f}" for x in centre))
        console.print(table)


def print_comparison(
    console: Console, file_name: str, model_name: str, comparison: CompensationComparison, *, verbose: bool = False
) -> None:
    """Prints the largest difference between a file and a model, then how they differ at each joint.

    Args:
        console: to print to.
        file_name, model_name: what was compared.
        comparison: to print.
        verbose: also print the ranges of the torques.
    """
    joints = comparison.joints
    difference = np.abs(comparison.clipped_torque - comparison.model_torque).max(axis=0)
    j = int(np.argmax(difference))
    faults = comparison.clipped | comparison.runaway | comparison.opposed
    wrong = 100 * faults[:, : len(MTM_JOINTS) - 1].any(axis=1).mean()
    print_answer(
        console,
        f"Largest difference between file and model: {difference[j]:.3f} N m ({joints[j].name}). At {wrong:.0f} % of "
        f"the poses a joint is at its clip, runs away or opposes the model.",
        _next_step(comparison.model, model_name),
        "yellow" if wrong else "green",
    )
    table = make_table(
        f"File less model [N m] at {len(comparison.q)} poses of the joint box, at rest",
        *("", "largest", "RMS, in sweep", "RMS, outside", "at its clip", "runaway", "opposed"),
    )
    for joint, largest in zip(joints, difference, strict=True):
        shares = (f"{100 * x:.0f} %" if x else "" for x in (joint.clipped, joint.runaway, joint.opposed))
        table.add_row(joint.name, f"{largest:.3f}", _number(joint.rms_inside), _number(joint.rms_outside), *shares)
    console.print(table)
    console.print()
    if not verbose:
        return
    print_note(
        console,
        f"Sweep: from which the file says that its data are ({_sweep(comparison)}). At its clip: share of the poses at "
        "which the file's torque is its limit. Runaway: the file's torque before the clip is outside the model's range "
        "by more than half of it. Opposed: file and model have opposite signs, both above a tenth of the model's "
        "largest torque.",
    )
    table = make_table(f"Ranges [N m] of {file_name}, {model_name}", "", "model", "file before its clip", "clip")
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
        return "it states none"
    return f"{100 * comparison.in_sweep.mean():.0f} % of the joint box"


def _range(lower: float, upper: float) -> str:
    return "..".join(f"{round(x, 3) + 0.0:+.3f}" for x in (lower, upper))


def _number(x: float) -> str:
    return "-" if np.isnan(x) else f"{x:.3f}"
