"""Measures the errors of the estimated force at the tip of a simulated arm, and of two simpler methods.

    python benchmarks/external_force.py [--arm psm] [--contacts 200] [--free-minutes 30] [--bandwidth 40] [--folder F]

The simulated arm has all effects of its file: friction, springs, encoders, noise, delays. Its model is identified from
one designed motion of 30 s. Then the arm follows another, random motion, while random forces act on its tip: 1 s each,
0.2 to 10 N, in random directions. Rows of the table:

    observer            ExternalForceEstimator with the identified model
    without friction    the same without friction in the model
    dVRK's method       wrench from the inverse transposed Jacobian and the measured efforts minus the gravity
                        compensation, which has the exact parameters here, low-pass filtered as the observer

Columns: RMS error of a component, also as a share of the largest force of 10 N, against the true force (error) and
against the true force after the low-pass filter of the observer (without delay); delay; share of the true components
inside the 95 % interval. The second table shows the contacts that the output `contact` detects at one expected false
alarm per hour, with the covariance of a model of the same day and of another day. False alarms are counted without a
force.

--folder keeps the recordings and the model, and reads them if they exist. A second run then takes minutes.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from timing import print_table

from dvrk_drake.analysis.excitation.design import design_excitation
from dvrk_drake.analysis.excitation.information import random_motion
from dvrk_drake.analysis.excitation.motion_limits import MotionLimits
from dvrk_drake.analysis.excitation.periodic_motion import PeriodicMotion
from dvrk_drake.analysis.identification import identify
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import ArmFrame, Contact
from dvrk_drake.dynamics.momentum_observer import BANDWIDTH, MomentumObserver
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import POSITION_KINDS, half_width
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: Duration of a contact and of its beginning and end [s], and smallest and largest pause between contacts [s].
DURATION, RAMP, PAUSES = 1.0, 0.1, (0.4, 0.8)
#: Smallest and largest force [N].
FORCES = (0.2, 10.0)
#: Ranges of forces in the table of detected contacts [N].
SIZES = ((0.2, 1.0), (1.0, 2.0), (2.0, 5.0), (5.0, 10.1))
#: Estimates are compared every EVERY-th row of 1 ms, after the START [s] of the motion.
EVERY, START = 10, 3.0
#: Length of each motion without a force [s]. The signals of one motion fit into the memory.
PART = 120.0
#: Covariance with which contacts are detected: whether it includes the assumed change of the efforts between days.
DAYS = {"same day": False, "another day": True}


@dataclasses.dataclass
class Signals:
    """Measured signals of an arm at 1 kHz, and the true force (m, 3) at the tip in the base frame [N]."""

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    tau: NDArray[np.float64]
    force: NDArray[np.float64]


class Contacts(LeafSystem):
    """Forces on the tip at given times."""

    def __init__(self, arm: Arm, starts: NDArray[np.float64], forces: NDArray[np.float64]) -> None:
        super().__init__()
        self._frame, self._starts, self._forces = ArmFrame(arm), starts, forces
        self.DeclareVectorInputPort("state", 2 * arm.num_joints)
        self.DeclareVectorOutputPort("effort", arm.num_joints, self._calc_effort)
        self.DeclareVectorOutputPort("force", 3, self._calc_force, {self.time_ticket()})

    def _force(self, t: float) -> NDArray[np.float64]:
        k = int(np.searchsorted(self._starts, t)) - 1
        since = t - self._starts[k] if k >= 0 else -1.0
        share = max(0.0, min(1.0, since / RAMP, (DURATION - since) / RAMP))
        return share * self._forces[k] if share else np.zeros(3)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._force(context.get_time()))

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        q = self.get_input_port().Eval(context)[: output.size()]
        output.SetFromVector(self._force(context.get_time()) @ self._frame.jacobian(q)[3:])


def simulated(arm: Arm, motion: PeriodicMotion, seconds: float, contacts: int, seed: int) -> Signals:
    """Simulates an arm with all effects that follows a motion while forces act on its tip."""
    generator = np.random.default_rng(seed)
    t = np.arange(round(seconds * 200) + 1) / 200
    q = dataclasses.replace(motion, repetitions=int(np.ceil(seconds / motion.period))).evaluate(t)[0]
    zero = np.zeros(arm.num_joints)
    path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(t, q.T, zero, zero)
    starts = START + np.cumsum(DURATION + generator.uniform(*PAUSES, contacts))
    directions = generator.normal(size=(contacts, 3))
    sizes = generator.uniform(*FORCES, contacts) / np.linalg.norm(directions, axis=1)
    builder, name = DiagramBuilder(), arm.name.lower()
    station = builder.AddSystem(ArmStation(arm, effects=arm.effects, seed=seed))
    controller = GravityPidController(IdentifiedModel.from_arm(arm))
    add_closed_loop(builder, station, controller, TrajectorySource(path, output_derivative_order=1))
    acting = builder.AddSystem(Contacts(arm, starts, sizes[:, None] * directions))
    builder.Connect(station.GetOutputPort(f"{name}.state_true"), acting.get_input_port())
    builder.Connect(acting.GetOutputPort("effort"), station.GetInputPort(f"{name}.effort_disturbance"))
    ports = [station.GetOutputPort(f"{name}.{port}") for port in ("state_estimated", "effort_measured")]
    logs = [LogVectorOutput(port, builder, 1e-3) for port in (*ports, acting.GetOutputPort("force"))]
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    station.SetPositions(station.GetMyMutableContextFromRoot(root), q[0])
    simulator.AdvanceTo(seconds)
    state, tau, force = (log.FindLog(root).data().T for log in logs)
    return Signals(logs[0].FindLog(root).sample_times(), *np.split(state, 2, axis=1), tau, force)


def kept(path: Path, arm: Arm, motion: PeriodicMotion, seconds: float, contacts: int, seed: int) -> Signals:
    """Reads the signals of a file, or simulates them and writes the file."""
    if not path.exists():
        np.savez(path, **vars(simulated(arm, motion, seconds, contacts, seed)))
    with np.load(path) as arrays:
        return Signals(**arrays)


def identified(path: Path, arm: Arm) -> IdentifiedModel:
    """Reads the model, or identifies it from one designed motion and writes it."""
    if not path.exists():
        motion = design_excitation(arm, duration=30.0, starts=1).motion
        signals = simulated(arm, motion, 30.0, 0, 1)
        rows = slice(None, None, 5)
        recording = Recording(q=signals.q[rows], qd=signals.v[rows], tau=signals.tau[rows], t=signals.t[rows])
        identify(recording, arm).save(path)
    return IdentifiedModel.load(path)


def observed(model: IdentifiedModel, signals: Signals, bandwidth: float) -> tuple[NDArray, NDArray, NDArray]:
    """Returns the poses, external efforts and their covariances at the compared rows."""
    observer = MomentumObserver(model, bandwidth=bandwidth)
    state, rows = observer.start(), []
    for k, measured in enumerate(zip(signals.q, signals.v, signals.tau, strict=True)):
        observer.update(state, *measured)
        if k % EVERY == 0:
            rows.append((observer.pose(state), observer.effort(state), observer.covariance(state, other_day=False)))
    q, effort, covariance = map(np.array, zip(*rows, strict=True))
    return q, effort, covariance


def detected(model: IdentifiedModel, signals: Signals, bandwidth: float) -> NDArray[np.bool_]:
    """Returns whether a contact is detected at the compared rows, with the covariance of each of `DAYS` (m, 2)."""
    observer = MomentumObserver(model, bandwidth=bandwidth)
    state, threshold, rows = observer.start(), observer.threshold(1.0), []
    for k, measured in enumerate(zip(signals.q, signals.v, signals.tau, strict=True)):
        observer.update(state, *measured)
        if k % EVERY == 0:
            rows.append([observer.significance(state, other_day=other_day) > threshold for other_day in DAYS.values()])
    return np.array(rows)


def false_alarms(model: IdentifiedModel, minutes: float, bandwidth: float) -> tuple[NDArray[np.int_], float]:
    """Returns the number of false alarms for each of `DAYS` (2,), and the simulated time without a force [min].

    Each part of the time has a random motion of its own, because one motion repeats its errors.
    """
    alarms, used, part = np.zeros(2, int), 0.0, 0
    while used < 60 * minutes:
        seconds = min(PART, 60 * minutes - used)
        motion = random_motion(model.arm, MotionLimits(), 20.0, 6, np.random.default_rng(100 + part))
        found = detected(model, simulated(model.arm, motion, START + seconds, 0, 100 + part), bandwidth)
        alarms += np.sum(np.diff(found[round(START * 1e3 / EVERY) :].astype(int), axis=0) == 1, axis=0)
        used, part = used + seconds, part + 1
        print(f"{used / 60:.0f} min without a force: {alarms} false alarms", file=sys.stderr, flush=True)
    return alarms, used / 60


def contact_cells(signals: Signals, alarms: NDArray[np.bool_]) -> list[str]:
    """Returns the shares of the detected contacts for each range of forces, and the median time to the detection."""
    size = np.linalg.norm(signals.force[::EVERY], axis=1)
    acts = np.concatenate([[False], size > 0, [False]])
    starts, ends = (np.flatnonzero(acts[1:].astype(int) - acts[:-1] == sign) for sign in (1, -1))
    times = [
        next((k for k in range(end - start) if alarms[start + k]), -1) for start, end in zip(starts, ends, strict=True)
    ]
    largest = np.array([np.max(size[start:end]) for start, end in zip(starts, ends, strict=True)])
    cells = []
    for low, high in SIZES:
        hits = [time >= 0 for time, force in zip(times, largest, strict=True) if low <= force < high]
        cells.append(f"{sum(hits)} of {len(hits)}")
    return [*cells, f"{np.median([time for time in times if time >= 0]) * EVERY:.0f} ms"]


def low_pass(x: NDArray[np.float64], bandwidth: float) -> NDArray[np.float64]:
    """Returns the first-order low-pass of x (m, k) at 1 kHz."""
    out, share = np.empty_like(x), 1 - np.exp(-1e-3 * bandwidth)
    y = x[0]
    for k, row in enumerate(x):
        y = y + share * (row - y)
        out[k] = y
    return out


def console_forces(arm: Arm, signals: Signals, bandwidth: float) -> NDArray[np.float64]:
    """Returns the forces (m, 3) that the dVRK computes, without the joint that is not part of its Jacobian."""
    part = np.array([name != arm.separate_joint for name in arm.joint_names])
    exact = IdentifiedModel.from_arm(arm)
    effort = low_pass(signals.tau - exact.holding_torque(signals.q), bandwidth)[::EVERY]
    poses, tip = low_pass(signals.q, bandwidth)[::EVERY], ArmFrame(arm)
    wrenches = [
        np.linalg.lstsq(tip.jacobian(q)[:, part].T, -tau[part], rcond=None)[0]
        for q, tau in zip(poses, effort, strict=True)
    ]
    return np.array(wrenches)[:, 3:]


def delay(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Returns the delay [s] of an estimate with the smallest error."""
    errors = [np.sum((estimate[k:] - truth[: len(truth) - k]) ** 2) / (len(truth) - k) for k in range(30)]
    return int(np.argmin(errors)) * EVERY * 1e-3


