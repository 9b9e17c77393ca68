"""Identifies a PSM from a long simulated motion, and prints time and memory.

    python benchmarks/long_recording.py [minutes]

The motion is sampled at 200 Hz. It consists of sines with incommensurate periods, so it does not repeat. The efforts
are those of the model that `identify` finds from the sample motion, with noise.
"""

import resource
import sys
import time

import numpy as np

import dvrk_drake as dvrk
from dvrk_drake.recordings.formats import SAMPLES_FOLDER

RATE, NOISE = 200.0, 0.05


def long_motion(model: dvrk.IdentifiedModel, minutes: float) -> dvrk.Recording:
    """Returns a motion with the efforts of `model` and noise of `NOISE` times the RMS effort."""
    arm, generator = model.arm, np.random.default_rng(0)
    t = np.arange(round(60 * minutes * RATE)) / RATE
    middle, size = (arm.position_lower + arm.position_upper) / 2, (arm.position_upper - arm.position_lower) / 2
    q, qd, vd = (np.zeros((len(t), arm.num_joints)) for _ in range(3))
    for j in range(arm.num_joints):
        for w, phase in zip(generator.uniform(0.5, 4.0, 4), generator.uniform(0, 6.3, 4), strict=True):
            scale = 0.8 * size[j] / 4 * min(1.0, 1.5 / w)
            q[:, j] += scale * np.sin(w * t + phase)
            qd[:, j] += scale * w * np.cos(w * t + phase)
            vd[:, j] -= scale * w**2 * np.sin(w * t + phase)
    q += middle
    dynamics, tau = model.dynamic_model, np.zeros_like(q)
    for rows in np.array_split(np.arange(len(t)), max(1, len(t) // 20_000)):
        tau[rows] = dynamics.effort(q[rows], qd[rows], vd[rows])
    tau += NOISE * np.std(tau, axis=0) * generator.normal(size=tau.shape)
    transmission = arm.transmission
    return dvrk.Recording(
        t=t, q=transmission.position(q), qd=transmission.velocity(qd), tau=tau, coordinates="actuator"
    )


def memory() -> float:
    """Returns the largest memory of the process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    arm = dvrk.load_arm("psm")
    short = dvrk.identify(dvrk.read_recording(SAMPLES_FOLDER / "psm_motion.csv", arm), arm).model
    recording = long_motion(short, minutes)
    print(f"motion of {minutes:g} min: {len(recording)} rows, {memory():.0f} MB before the identification")
    start = time.perf_counter()

    def progress(step: str, share: float) -> None:
        if share == 1.0:
            print(f"{step}: finished after {time.perf_counter() - start:.0f} s, largest memory {memory():.0f} MB")

    result = dvrk.identify(recording, arm, progress=progress)
    errors = [a.rms_cross_validation / a.rms_effort for a in result.model.dynamic_model.section.actuators]
    print("cross-validated errors [%]:", *(f"{100 * error:.1f}" for error in errors))
