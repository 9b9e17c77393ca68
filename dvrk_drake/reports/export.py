"""Pages of exported models, and of comparisons of gravity-compensation files of the dVRK with models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import ModelBodies
from dvrk_drake.export.dvrk_mtm_gravity_compensation import POSES, CompensationComparison, compensation_loss
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import MTM_JOINTS, GravityCompensationFile
from dvrk_drake.export.dvrk_psm_gravity_compensation import ARM_JOINTS, NAMES, KinematicCompensation
from dvrk_drake.export.gravity_compensation_loss import ROUNDING, CompensationLoss
from dvrk_drake.export.model_export import DriveApproximation, ModelExport
from dvrk_drake.export.model_writer import LinkChange, changed_links
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.colours import FITTED, LIMIT, NEUTRAL, REFERENCE
from dvrk_drake.reports.page import Block, Page, Plot, Section, Table, Text
from dvrk_drake.reports.plot import Band, Curve, Guide, Mark, Panel, Style

#: Number of bins over the position of a joint.
_BINS = 60


def export_page(path: str, export: ModelExport) -> Page:
    """Returns the content of an exported file, and the effects of the model that the file cannot represent.

    Args:
        path: Path of the file.
        export: Exported model.
    """
    if export.bodies is not None:
        return _bodies_page(path, export, export.bodies)
    if isinstance(export.compensation, KinematicCompensation):
        return _kinematic_compensation_page(path, export, export.compensation)
    return _compensation_page(path, export, GravityCompensationFile.load(path))


def _source(model: IdentifiedModel, origin: str) -> str:
    """Returns the option that selects the model: --arm for the nominal model, otherwise --model."""
    return f"--{'arm' if origin == model.arm.source else 'model'} {origin}"


def _next_step(model: IdentifiedModel, origin: str) -> str:
    if origin == model.arm.source:  # the masses of a nominal model are estimates
        return f"dvrk-drake identify RECORDING.csv --arm {origin} --output MODEL.yaml"
    return f"dvrk-drake export --model {origin} --dvrk-gc NEW.json"


def _bodies_page(path: str, export: ModelExport, bodies: ModelBodies) -> Page:
    changes = changed_links(export.model.arm, bodies.links)
    answer = f"The {export.format.upper()} has the same inertias as the SDF of the arm."
    blocks: list[Block] = []
    if changes:
        before, after = (sum(getattr(c, which).parameters[0] for c in changes) for which in ("before", "after"))
        answer = f"{len(changes)} links differ from the SDF of the arm. Their mass changes by {after - before:+.4f} kg."
        blocks = [_mass_table(changes)]
    if bodies.rotors:
        rotors = ", ".join(f"{name} {inertia:.3g}" for name, inertia in bodies.rotors.items())
        blocks.append(Text(f"Reflected rotor inertias [kg m^2; kg if prismatic]: {rotors}"))
    blocks += [Text(f"Not exported: {remark}") for remark in export.left_out]
    if export.drives is not None:
        blocks.append(_drive_table(export.model.arm, export.drives))
        blocks.append(Text("Not exported: presliding friction, i.e. the elastic travel before a joint slides"))
    # A file with friction cannot be used as an arm.
    command = f"dvrk-drake view --arm {path}" if export.drives is None else ""
    return Page(f"Exported model {path}", answer, [Section("Links", blocks)], "good", command)


def _drive_table(arm: Arm, drives: DriveApproximation) -> Table:
    """Returns a table with the effort of the drive effects on each joint, and the part that the file omits."""
    rows = [
        (name, f"{effort:.3g}", f"{difference:.2g}", f"{difference / effort:.0%}" if effort > 0 else "-")
        for name, effort, difference in zip(arm.joint_names, drives.effort, drives.difference, strict=True)
    ]
    header = ("", "drive effects", "not exported", "share")
    caption = "RMS effort of friction, cables and springs during a motion [N m; N if prismatic]"
    return Table(header, rows, caption)


def _mass_table(changes: Sequence[LinkChange]) -> Table:
    """Returns a table with the mass and the centre of mass of each changed link."""
    rows = []
    for change in changes:
        bodies = [inertia.to_spatial_inertia() for inertia in (change.before, change.after)]
        masses = [f"{body.get_mass():.4f}" for body in bodies]
        rows.append((change.link, *masses, *(_place(body.get_com()) for body in bodies)))
    header = ("", "mass, SDF [kg]", "mass [kg]", "centre of mass, SDF [mm]", "centre of mass [mm]")
    caption = "Links in the SDF of the arm and in the exported file, in link frames"
    return Table(header, rows, caption)


def _place(place: NDArray[np.float64]) -> str:
    return " ".join(f"{1e3 * x:+.1f}" for x in place)


def _compensation_page(path: str, export: ModelExport, file: GravityCompensationFile) -> Page:
    """Returns the largest differences between a written file and its model, and the torque limits of the file."""
    arm, loss = export.model.arm, compensation_loss(file, export.model)
    friction = np.append((file.positive - file.negative)[10::5] / 2, 0.0)
    rows, settings = [], []
    for j, name in enumerate(MTM_JOINTS):
        limits = f"{file.torque_lower[j]:+.4f}..{file.torque_upper[j]:+.4f}"
        rows.append((name, *_loss_cells(loss, j), limits, f"{friction[j]:.4f}"))
        settings.append((name, *(f"{x[j]:g}" for x in (file.friction_ratio, file.dead_band, file.saturation))))
    note = (
        f"* largest difference between file and model at {POSES} random poses over the joint range, also in % of the "
        "effort limit. Friction: dry friction that the file compensates during a motion."
    )
    header = ("", "difference*", "% of limit", "torque limits", "friction")
    settings_header = ("", "ratio", "dead band [rad/s]", "saturation [rad/s]")
    blocks: list[Block] = [
        Table(header, rows, "Torques at rest [N m]", note),
        *_causes(loss),
        Table(settings_header, settings, "Friction compensation", show="details"),
        *_disabled_joints(export.model, MTM_JOINTS),
    ]
    largest = np.maximum(np.abs(file.torque_lower), np.abs(file.torque_upper))
    if short := [name for name, at_limit in zip(MTM_JOINTS, largest >= arm.effort_limits, strict=True) if at_limit]:
        blocks.append(Text(f"Joints whose torque limit equals the effort limit of the arm: {', '.join(short)}."))
    name = Path(path).name
    blocks += _estimates(export)
    blocks.append(Text(f'Install: enter "gravity_compensation": "{name}" in the JSON file of the arm.', unwrapped=True))
    usual = f"gc-{arm.name}-"
    if not name.startswith(usual):
        blocks.append(Text(f"The usual name of the file is {usual}<serial number>.json."))
    command = f"dvrk-drake export compare {path} {_source(export.model, export.origin)}"
    return Page(f"Exported file {path}", _loss_text(loss), [Section("Torques", blocks)], "good", command)


def _kinematic_compensation_page(path: str, export: ModelExport, file: KinematicCompensation) -> Page:
    """Returns the largest differences from the model, and the links of the kinematic chain in the file."""
    entries = f'"kinematic_gc": "{Path(path).name}", "mounting_pitch": {file.mounting_pitch:.6g}'
    where = "the arm's JSON" if export.configuration is None else f"{export.configuration}"
    blocks: list[Block] = []
    if file.configured_pitch is not None:
        what = f"mounting_pitch of {export.configuration}, {file.configured_pitch:.6g} rad (0 if it is not stated)"
        blocks.append(Text(f"Compared with the {what}. The model requires {file.mounting_pitch:.6g}."))
    locked = export.model.arm.locked_text
    columns = (f"with {locked}",) if locked else ("straight instrument", "change by a bent wrist")
    rows = [
        (name, file.loss.units[j], *_loss_cells(file.loss, j), *([] if locked else [f"{wrist:.2g}"]))
        for j, (name, wrist) in enumerate(zip(ARM_JOINTS, file.wrist, strict=True))
    ]
    header = ("", "", columns[0], "%", *columns[1:])
    caption = "Largest difference from the model at rest, also in % of the effort limit"
    note = "The torque for other positions of the instrument is not identified." if locked else ""
    links = [
        (name, f"{mass:.4f}", " ".join(f"{1e3 * x:+8.2f}" for x in centre))
        for name, mass, centre in zip(NAMES, file.mass, file.center, strict=True)
    ]
    chain = "Links of the chain, centre of mass in the DH frame"
    blocks += [
        Table(header, rows, caption, note),
        *_causes(file.loss),
        Table(("", "mass [kg]", "x, y, z [mm]"), links, chain, show="details"),
        *_disabled_joints(export.model, ARM_JOINTS),
        *_estimates(export),
    ]
    next_step = f"enter {entries} in {where}"
    return Page(f"Exported file {path}", _loss_text(file.loss), [Section("Torques", blocks)], "good", next_step)


def _disabled_joints(model: IdentifiedModel, names: Sequence[str]) -> list[Block]:
    """Returns a text that names the joints of the file whose feedforward is disabled."""
    off = [joint.name for joint in model.joints if joint.name in names and joint.feedforward_scale == 0]
    return [Text(f"The file applies no torque because the feedforward scale is 0: {', '.join(off)}.")] if off else []


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


def _causes(loss: CompensationLoss) -> list[Block]:
    """Returns the cause of the difference on each joint, and the pose of the largest difference."""
    blocks: list[Block] = []
    for cause in dict.fromkeys(filter(None, loss.causes)):
        joints = ", ".join(name for name, own in zip(loss.joints, loss.causes, strict=True) if own == cause)
        blocks.append(Text(f"Cause ({joints}): {cause}."))
    if blocks:
        pose = " ".join(f"{x:.2f}" for x in loss.poses[loss.worst])
        blocks.append(Text(f"Pose of the largest difference ({loss.joints[loss.worst]}) [rad; m]: {pose}."))
    return blocks


def _estimates(export: ModelExport) -> list[Block]:
    if export.model.provenance.method != "nominal":
        return []
    return [Text("The masses of the SDF are estimates. Identify your arm before you install a file.")]


def compensation_page(comparison: CompensationComparison, *, file_name: str = "", model_name: str = "") -> Page:
    """Returns the differences between a gravity-compensation file and a model.

    Args:
        comparison: Comparison of the file with the model.
        file_name: Path of the file. "": name of the arm in the file.
        model_name: Path of the model, or name of the arm of a nominal model. "": source of the arm of the model.
    """
    file_name = file_name or f"file of {comparison.file.arm_name}"
    model_name = model_name or comparison.model.arm.source
    difference = np.abs(comparison.clipped_torque - comparison.model_torque).max(axis=0)
    j = int(np.argmax(difference))
    faults = comparison.clipped | comparison.runaway | comparison.opposed
    marked = 100 * faults[:, : len(MTM_JOINTS) - 1].any(axis=1).mean()
    in_sweep, outside = (comparison.rms_difference(x) for x in (comparison.in_sweep, ~comparison.in_sweep))
    limits = np.array([comparison.file.torque_lower, comparison.file.torque_upper])
    rows, ranges = [], []
    for i, name in enumerate(MTM_JOINTS):
        masks = (comparison.clipped, comparison.runaway, comparison.opposed)
        shares = (f"{100 * mask[:, i].mean():.0f} %" if mask[:, i].any() else "" for mask in masks)
        rows.append((name, f"{difference[i]:.3f}", _number(in_sweep[i]), _number(outside[i]), *shares))
        ranges.append((name, *(_range(x[:, i]) for x in (comparison.model_torque, comparison.file_torque, limits))))
    sweep = "the file does not state it"
    if comparison.file.sweep is not None:
        sweep = f"it contains {100 * comparison.in_sweep.mean():.0f} % of the poses"
    note = (
        f"Sweep: joint positions of the recording from which the file was computed; {sweep}. docs/export.md defines "
        "the last three columns, which are shares of the poses."
    )
    header = ("", "largest", "RMS, in sweep", "RMS, outside", "at limit", "runaway", "opposed")
    caption = f"Torque of the file minus model [N m], {len(comparison.q)} random static poses"
    of_ranges = f"Torque ranges [N m] of {file_name}, {model_name}"
    blocks: list[Block] = [
        *(Text(f"{file_name}: {warning}.", "warning", show="page") for warning in comparison.warnings),
        Table(header, rows, caption, note),
        Table(("", "model", "file before limits", "limits"), ranges, of_ranges, show="details"),
    ]
    return Page(
        f"{Path(file_name).name} compared with {model_name}",
        f"Largest difference between file and model: {difference[j]:.3f} N m ({MTM_JOINTS[j]}). Poses with a torque "
        f"at limit, runaway or opposed: {marked:.3g} %.",
        [Section("Differences per joint", blocks), Section("Torque over position", [_compensation_plot(comparison)])],
        "warning" if marked else "good",
        _next_step(comparison.model, model_name),
    )


def _compensation_plot(comparison: CompensationComparison) -> Plot:
    """Returns the torques of the file and of the model over the position of each joint."""
    # The file has no torque for the last joint.
    panels = [_torque_panel(comparison, name, j) for j, name in enumerate(MTM_JOINTS[:-1])]
    caption = "Static torque: mean (line) and range (band) over the positions of the other joints"
    return Plot("compensation", caption, panels, columns=2)


def _torque_panel(comparison: CompensationComparison, name: str, j: int) -> Panel:
    q = comparison.q[:, j]
    edges = np.linspace(q.min(), q.max(), _BINS + 1)
    index = np.clip(np.digitize(q, edges) - 1, 0, _BINS - 1)
    filled = np.unique(index)
    centres, members = (edges[:-1] + edges[1:])[filled] / 2, [index == i for i in filled]
    marks: list[Mark] = []
    if comparison.file.sweep is not None:
        low, high = np.clip(comparison.file.sweep[:, j], edges[0], edges[-1])
        marks.append(Guide("x", low, high, NEUTRAL, "positions in the recording of the file"))
    torques: tuple[tuple[NDArray[np.float64], str, str, Style], ...] = (
        (comparison.file_torque, REFERENCE, "file, without torque limits", "line"),
        (comparison.model_torque, FITTED, "model", "dashed"),
    )
    for torque, colour, label, style in torques:
        low, middle, high = (np.array([f(torque[m, j]) for m in members]) for f in (np.min, np.mean, np.max))
        marks += [Band("", centres, low, high, colour), Curve(label, centres, middle, colour, style)]
    for limit in (comparison.file.torque_lower[j], comparison.file.torque_upper[j]):
        marks.append(Guide("y", limit, None, LIMIT, "torque limits of the file"))
    return Panel(f"J{j + 1} {name}", marks, f"q{j + 1} [rad]", "torque [N m]", height=210)


def _range(values: NDArray[np.float64]) -> str:
    return "..".join(f"{round(float(x), 3) + 0.0:+.3f}" for x in (values.min(), values.max()))


def _number(x: float) -> str:
    return "-" if np.isnan(x) else f"{x:.3f}"
