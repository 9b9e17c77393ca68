"""Exported files, and the dVRK's installed gravity compensation beside a model's: tables in a terminal and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dvrk_drake.dynamics.model_links import ModelBodies
from dvrk_drake.export.dvrk_mtm_gravity_compensation import MTM_JOINTS, largest_differences
from dvrk_drake.export.dvrk_mtm_gravity_compensation_comparison import CompensationComparison
from dvrk_drake.export.dvrk_mtm_gravity_compensation_file import GravityCompensationFile
from dvrk_drake.export.dvrk_psm_gravity_compensation import ARM_JOINTS, NAMES, KinematicCompensation
from dvrk_drake.export.model_export import ModelExport
from dvrk_drake.export.sdf import LinkChange, changed_links
from dvrk_drake.models.arm import Arm
from dvrk_drake.reports.figures import MODEL_COLOUR, save_figure


def print_export(console: Console, path: str, export: ModelExport) -> None:
    """Prints what a file has of a model, what it cannot state, and its name."""
    arm = export.model.arm
    if export.format == "sdf" and export.bodies is not None:
        print_changed_links(console, changed_links(arm, export.bodies.links), export.bodies)
        console.print(f"SDF: {path}", soft_wrap=True)
    elif export.format == "urdf":
        console.print(f"URDF: {path}", soft_wrap=True)
    elif isinstance(export.compensation, KinematicCompensation):
        print_kinematic_compensation(console, path, export.compensation)
    else:
        written = GravityCompensationFile.load(path)
        print_compensation(console, path, arm, written, largest_differences(written, export.model))


def print_changed_links(console: Console, changes: Sequence[LinkChange], bodies: ModelBodies) -> None:
    """Mass, centre of mass and inertia of every changed link, before and after; then what links cannot say."""
    if not changes:
        console.print("All links are as in the arm's own SDF.")
    else:
        table = _table("link, its SDF's and now", "mass [kg]", "centre of mass [mm]", "moments of inertia [kg cm^2]")
        for change in changes:
            for name, inertia in ((change.link, change.before), ("", change.after)):
                M = inertia.to_spatial_inertia()
                about_cm = M.Shift(M.get_com()).CalcRotationalInertia()
                moments = about_cm.CalcPrincipalMomentsAndAxesOfInertia()[0]
                table.add_row(
                    name,
                    f"{M.get_mass():.4f}",
                    " ".join(f"{1e3 * x:+8.2f}" for x in M.get_com()),
                    " ".join(f"{1e4 * x:9.4f}" for x in moments),
                )
        console.print(table)
        console.print("Centre of mass in the link's frame; principal moments about it.")
    if bodies.rotors:
        rotors = ", ".join(f"{name} {inertia:.3g}" for name, inertia in bodies.rotors.items())
        console.print(escape(f"Inertia that motors add to joints [kg m^2; kg if prismatic]: {rotors}"), soft_wrap=True)
    for remark in bodies.left_out:
        console.print(escape(f"Left out: {remark}"), soft_wrap=True)


def print_compensation(
    console: Console, path: str, arm: Arm, file: GravityCompensationFile, off: NDArray[np.float64]
) -> None:
    """What a person should read before the controller does; `off` (7,) differences from the model [N m]."""
    table = _table(
        "", "off by* [N m]", "clip [N m]", "friction [N m]", "ratio", "dead band [rad/s]", "saturation [rad/s]"
    )
    friction = (file.positive - file.negative)[10::5] / 2
    for j, name in enumerate(MTM_JOINTS):
        table.add_row(
            name,
            f"{off[j]:.1e}",
            f"{file.torque_lower[j]:+.4f} .. {file.torque_upper[j]:+.4f}",
            f"{np.append(friction, 0.0)[j]:.4f}",
            f"{file.friction_ratio[j]:g}",
            f"{file.dead_band[j]:g}",
            f"{file.saturation[j]:g}",
        )
    console.print(table)
    console.print("* at most, the file's torque at rest from the model's, at 4000 random poses of the joint box")
    largest = np.maximum(np.abs(file.torque_lower), np.abs(file.torque_upper))
    if short := [name for name, at_limit in zip(MTM_JOINTS, largest >= arm.effort_limits, strict=True) if at_limit]:
        console.print(f"Clipped at the motor's limit somewhere in the joint box: {', '.join(short)}")
    console.print(f'gravity compensation: {path}; "gravity_compensation" of the arm\'s JSON names it', soft_wrap=True)


def print_kinematic_compensation(console: Console, path: str, file: KinematicCompensation) -> None:
    """The chain's links, and what the file leaves out."""
    table = _table("link of the chain", "mass [kg]", "cx, cy, cz [mm] in its DH frame")
    for name, mass, center in zip(NAMES, file.mass, file.center, strict=True):
        table.add_row(name, f"{mass:.4f}", " ".join(f"{1e3 * x:+8.2f}" for x in center))
    console.print(table)
    for name, error, wrist, unit in zip(ARM_JOINTS, file.error, file.wrist, ("N m", "N m", "N"), strict=True):
        console.print(
            f"{name}: differs from the model by up to {error:.1e} {unit}, and {wrist:.1e} with the wrist bent"
        )
    console.print(f"kinematic gravity compensation: {path}", soft_wrap=True)


