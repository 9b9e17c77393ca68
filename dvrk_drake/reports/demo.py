"""Pages of the demo and of the teleoperation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.demo import DemoResult, load_plan
from dvrk_drake.experiments.teleoperation import TeleoperationResult
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.colours import FITTED, LIMIT, NEUTRAL, REFERENCE
from dvrk_drake.reports.html_file import write_html
from dvrk_drake.reports.image_files import write_images
from dvrk_drake.reports.page import Block, Page, Plot, Scene, Section, Table, Text
from dvrk_drake.reports.playback import playback
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel, joint_label

_REAL_ARM = (
    "With a real arm: record at least 40 different static poses with `dvrk-drake collect`, or convert a recording of "
    "another program. Identify the model, and validate it on another day with `--save`. Disable the gravity "
    "compensation of the dVRK controller; otherwise gravity is compensated twice. Keep a hand on the emergency stop. "
    'Run the controller only if no verdict is "do not use".'
)
#: Smallest half-width of the drift axis, as a multiple of the limit of the drift.
_MIN_RANGE = 2.0


def write_demo(result: DemoResult, folder: Path, command: Sequence[str] = ()) -> Page:
    """Writes report.html, arm.html (animation) and the plots as images to the folder of a demo; returns the page.

    Args:
        result: Result of the demo.
        folder: Output folder of `run_demo`.
        command: Words of the command line, for the provenance.
    """
    arm = result.arm
    view = playback(
        arm,
        result.time,
        result.identified,
        color=FITTED,
        ghost=result.nominal,
        phases=(
            (float(result.time[0]), "held: the controller regulates the pose"),
            (0.0, "released: no desired pose"),
        ),
        colors={FITTED: "identified model, mode guide", REFERENCE: "model of the SDF, mode gravity"},
        title=f"{arm.name} (simulated) - dvrk-drake demo",
    )
    with atomic_write(folder / "arm.html") as stream:
        stream.write(view)
    page = demo_page(result, folder)
    write_images(page, folder)
    write_html(page, folder / "report.html", [folder / "poses.csv"], command)
    return page


def demo_page(result: DemoResult, folder: Path) -> Page:
    """Returns whether the released arm stays at its pose, its drift, and the errors of the models at new poses.

    Args:
        result: Result of the demo.
        folder: Output folder of the demo, for the suggested next command.
    """
    arm, duration = result.arm, result.time[-1]
    drifts, held = result.drifts, result.holds("identified")
    largest = {model: _largest_rotation(arm, drift) for model, drift in drifts.items()}
    rows = []
    for i, (ours, sdf) in enumerate(zip(result.fresh.joints, result.fresh_nominal.joints, strict=True)):
        drift = (f"{1e3 * drifts[model][i]:.1f}" for model in ("identified", "nominal"))
        errors = (f"{error:.4f}" for error in (ours.rms_error, sdf.rms_error, ours.rms_torque))
        rows.append((ours.name, *drift, *errors))
    low, high = load_plan(arm.source).mass_ratios
    blocks: list[Block] = [
        Table(
            ("", "drift, identified", "drift, SDF", "error, identified", "error, SDF", "zero torque"),
            rows,
            f"Largest drift in {duration:g} s [mrad; mm], RMS torque error at {result.fresh.poses} new poses [N m; N]",
        ),
        Text(
            "The simulated arm has the friction, cables, stops and sensors of the arm file. Its links are "
            f"{low:g} to {high:g} times as heavy as in the SDF, except for its counterweights. At the start of the "
            "release, its friction carries no load. After an approach from one side, gravity compensation alone lets a "
            "joint move further than the limit.",
            show="details",
        ),
        Text(_REAL_ARM, show="details"),
    ]
    view = folder / "arm.html"
    caption = "Identified model in mode guide (blue), model of the SDF in mode gravity (green)"
    scene = [Scene(view.read_text, caption, start=float(result.time[0]))]
    return Page(
        f"Demo: {arm.name}, simulated",
        f"Verdict: in mode guide, the identified model {'holds' if held else 'does not hold'} the released {arm.name} "
        f"for {duration:g} s. Largest drift: {largest['identified']}, limit 15 mrad. With the model of the SDF in mode "
        f"gravity, the largest drift of the same arm is {largest['nominal']}.",
        [
            Section("Drift and torque errors", blocks),
            Section("Release", [*scene, _drift_plot(result)]),
        ],
        "good" if held else "warning",
        f"dvrk-drake identify {folder}/poses.csv --arm {arm.source} --output MODEL.yaml --report report.html",
        "Identifies a model from the poses of the demo, or from your own recording.",
    )


def _largest_rotation(arm: Arm, drift: NDArray[np.float64]) -> str:
    """Returns the largest drift (n,) of the rotating joints with its unit and joint."""
    angles = np.where(arm.prismatic, 0.0, drift)
    return f"{1e3 * angles.max():.1f} mrad ({arm.joint_names[int(np.argmax(angles))]})"


def _drift_plot(result: DemoResult) -> Plot:
    """Returns the drift of the released arm with both models.

    Each joint has one panel, in which both models have the same scale. The panel shows the largest drift of a held
    joint, and the position limits of the joint that are inside its range.
    """
    arm, t, panels = result.arm, result.time, []
    limits = "15 mrad or 1.5 mm" if np.any(arm.prismatic) else "15 mrad"
    for j in range(arm.num_joints):
        q0, held = result.identified[0, j], 1e3 * result.limits[j]
        nominal, identified = (1e3 * result.drift(model)[:, j] for model in ("nominal", "identified"))
        marks: list[Mark] = [
            Guide("y", -held, held, NEUTRAL, f"limit of a held joint: {limits}"),
            Curve("model of the SDF (not identified)", t, nominal, REFERENCE, "dashed"),
            Curve("identified model", t, identified, FITTED),
        ]
        low = min(nominal.min(), identified.min(), -_MIN_RANGE * held)
        high = max(nominal.max(), identified.max(), _MIN_RANGE * held)
        for stop in 1e3 * (np.array([arm.position_lower[j], arm.position_upper[j]]) - q0):
            if low <= stop <= high:
                marks.append(Guide("y", float(stop), None, LIMIT, "joint limit"))
        label = f"drift [{'mm' if arm.prismatic[j] else 'mrad'}]"
        margin = 0.05 * (high - low)
        y_range = (low - margin, high + margin)
        panels.append(Panel(joint_label(arm, j), marks, "time since the release [s]", label, y_range=y_range))
    return Plot("drift", "Drift from the release position with both models", panels, columns=2, time=True)


def teleoperation_page(result: TeleoperationResult, file: str) -> Page:
    """Returns the tracking error of the instrument tip.

    Args:
        result: Result of the teleoperation.
        file: Path of the page with the recorded motion.
    """
    largest, rms = 1e3 * result.max_position_error, 1e3 * result.rms_position_error
    rows = [
        ("position [mm]", f"{rms:.3f}", f"{largest:.3f}"),
        ("rotation [mrad]", f"{1e3 * result.rms_rotation_error:.2f}", f"{1e3 * result.max_rotation_error:.2f}"),
        ("motion while the clutch is open [mm]", "", f"{1e3 * result.max_motion_held:.1g}"),
    ]
    definition = (
        "Error: motion of the tip minus the scaled motion of the handle. Both motions are measured from the positions "
        f"at which the clutch was closed. Length of the path of the handle: {result.handle_path:.2f} m."
    )
    blocks = [Table(("", "RMS", "largest"), rows, "Tracking error of the instrument tip")]
    return Page(
        "Teleoperation of a PSM with an MTM, simulated",
        f"The tip follows the handle within {largest:.3f} mm (RMS {rms:.3f} mm).",
        [Section("Tracking error", [*blocks, Text(definition, show="details")])],
        "good",
        f"open {file} in a browser",
    )
