"""Makes the sample recordings dvrk_drake/samples/*.csv by simulation, in about two minutes.

python tools/make_samples.py

The simulated arms have the friction, cables, stops, encoders, motors and delays of their arm files, except that the MTM
has no wrist spring. The masses of their links differ from the SDF by up to 20 %, so the nominal model is wrong.
Repeated runs on the same computer with the same packages give the same files.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

import dvrk_drake as dvrk
from dvrk_drake.cli.support import Steps
from dvrk_drake.experiments.ground_truth import collect
from dvrk_drake.experiments.simulation import advance, sample_times, samples
from dvrk_drake.models.arm import Arm
from dvrk_drake.progress import step_progress
from dvrk_drake.recordings.formats import SAMPLES, SAMPLES_FOLDER

#: Seed of the masses, poses, motions and noise. Number of poses.
SEED, POSES = 18, 60
#: Effects that a simulated arm does not have.
WITHOUT = {"mtmr": ("springs",)}
#: Seed of each set of poses.
POSE_SEEDS = {"mtm_poses": SEED, "mtm_other_poses": SEED + 1}
#: Sampling rate [Hz] and duration [s] of a recorded motion. The simulation begins LEAD_IN [s] before the recording.
RATE, DURATION, LEAD_IN = 100.0, 30.0, 2.0
#: Period of a motion [s], and number of harmonics of the Fourier series of each joint.
PERIOD, HARMONICS = 10.0, 5
#: Smallest distance from a limit, as a share of the range of the limit.
MARGIN = 0.02
#: Middle of the range and half of the range of each joint in the motion [rad, m].
RANGES = {
    "mtmr": ((-0.2, 0.40, -0.20, 0.5, 0.7, 0.0, 0.0), (0.75, 0.42, 0.38, 1.3, 1.5, 0.6, 1.8)),
    "psm": ((0.0, 0.0, 0.13, 0.0, 0.0, 0.0, 0.3), (1.0, 0.7, 0.09, 1.6, 0.9, 0.9, 0.6)),
}
#: Decimal places: at least the resolution of the encoders and of the measured currents.
DECIMALS = {"t": 3, "q": 6, "qd": 4, "tau": 5}


def static_poses(simulated_arm: Arm, seed: int, progress: Callable[[float], object]) -> dvrk.Recording:
    """Returns static poses as `dvrk-drake collect` records them: means over two approach directions."""
    with ThreadPoolExecutor(1) as executor:
        return collect(simulated_arm, POSES, seed, executor, progress)


def motion(simulated_arm: Arm, progress: Callable[[float], object]) -> dvrk.Recording:
    """Returns an excitation motion under position control.

    A dVRK computes velocities from the time between two encoder counts, with small error and delay. Therefore qd is the
    true velocity instead of the filtered velocity of the simulated encoders.
    """
    arm, effects, name = dvrk.load_arm(simulated_arm.source), simulated_arm.effects, simulated_arm.source
    trajectory = desired_motion(arm)
    station = dvrk.ArmStation(simulated_arm, effects=effects, seed=SEED)
    controller = dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm, effects.position_dependent))
    builder = DiagramBuilder()
    dvrk.add_closed_loop(builder, station, controller, TrajectorySource(trajectory, output_derivative_order=1))
    logs = [
        LogVectorOutput(station.GetOutputPort(f"{name}.{port}"), builder, 1 / RATE)
        for port in ("position_measured", "state_true", "effort_measured")
    ]
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    station.SetPositions(context, trajectory.value(0.0)[:, 0])
    t = sample_times(LEAD_IN + DURATION, 1 / RATE)
    advance(simulator, t, progress)
    q, state, tau = (samples(log, simulator)[t >= LEAD_IN - 1e-9] for log in logs)
    return dvrk.Recording(q=q, qd=state[:, arm.num_joints :], tau=tau, t=np.arange(len(q)) / RATE)


def desired_motion(arm: Arm) -> PiecewisePolynomial:
    """Returns a periodic motion within the limits of the arm: one random Fourier series per joint."""
    middle, half_range = RANGES[arm.name.lower()]
    generator = np.random.default_rng(SEED)
    t = sample_times(LEAD_IN + DURATION + 1.0, 0.01)
    k, w = np.arange(1, HARMONICS + 1)[:, None], 2 * np.pi / PERIOD
    sine, cosine = np.sin(w * k * t).T, np.cos(w * k * t).T
    A, lower, upper = arm.limit_matrix()
    inset = MARGIN * (upper - lower)
    while True:
        a, b = generator.normal(size=(2, HARMONICS, arm.num_joints)) / np.sqrt(k)
        q, qd = sine @ a + cosine @ b, w * (cosine @ (k * a) - sine @ (k * b))
        scale = 2 * np.array(half_range) / np.ptp(q, axis=0)
        q = middle + scale * (q - (q.max(axis=0) + q.min(axis=0)) / 2)
        if np.all((q @ A.T > lower + inset) & (q @ A.T < upper - inset)):
            return PiecewisePolynomial.CubicHermite(t, q.T, (scale * qd).T)


def rounded(recording: dvrk.Recording) -> dvrk.Recording:
    """Returns a recording with `DECIMALS` decimal places."""

    def part(name: str) -> NDArray[np.float64] | None:
        values = getattr(recording, name)
        return None if values is None else np.round(values, DECIMALS[name]) + 0.0  # -0.0 + 0.0 is 0.0

    return replace(recording, **{name: part(name) for name in DECIMALS})


def main() -> None:
    """Simulates and writes the sample recordings."""
    logging.getLogger("drake").setLevel(logging.WARNING)
    SAMPLES_FOLDER.mkdir(exist_ok=True)
    with TemporaryDirectory() as folder, Steps(*SAMPLES) as steps:
        for sample, arm in SAMPLES.items():
            path, without = Path(folder) / f"{arm}.sdf", WITHOUT.get(arm, ())
            simulated_arm = dvrk.perturbed_arm(dvrk.load_arm(arm), path, SEED, without=without)
            progress = step_progress(steps, sample)
            if sample in POSE_SEEDS:
                recording = static_poses(simulated_arm, POSE_SEEDS[sample], progress)
            else:
                recording = motion(simulated_arm, progress)
            dvrk.write_recording(rounded(recording), SAMPLES_FOLDER / f"{sample}.csv")


if __name__ == "__main__":
    main()
