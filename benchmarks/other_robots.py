"""Measures the errors of models of robots that are not a dVRK, each identified from a model file and one motion.

    python benchmarks/other_robots.py FOLDER [--robots ur10e ...] [--json FILE]

FOLDER contains the folders ur10e, tx40, ar5 and ur10_shifted with a URDF and motions; see its README for their sources.
A model is identified with the default settings. Its errors are measured on motions, or parts of a motion, that were not
used:

    UR10e   motion of another day (50 s), which has no load
    TX40    last 40 % of the file; its arm file states the transmission, which a URDF cannot
    AR5     last 40 % of the file; the robot is mounted sideways, which only the least squares know
    UR10    last 40 % of the file; the zeros of two joints differ by 90 degrees, which only the least squares know

Errors are |tau - tau_hat| / |tau| of each actuator. Both efforts are low-pass filtered with a zero-phase Butterworth
filter, and 1.5 periods of its cut-off frequency are omitted at each end.

The second line of each robot is weighted least squares: the base parameters of the full regressor, and rotor inertia,
viscous and Coulomb friction (tanh) and an offset of each actuator, weighted by the residuals of each actuator.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.signal
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table
from timing import write_json

import dvrk_drake as dvrk
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor

#: Joint speed at which the tanh of the Coulomb friction is 0.76 [rad/s].
WIDTH = 0.05
TX40 = """format: dvrk_drake arm 1.0
name: TX40
sdf: {model}
transmission:
  joint_1: {{joint_1: 32}}
  joint_2: {{joint_2: 32}}
  joint_3: {{joint_3: 45}}
  joint_4: {{joint_4: -48}}
  joint_5: {{joint_5: 45}}
  joint_6: {{joint_5: 32, joint_6: 32}}
"""


@dataclasses.dataclass(frozen=True)
class Case:
    """One robot.

    Attributes:
        model: Path of the URDF in the folder.
        identified, predicted: Paths of the motions.
        split: Share of the first motion that is used, if both motions are parts of one file.
        order, cut_off: Order of the evaluation's low-pass filter and its cut-off frequency [Hz].
        arm_file: Text of the arm file, or "" for the URDF.
        gravity: Gravity in the base frame [m/s^2], for the least squares.
        zeros: Positions to add to the recorded ones [rad], for the least squares.
        coordinates: Coordinates of the recording.
    """

    model: str
    identified: str
    predicted: str
    split: float
    order: int
    cut_off: float
    arm_file: str = ""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    zeros: tuple[float, ...] = ()
    coordinates: str = "joint"


CASES = {
    "UR10e": Case("ur10e/ur10e.urdf", "ur10e/motion_30s.csv", "ur10e/motion_50s_unloaded.csv", 1.0, 5, 10.0),
    "TX40": Case("tx40/tx40.urdf", *["tx40/motion.csv"] * 2, 0.6, 4, 20.0, TX40, coordinates="actuator"),
    "AR5": Case("ar5/ar5.urdf", *["ar5/motion.csv"] * 2, 0.6, 4, 5.0, gravity=(9.81, 0.0, 0.0)),
    "UR10": Case(
        "ur10_shifted/ur10.urdf",
        *["ur10_shifted/motion.csv"] * 2,
        *(0.6, 4, 8.0),
        zeros=(0, -np.pi / 2, 0, -np.pi / 2, 0, 0),
    ),
}


def part(recording: dvrk.Recording, rows: slice) -> dvrk.Recording:
    """Returns some rows of a recording."""
    q, qd, tau, t = (None if x is None else x[rows] for x in (recording.q, recording.qd, recording.tau, recording.t))
    assert q is not None
    return dataclasses.replace(recording, q=q, qd=qd, tau=tau, t=t, lines=None)


def relative_errors(case: Case, recording: dvrk.Recording, tau: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the relative RMS errors (n,) [%] of predicted efforts (m, n)."""
    t = recording.t
    assert t is not None
    rate = 1 / float(np.median(np.diff(t)))
    sos = scipy.signal.butter(case.order, case.cut_off, fs=rate, output="sos")
    ends = round(1.5 * rate / case.cut_off)
    measured, error = (scipy.signal.sosfiltfilt(sos, x, axis=0)[ends:-ends] for x in (recording.measured_effort(), tau))
    return 100 * np.sqrt(np.mean((measured - error) ** 2, axis=0) / np.mean(measured**2, axis=0))


