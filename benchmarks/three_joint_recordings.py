"""Compares `identify` with ordinary least squares on recordings of the first three joints of two PSMs.

    python benchmarks/three_joint_recordings.py FOLDER [--json FILE]

FOLDER contains psm1_1.csv to psm1_3.csv and psm2_1.csv, psm2_2.csv, i.e. motions of two PSMs from
https://github.com/radiang/dvrk_parameter_identification (2018) with columns t, q1..q3, qd1..qd3 and tau1..tau3, at 200
Hz. All other joints are locked at zero. Each model is evaluated on the other recordings of the same arm.

Errors are |tau - tau_hat| / |tau| of each actuator. Both efforts are low-pass filtered with a zero-phase Butterworth
filter (17 Hz, order 6), and 100 rows at each end are omitted. Methods:

    identify       model of `dvrk-drake identify`, from one recording or from all others
    least squares  ordinary least squares over the full regressor of the arm with viscous friction, smoothed Coulomb
                   friction, offset, spring and rotor inertia of each joint, from one recording or from all others
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table
from timing import write_json

import dvrk_drake as dvrk
from dvrk_drake.analysis.observations.signals import low_pass
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor

RATE, CUT_OFF, ENDS = 200.0, 17.0, 100
#: Velocity scale of the smoothed sign function tanh(v / WIDTH) in the Coulomb friction [rad/s], [m/s].
WIDTH = 0.1, 0.01
ARMS = {"PSM1": ("psm1_1", "psm1_2", "psm1_3"), "PSM2": ("psm2_1", "psm2_2")}
LOCKED = {"roll": 0.0, "wrist_pitch": 0.0, "wrist_yaw": 0.0, "jaw": 0.0}


def relative_errors(recording: dvrk.Recording, tau_filtered: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the relative RMS errors (n,) [%].

    Args:
        recording: Recording with the measured efforts.
        tau_filtered: Predicted efforts (m, n) [N m, N], already low-pass filtered.
    """
    tau = low_pass(recording.measured_effort(), RATE, CUT_OFF)[ENDS:-ENDS]
    return 100 * np.sqrt(np.mean((tau - tau_filtered[ENDS:-ENDS]) ** 2, axis=0) / np.mean(tau**2, axis=0))


def least_squares_columns(recording: dvrk.Recording, regressor: DynamicRegressor) -> NDArray[np.float64]:
    """Returns the low-pass filtered regressor (m, n, p) of the least squares."""
    q, v = recording.q, recording.qd
    assert v is not None
    vd = np.gradient(low_pass(v, RATE, CUT_OFF), 1 / RATE, axis=0)
    Y = regressor.regressor(q, v, vd)
    n = q.shape[1]
    parts = np.zeros((len(q), n, n, 5))
    sign = np.tanh(v / regressor.arm.per_joint(*WIDTH))
    for j in range(n):
        parts[:, j, j] = np.column_stack([v[:, j], sign[:, j], np.ones(len(q)), q[:, j], vd[:, j]])
    columns = np.concatenate([Y, parts.reshape(len(q), n, -1)], axis=2)
    return low_pass(columns.reshape(len(q), -1), RATE, CUT_OFF).reshape(columns.shape)


def least_squares(columns: list[NDArray[np.float64]], efforts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Returns the parameters (p,) fitted to several recordings.

    Args:
        columns: Regressor (m, n, p) of each recording, see `least_squares_columns`.
        efforts: Measured efforts (m, n) [N m, N] of each recording.
    """
    A = np.concatenate([part[ENDS:-ENDS].reshape(-1, part.shape[2]) for part in columns])
    b = np.concatenate([low_pass(tau, RATE, CUT_OFF)[ENDS:-ENDS].ravel() for tau in efforts])
    size = np.linalg.norm(A, axis=0)
    size[size == 0] = 1.0
    return np.linalg.lstsq(A / size, b, rcond=1e-8)[0] / size


def print_other_robots(models: dict[str, dvrk.IdentifiedModel], recordings: dict[str, dvrk.Recording]) -> None:
    """Prints for how many pairs of a model and a recording `check` reports another individual arm."""
    arm_of = {file: name for name, files in ARMS.items() for file in files}
    for relation in ("the same arm", "another arm"):
        found = {
            (source, target): [f.where for f in dvrk.check(recording, model).warnings if f.kind == "other robot"]
            for source, model in models.items()
            for target, recording in recordings.items()
            if source != target and (arm_of[source] == arm_of[target]) == (relation == "the same arm")
        }
        count = sum(map(bool, found.values()))
        print(f"`check --model` reports another robot in {count} of {len(found)} pairs: {relation}")
        for (source, target), where in found.items():
            if where and relation == "the same arm":
                print(f"  {source} -> {target}: {where[0]}")


def main() -> None:
    """Prints one table per arm, how often another individual arm is reported, and the mean errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    parser.add_argument("--json", help="file for the errors")
    options = parser.parse_args()
    arm = dvrk.lock_joints(dvrk.load_arm("psm"), LOCKED)
    regressor, console, results = DynamicRegressor(arm), Console(highlight=False, width=200), []
    all_models, all_recordings = dict[str, dvrk.IdentifiedModel](), dict[str, dvrk.Recording]()
    for name, files in ARMS.items():
        recordings = {file: dvrk.read_recording(options.folder / f"{file}.csv", arm) for file in files}
        columns = {file: least_squares_columns(recording, regressor) for file, recording in recordings.items()}
        efforts = {file: recording.measured_effort() for file, recording in recordings.items()}
        models = {file: dvrk.identify(recording, arm).model for file, recording in recordings.items()}
        table = Table("fitted to", "evaluated on", "method", *arm.joint_names, "mean", box=box.MARKDOWN)
        for target, recording in recordings.items():
            others = [file for file in files if file != target]
            for source in others:
                rows = {
                    "identify": dvrk.predict(models[source], recording).tau,
                    "least squares": columns[target] @ least_squares([columns[source]], [efforts[source]]),
                }
                for method, predicted in rows.items():
                    results.append((name, source, target, method, relative_errors(recording, predicted)))
            if len(others) > 1:
                x = least_squares([columns[file] for file in others], [efforts[file] for file in others])
                model = dvrk.identify([recordings[file] for file in others], arm).model
                rows = {"identify": dvrk.predict(model, recording).tau, "least squares": columns[target] @ x}
                for method, predicted in rows.items():
                    results.append((name, "all others", target, method, relative_errors(recording, predicted)))
        for arm_name, source, target, method, errors in results:
            if arm_name == name:
                table.add_row(source, target, method, *(f"{e:.1f}" for e in errors), f"{errors.mean():.1f}")
        console.print(f"{name}: error [%]", table, sep="\n\n")
        all_models |= models
        all_recordings |= recordings
    print_other_robots(all_models, all_recordings)
    for method in ("identify", "least squares"):
        one = [errors for _, source, _, used, errors in results if used == method and source != "all others"]
        console.print(f"mean over all pairs, {method}: {np.mean(one):.1f} %")
    if options.json is not None:
        keys = ("arm", "fitted_to", "evaluated_on", "method", "errors")
        write_json(options.json, [dict(zip(keys, (*row[:4], row[4].tolist()), strict=True)) for row in results])


if __name__ == "__main__":
    main()
