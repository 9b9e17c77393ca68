"""Measures the coverage of the 95 % intervals of `identify` on simulated motions, with the true effects given.

    python benchmarks/motion_coverage.py [--arms 16] [--noise 0.05] [--spread 0.15]

Each arm has different links and rotors. The links are those of the SDF, randomly sheared and shifted by about the share
`spread` of their size, inside their bounding boxes. At 0.15 the masses differ from those of the SDF by 30 % (1 sigma),
as in the prior of `identify`. The drives have viscous, Coulomb and presliding friction. The motion has a period of
10 s and is recorded for 20 s at 200 Hz. The efforts have white noise. Its standard deviation is the share `noise` of
the RMS effort. The script takes several minutes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from dvrk_drake.analysis.estimation.motion_estimates import ResidualSeries, parameter_covariance
from dvrk_drake.analysis.estimation.motion_problem import ConsistentFit
from dvrk_drake.analysis.motion_identification import motion_problem
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.dynamics.dynamic_regressor import derive_base_parameters
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import half_width

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from motions import fourier_motion, friction_everywhere, recorded, true_dynamics

RATE = 1000.0


def main() -> int:
    """Prints the coverage for each arm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=16, help="number of simulated arms; default: %(default)s")
    parser.add_argument(
        "--noise",
        type=float,
        default=0.05,
        help="standard deviation of the noise, as a share of the RMS effort; default: %(default)s",
    )
    parser.add_argument(
        "--spread", type=float, default=0.15, help="size of the changes of the links, see above; default: %(default)s"
    )
    options = parser.parse_args()
    print("coverage of the 95 % intervals, number of intervals, RMS error / standard error:")
    for name in ("mtmr", "psm"):
        arm = load_arm(name)
        z, share, z_effects = map(
            np.concatenate,
            zip(*(errors(arm, seed, options.noise, options.spread) for seed in range(options.arms)), strict=True),
        )
        report(f"{arm.name}, base parameters", z)
        for lower, upper in zip((0.0, 0.1, 0.5), (0.1, 0.5, np.inf), strict=True):
            which = (share >= lower) & (share < upper)
            report(f"    standard error {lower:g} to {upper:g} times that of the prior", z[which])
        report(f"{arm.name}, effects", z_effects)
    return 0


def report(what: str, z: np.ndarray) -> None:
    """Prints one row; z (k,) are errors divided by their standard errors."""
    coverage = 100 * np.mean(np.abs(z) < 1.96)
    print(f"{what:70} {coverage:5.1f} % of {len(z):4d}, {np.sqrt(np.mean(z**2)):.2f}", flush=True)


def errors(arm: Arm, seed: int, noise: float, spread: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulates and identifies one arm.

    Returns:
        Errors of the base parameters divided by their standard errors, ratios of these standard errors to those of the
        prior, and errors of the effects divided by their standard errors.
    """
    generator = np.random.default_rng(seed)
    motion = fourier_motion(arm, generator, 10.0, 20.0, RATE)
    truth = true_dynamics(arm, generator, friction_everywhere(arm, motion), spread)
    recording = recorded(truth, motion, noise, generator)
    observations = Observations(recording, arm)
    grid, period = observations.grid, observations.period
    problem = motion_problem([observations], truth.effects)
    chosen = np.arange(len(truth.effects))
    selection = problem.selection()
    selection.fit_with(chosen)
    fit = ConsistentFit(problem, chosen, selection.selection.weights)
    residual = problem.columns.tau - problem.predict(chosen, fit.x)
    cut_off = grid.settings.effort_cut_off
    series = [ResidualSeries(slice(0, len(residual)), grid.rate, period)]
    covariance, prior, freedom = parameter_covariance(problem, fit, residual, cut_off, series)
    p = problem.num_rigid
    B = derive_base_parameters(problem.regressor).combination[:, :p]
    B = B[np.any(B, axis=1)]
    standard_error = np.sqrt(np.diag(B @ covariance[:p, :p] @ B.T))
    prior_error = np.sqrt(np.diag(B @ prior[:p, :p] @ B.T))
    z = B @ (fit.x[:p] - truth.parameters[:p]) / standard_error
    z_effects = (fit.x[p:] - truth.coefficients) / np.sqrt(np.diag(covariance))[p:]
    # A normal distribution has the same share inside 1.96 standard errors as Student's distribution inside its limits.
    scale = half_width(1.0, None) / half_width(1.0, freedom)
    return scale * z, standard_error / prior_error, scale * z_effects


if __name__ == "__main__":
    sys.exit(main())