def without_friction(model: IdentifiedModel) -> IdentifiedModel:
    """Returns the model without friction, but with its stated errors."""
    assert model.dynamics is not None
    effects = [effect for effect in model.dynamics.effects if effect.kind in POSITION_KINDS]
    return dataclasses.replace(model, dynamics=dataclasses.replace(model.dynamics, effects=effects))


def rms(x: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(x**2)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", default="psm", help="name of the arm; default: %(default)s")
    parser.add_argument("--contacts", type=int, default=200, help="number of contacts; default: %(default)s")
    parser.add_argument(
        "--free-minutes", type=float, default=30.0, help="simulated minutes without a force; default: %(default)s"
    )
    parser.add_argument("--bandwidth", type=float, default=BANDWIDTH, help="bandwidth [rad/s]; default: %(default)s")
    parser.add_argument("--folder", type=Path, help="folder that keeps the recordings and the model")
    options = parser.parse_args()
    arm, bandwidth = load_arm(options.arm), options.bandwidth
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        model = identified(folder / f"{arm.name}.yaml", arm)
        motion = random_motion(arm, MotionLimits(), 20.0, 6, np.random.default_rng(5))
        seconds = START + options.contacts * (DURATION + PAUSES[1])
        signals = kept(folder / f"{arm.name}_contacts.npz", arm, motion, seconds, options.contacts, 2)
    contact, rows, compared = Contact(arm), {}, signals.t[::EVERY] >= START
    truth = signals.force[::EVERY]
    filtered = low_pass(signals.force, bandwidth)[::EVERY]
    estimates = {}
    for name, used in (("observer", model), ("without friction", without_friction(model))):
        force, covariance = contact.force(*observed(used, signals, bandwidth))
        estimates[name] = force, half_width(1.0, None) * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    estimates["dVRK's method"] = console_forces(arm, signals, bandwidth), None
    for name, (force, width) in estimates.items():
        error, no_delay = (force - x for x in (truth, filtered))
        inside = "" if width is None else f"{100 * np.mean((np.abs(no_delay) <= width)[compared]):.1f} %"
        rows[name] = (
            f"{rms(error[compared]):.3f} N",
            f"{100 * rms(error[compared]) / FORCES[1]:.1f} %",
            f"{rms(no_delay[compared]):.3f} N",
            f"{100 * rms(no_delay[compared]) / FORCES[1]:.1f} %",
            f"{1e3 * delay(force[compared], truth[compared]):.0f} ms",
            inside,
        )
    heading = ["error", "share of 10 N", "without delay", "share of 10 N", "delay", "inside the interval"]
    print_table(f"{arm.name}, {options.contacts} contacts, bandwidth {bandwidth:g} rad/s", heading, rows)
    print(f"median interval: +- {np.median(estimates['observer'][1]):.2f} N\n")
    alarms, minutes = false_alarms(model, options.free_minutes, bandwidth)
    found = {
        name: (f"{count} in {minutes:.0f} min", *contact_cells(signals, hits))
        for name, count, hits in zip(DAYS, alarms, detected(model, signals, bandwidth).T, strict=True)
    }
    heading = ["false alarms", *(f"{low:g} to {high:g} N" for low, high in SIZES), "median time to detection"]
    print_table("Detected contacts", heading, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