class LeastSquares:
    """Weighted least squares with the columns that all peers use."""

    def __init__(self, case: Case, arm: dvrk.Arm, recording: dvrk.Recording) -> None:
        self.case, self.arm, self.regressor = case, arm, DynamicRegressor(arm)
        X, tau = self._columns(recording), recording.measured_effort()
        rate = 1 / float(np.median(np.diff(recording.t)))
        sos = scipy.signal.butter(case.order, case.cut_off, fs=rate, output="sos")
        ends = round(1.5 * rate / case.cut_off)
        X, tau = (scipy.signal.sosfiltfilt(sos, x, axis=0)[ends:-ends] for x in (X, tau))
        weights = np.ones(tau.shape[1])
        for _ in range(10):
            rows = (X * weights[:, None]).reshape(-1, X.shape[2])
            size = np.linalg.norm(rows, axis=0)
            size[size == 0] = 1.0
            self.x = np.linalg.lstsq(rows / size, (tau * weights).ravel(), rcond=1e-8)[0] / size
            weights = 1 / np.sqrt(np.mean((tau - X @ self.x) ** 2, axis=0))

    def _columns(self, recording: dvrk.Recording) -> NDArray[np.float64]:
        """Returns the columns (m, n, k) of the efforts of the actuators."""
        t, q = recording.t, recording.q
        assert t is not None
        rate = 1 / float(np.median(np.diff(t)))
        sos = scipy.signal.butter(self.case.order, self.case.cut_off, fs=rate, output="sos")
        v = recording.qd
        if v is None:
            v = np.gradient(scipy.signal.sosfiltfilt(sos, q, axis=0), t, axis=0)
        vd = np.gradient(scipy.signal.sosfiltfilt(sos, v, axis=0), t, axis=0)
        J = self.arm.transmission.matrix
        rigid = np.einsum("ji,mjk->mik", np.linalg.inv(J), self.regressor.regressor(q, v, vd))
        n = q.shape[1]
        own = np.zeros((len(q), n, n, 4))
        v_drive = v @ J.T
        for i in range(n):
            scale = WIDTH * np.linalg.norm(J[i])
            own[:, i, i] = np.column_stack([vd @ J[i], v_drive[:, i], np.tanh(v_drive[:, i] / scale), np.ones(len(q))])
        return np.concatenate([rigid, own.reshape(len(q), n, -1)], axis=2)

    def predict(self, recording: dvrk.Recording) -> NDArray[np.float64]:
        """Returns the efforts (m, n) of a motion."""
        return self._columns(recording) @ self.x


def run(name: str, case: Case, folder: Path, scratch: Path) -> list[dict[str, object]]:
    """Returns the errors of both methods for one robot."""
    path = folder / case.model
    if case.arm_file:
        path = scratch / f"{name}.yaml"
        path.write_text(case.arm_file.format(model=folder.resolve() / case.model))
    arm = dvrk.load_arm(path)
    mounted = arm.with_gravity(case.gravity).with_position_offsets(dict(zip(arm.joint_names, case.zeros, strict=False)))
    first, second = (
        dvrk.read_recording(folder / file, arm, coordinates=case.coordinates)
        for file in (case.identified, case.predicted)
    )
    if case.split < 1:
        cut = round(case.split * len(first))
        first, second = part(first, slice(0, cut)), part(second, slice(cut, None))
    methods: dict[str, Callable[[], NDArray[np.float64]]] = {
        "identify": lambda: dvrk.predict(dvrk.identify(first, arm).model, second).tau,
        "least squares": lambda: LeastSquares(case, mounted, first).predict(second),
    }
    rows = []
    for method, predicted in methods.items():
        start = time.perf_counter()
        try:
            errors = relative_errors(case, second, predicted())
        except dvrk.DvrkDrakeError as error:
            print(f"{name}, {method}: {error}")
            errors = np.full(arm.num_joints, np.nan)
        rows.append({"robot": name, "method": method, "errors": errors.tolist(), "time": time.perf_counter() - start})
    return rows


def main() -> None:
    """Prints the errors of each robot."""
    parser = argparse.ArgumentParser(description="Errors of models of other robots on motions that nobody fitted.")
    parser.add_argument("folder", type=Path, help="folder with one folder per robot")
    parser.add_argument("--robots", nargs="+", choices=CASES, default=list(CASES), help="robots; default: all")
    parser.add_argument("--json", type=Path, help="file for the errors")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    table = Table("robot", "method", "errors [%]", "mean", "time [s]", box=box.SIMPLE)
    results = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.robots:
            for row in run(name, CASES[name], options.folder, Path(scratch)):
                results.append(row)
                errors = np.array(row["errors"])
                texts = " ".join(f"{error:.1f}" for error in errors)
                table.add_row(name, str(row["method"]), texts, f"{errors.mean():.1f}", f"{row['time']:.1f}")
    Console(width=120).print(table)
    if options.json:
        write_json(options.json, results)


if __name__ == "__main__":
    main()
