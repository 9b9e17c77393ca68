"""Compares identification from designed, published and random motions, on simulated arms with known dynamics.

    python benchmarks/excitation.py FOLDER [--arms 20] [--tests 20] [--first 0] [--jobs 1]

FOLDER contains mtm_one.csv and psm_one.csv (docs/public_recordings.md), of which only the positions are used. Each
motion lasts 30 s. The random motion is a Fourier series that reaches the same limits as the designed motion. The links
of each simulated arm differ from those of the SDF, with a standard deviation of 20 % of their mass. Its drives have
viscous, Coulomb and presliding friction of random size. The efforts have noise of 5 % of the RMS effort. The models are
tested on random motions that were not used for identification.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from timing import print_table

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.design import design_excitation
from dvrk_drake.analysis.excitation.information import MotionInformation, random_motion, state_of
from dvrk_drake.analysis.excitation.motion_limits import MotionLimits
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.dynamics.dynamic_regressor import derive_base_parameters
from dvrk_drake.models.arm import Arm

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from motions import friction_everywhere, recorded, true_dynamics

RATE, SECONDS, NOISE, SPREAD = 1000.0, 30.0, 0.05, 0.1
LIMITS = MotionLimits()
#: Period [s] and number of harmonics of the random motions for identification. On simulated arms 5 to 9, the errors are
#: smaller than with a period of 30 s, and equal to those with the period of the test motions.
RANDOM = 15.0, 12
#: Periods of the public motions [s].
PERIODS = {"MTMR": 11.67, "PSM": 6.48}


def published(folder: Path, arm: Arm) -> tuple[np.ndarray, ...]:
    """Returns t, q, v and vd of the positions of the public motion, for `SECONDS` at 1 kHz."""
    recording = dvrk.read_recording(folder / f"{arm.name[:3].lower()}_one.csv", arm, coordinates="wpi")
    grid = Observations(recording, arm).grid
    t = np.arange(round(SECONDS * RATE)) / RATE
    at = np.minimum(t, grid.t[-1] - grid.t[0])
    signals = (np.column_stack([np.interp(at, grid.t - grid.t[0], x) for x in s.T]) for s in (grid.q, grid.v, grid.vd))
    return (t, *signals)


def sampled(motion: dvrk.PeriodicMotion, seconds: float = SECONDS) -> tuple[np.ndarray, ...]:
    """Returns t, q, v and vd of a periodic motion at 1 kHz."""
    motion = dataclasses.replace(motion, repetitions=int(np.ceil(seconds / motion.period)))
    t = np.arange(round(seconds * RATE)) / RATE
    return (t, *motion.evaluate(t)[:3])


def main() -> None:
    """Prints two tables per arm: expected errors, and errors of identified models."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the public motions")
    parser.add_argument("--arms", type=int, default=20, help="number of simulated arms; default: %(default)s")
    parser.add_argument("--tests", type=int, default=20, help="number of test motions per arm; default: %(default)s")
    parser.add_argument("--first", type=int, default=0, help="number of the first simulated arm; default: %(default)s")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes; default: %(default)s")
    parser.add_argument("--arm", choices=("mtmr", "psm"), help="only this arm")
    options = parser.parse_args()
    for name in (options.arm,) if options.arm else ("mtmr", "psm"):
        seeds = range(options.first, options.first + options.arms)
        compare(dvrk.load_arm(name), options.folder, seeds, options.tests, options.jobs)


def simulated_arm(
    arm: Arm, tests: int, motions: Mapping[str, tuple[np.ndarray, ...]], seed: int
) -> dict[str, np.ndarray]:
    """Identifies one simulated arm from each motion.

    Returns:
        Name of the motion -> relative effort errors (n,) of the model, and the number of base parameters within 10 % of
        their true values.
    """
    rng = np.random.default_rng(seed)
    # The widths and travels of the friction are those of another random motion.
    friction = friction_everywhere(arm, sampled(random_motion(arm, LIMITS, 10.0, 6, rng)), 0.15)
    effects = [dataclasses.replace(e, coefficient=e.coefficient * rng.uniform(0.5, 1.5)) for e in friction]
    truth = true_dynamics(arm, rng, effects, SPREAD)
    others = [sampled(random_motion(arm, LIMITS, 10.0, 6, rng), 12.0) for _ in range(tests)]
    unseen = [recorded(truth, other, 0.0, rng) for other in others]
    to_base = derive_base_parameters(truth.regressor).combination
    true_values = to_base @ truth.parameters[: to_base.shape[1]]
    results = {}
    for which, motion in motions.items():
        model = identify_dynamic([Observations(recorded(truth, motion, NOISE, rng), arm)]).model
        found = [
            [a.relative_error for a in validate_motion(model, Observations.for_model(test, model)).actuators]
            for test in unseen
        ]
        deviations = to_base @ model.dynamic_model.parameters[: to_base.shape[1]] - true_values
        within = np.sum(np.abs(deviations) <= 0.1 * np.abs(true_values))
        results[which] = np.append(np.mean(found, axis=0), within)
    return results


def compare(arm: Arm, folder: Path, seeds: range, tests: int, jobs: int) -> None:
    """Prints the tables of one arm."""
    start = time.perf_counter()
    design = design_excitation(arm, duration=SECONDS, limits=LIMITS)
    print(f"{arm.name}: design of {SECONDS:g} s in {time.perf_counter() - start:.0f} s", flush=True)
    generator = np.random.default_rng(100)
    randoms = [random_motion(arm, LIMITS, *RANDOM, generator) for _ in range(seeds.stop)][seeds.start :]
    public = published(folder, arm)
    information = MotionInformation(arm, LIMITS)

    def expected(state: np.ndarray, period: float) -> list[str]:
        error = 100 * information.expected_error(state, period)
        return [f"{error:.1f}", f"{information.known_parameters(state, period)} of {information.num_base}"]

    one_period = slice(0, round(PERIODS[arm.name] * RATE), 100)
    rows = {
        "designed": expected(state_of(design.motion, 200), design.motion.period),
        "published": expected(np.array([x[one_period] for x in public[1:]]), len(public[0][one_period]) * 0.1),
        "random, median": [
            f"{np.median([100 * information.expected_error(state_of(m, 200), m.period) for m in randoms]):.1f}",
            f"{np.median([information.known_parameters(state_of(m, 200), m.period) for m in randoms]):.0f} of "
            f"{information.num_base}",
        ],
    }
    headings = ["expected error of efforts [%]", "base parameters known to 10 %"]
    print_table(f"{arm.name}: expected results of {SECONDS:g} s", headings, rows)
    motions = [
        {"designed": sampled(design.motion), "published": public, "random": sampled(motion)} for motion in randoms
    ]
    results: list[dict[str, np.ndarray]] = []
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as executor:
        for found in executor.map(partial(simulated_arm, arm, tests), motions, seeds):
            results.append(found)
            print(f"arm {len(results)} of {len(seeds)}", file=sys.stderr, flush=True)
    rows = {
        which: [f"{100 * x:.1f}" for x in (*of, np.mean(of), np.max(of))] + [f"{within:.0f} of {information.num_base}"]
        for which in results[0]
        for *of, within in [np.mean([found[which] for found in results], axis=0)]
    }
    headings = [*arm.joint_names, "mean", "worst joint", "base parameters within 10 %"]
    print_table(f"{arm.name}: relative effort error on {tests} unseen motions of {len(seeds)} arms [%]", headings, rows)


if __name__ == "__main__":
    main()