def print_comparison(console: Console, file_name: str, model_name: str, comparison: CompensationComparison) -> None:
    """One row a joint, then what its columns mean."""
    console.print(
        f"{file_name} (file) and {model_name} (model) at {len(comparison.q)} random poses of the joint box, at rest",
        soft_wrap=True,
    )
    table = _table("[N m]", "model", "file, no clip", "clip", "at clip", "runaway", "opposed", "RMS in | out")
    for j in comparison.joints:
        table.add_row(
            j.name,
            _range(j.model_lower, j.model_upper),
            _range(j.file_lower, j.file_upper),
            _range(j.clip_lower, j.clip_upper),
            *(f"{100 * share:.0f} %" if share else "" for share in (j.clipped, j.runaway, j.opposed)),
            f"{_number(j.rms_inside)} | {_number(j.rms_outside)}",
        )
    console.print(table)
    console.print(
        "at clip: share of poses at which the file's torque is its limit, a constant. runaway: where it is, before "
        "the clip, outside the model's range by more than half of it. opposed: where file and model push opposite "
        "ways, both by more than a tenth of the model's largest. RMS: file less model, in and out of the sweep that "
        f"the file says its data are from ({_sweep(comparison)})."
    )
    wrong = (comparison.clipped | comparison.runaway | comparison.opposed)[:, : len(MTM_JOINTS) - 1].any(axis=1)
    console.print(f"At {100 * wrong.mean():.0f} % of the poses at least one joint has one of the three.")


def _table(first: str, *headings: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(escape(first), no_wrap=True)
    for heading in headings:
        table.add_column(escape(heading), justify="right", no_wrap=True)
    return table


def _sweep(comparison: CompensationComparison) -> str:
    if comparison.file.sweep is None:
        return "it does not say"
    return f"{100 * comparison.in_sweep.mean():.0f} % of the joint box"


def _range(lower: float, upper: float) -> str:
    return "..".join(f"{round(x, 3) + 0.0:+.3f}" for x in (lower, upper))


def _number(x: float) -> str:
    return "-" if np.isnan(x) else f"{x:.3f}"


FILE_COLOUR = "#d1495b"
#: What is wrong with a pose -> colour of its strip.
_FLAGS = {"clip active": "#edae49", "pushes against the model": "#d1495b", "runaway": "#5b3a8c"}
_BINS = 60
_DRAWN = 6  # the file has nothing for joint 7


def plot_compensation(path: str | Path, comparison: CompensationComparison, title: str) -> None:
    """One panel a joint over its position: ranges over all poses, and below the share of poses that are wrong.

    Bands are the range over all other joints. Drawn are the file before its clip, its limits (dashed), and the sweep
    that the file says its data are from (grey ground).

    Args:
        path: PNG to write.
        comparison: what to draw.
        title: above all.

    Raises:
        DvrkDrakeError: the file cannot be written.
    """
    figure = plt.figure(figsize=(16, 9.5), layout="constrained")
    grid = figure.add_gridspec(4, 3, height_ratios=[3, 1, 3, 1])
    for j in range(_DRAWN):
        row, column = 2 * (j // 3), j % 3
        torque_axes = figure.add_subplot(grid[row, column])
        share_axes = figure.add_subplot(grid[row + 1, column], sharex=torque_axes)
        _draw_torque(torque_axes, comparison, j)
        _draw_shares(share_axes, comparison, j)
    handles, labels = (a + b for a, b in zip(*(ax.get_legend_handles_labels() for ax in figure.axes[:2]), strict=True))
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9)
    figure.suptitle(title)
    save_figure(figure, Path(path))


def _draw_torque(axes: Axes, comparison: CompensationComparison, j: int) -> None:
    joint, file = comparison.joints[j], comparison.file
    edges, centres, members = _bins(comparison, j)
    if file.sweep is not None:
        span = np.clip(file.sweep[:, j], edges[0], edges[-1])
        axes.axvspan(*span, color="0.92", label="sweep of the file's data")
    for torque, colour, label in (
        (comparison.file_torque, FILE_COLOUR, "installed file, before its clip"),
        (comparison.model_torque, MODEL_COLOUR, "model"),
    ):
        low, middle, high = (np.array([f(torque[m, j]) for m in members]) for f in (np.min, np.mean, np.max))
        axes.fill_between(centres, low, high, color=colour, alpha=0.3, label=f"{label} (range)")
        axes.plot(centres, middle, color=colour, linewidth=1.2)
    for i, limit in enumerate((joint.clip_lower, joint.clip_upper)):
        axes.axhline(limit, color="black", linestyle="--", linewidth=0.9, label="" if i else "clip of the file")
    axes.set_title(f"J{j + 1} {joint.name}", fontsize=10)
    axes.set_ylabel("torque [N m]")
    axes.tick_params(labelbottom=False)
    axes.set_xlim(edges[0], edges[-1])


def _draw_shares(axes: Axes, comparison: CompensationComparison, j: int) -> None:
    _, centres, members = _bins(comparison, j)
    flags = (comparison.clipped, comparison.opposed, comparison.runaway)
    for (label, colour), flag in zip(_FLAGS.items(), flags, strict=True):
        axes.plot(centres, [100 * flag[m, j].mean() for m in members], color=colour, label=f"{label} [% of poses]")
    axes.set_ylim(-3, 103)
    axes.set_ylabel("% of poses")
    axes.set_xlabel(f"q{j + 1} [rad]")
    axes.grid(alpha=0.3)


def _bins(
    comparison: CompensationComparison, j: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[NDArray[np.int_]]]:
    """Edges and centres of bins of q_j that hold poses, and which."""
    q = comparison.q[:, j]
    edges = np.linspace(q.min(), q.max(), _BINS + 1)
    index = np.clip(np.digitize(q, edges) - 1, 0, _BINS - 1)
    members = [np.flatnonzero(index == i) for i in range(_BINS)]
    used = [i for i, m in enumerate(members) if len(m)]
    return edges, (edges[:-1] + edges[1:])[used] / 2, [members[i] for i in used]
