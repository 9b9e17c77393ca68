"""Compares `identify`, the paper's method and zero torque on the static recordings of a real arm.

    python benchmarks/static_recordings.py FOLDER [--arm mtmr]

FOLDER contains CSV files with q1..q7 and tau1..tau7 (docs/public_recordings.md). The script prints one table per file.
The models are identified from this file and evaluated on its left-out poses and on all other files. "Zero" is the
prediction of zero torque.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.analysis.validation import validate_static
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.recording import Recording


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    parser.add_argument("--arm", default="mtmr", help="name of the arm; default: mtmr")
    options = parser.parse_args()
    arm = load_arm(options.arm)
    recordings: dict[str, Recording] = {}
    for path in sorted(options.folder.glob("*.csv")):
        try:
            recording = read_recording(path)
            recording.measured_effort()
            recordings[path.stem] = recording
        except RecordingError as error:
            print(f"not evaluated: {error}", file=sys.stderr)
    console = Console(width=200, highlight=False)
    for name, raw in recordings.items():
        ours = identify_static(raw, arm)
        recording = ours.recording  # repeated poses are averaged, for both methods
        paper = identify_static(recording, arm, "paper")
        excluded = np.zeros(recording.q.shape, dtype=bool)
        for measurement in ours.excluded:
            excluded[measurement.row, list(measurement.joints)] = True
        title = f"identified from {name} ({len(raw)} rows, {len(recording)} poses): RMS torque error [N m]"
        table = Table(box=box.MARKDOWN)
        for column in ("evaluated on", "method", *(f"J{i + 1}" for i in range(arm.num_joints))):
            table.add_column(column, justify="right")
        tau = recording.measured_effort()

        def rms(values: np.ndarray, use: np.ndarray) -> list[str]:
            return [f"{np.sqrt(np.mean(values[use[:, j], j] ** 2)):.4f}" for j in range(values.shape[1])]

        table.add_row("leave-one-out, without excluded", "zero", *rms(tau, ~excluded))
        table.add_row("", "paper", *rms(paper.leave_one_out_residuals, ~excluded))
        table.add_row("", "ours", *rms(ours.leave_one_out_residuals, ~excluded))
        table.add_row("", "ours, 10-fold", *(f"{j.rms_cross_validation_included:.4f}" for j in ours.model.joints))
        everything = np.ones_like(excluded)
        table.add_row("leave-one-out, all", "zero", *rms(tau, everything))
        table.add_row("", "paper", *rms(paper.leave_one_out_residuals, everything))
        table.add_row("", "ours", *rms(ours.leave_one_out_residuals, everything))
        for other_name, other in recordings.items():
            if other_name == name:
                continue
            by_ours, by_paper = validate_static(ours.model, other).joints, validate_static(paper.model, other).joints
            table.add_row(f"{other_name}, without excluded", "zero", *(f"{j.rms_torque_included:.4f}" for j in by_ours))
            table.add_row("", "paper", *(f"{j.rms_error_included:.4f}" for j in by_paper))
            table.add_row("", "ours", *(f"{j.rms_error_included:.4f}" for j in by_ours))
        console.print(escape(title), table, sep="\n\n")
        effects = ", ".join(f"{ActuatorEffect.of(e)} {e.coefficient:+.3f}" for e in ours.model.effects)
        scales = ", ".join(f"{j.name} {j.feedforward_scale:.2f}" for j in ours.model.joints if j.feedforward_scale < 1)
        console.print(f"selected effects: {effects or 'none'}; feedforward scales below 1: {scales or 'none'}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
