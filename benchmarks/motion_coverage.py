"""Coverage of the 95 % intervals of `identify` on motions of simulated arms, with the right effects.

    python benchmarks/motion_coverage.py [--arms 16] [--noise 0.05] [--spread 0.15]

Every arm has links and rotors of its own: the SDF's, sheared and shifted by `spread` of their size, but inside of their
boxes. At 0.15 the masses differ from the SDF's by 30 % (1 sigma), as the prior of `identify` expects. The drives have
viscous, Coulomb and presliding friction. The motion has a period of 10 s and is recorded for 20 s at 200 Hz. Noise of
the efforts is white, a share of each one's RMS. Takes some minutes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from dvrk_drake.analysis.dynamic.dynamic_identification import motion_problem, residuals
from dvrk_drake.analysis.dynamic.estimates import parameter_covariance
from dvrk_drake.analysis.signals.motion_grid import default_settings, motion_grid
from dvrk_drake.analysis.signals.repetition import period_of
from dvrk_drake.dynamics.dynamic_regressor import derive_base_parameters
from dvrk_drake.models.arm import Arm, load_arm

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from motions import fourier_motion, friction_everywhere, recorded, true_dynamics

RATE = 1000.0


def main() -> int:
    """A few lines an arm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=16)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--spread", type=float, default=0.15)
    options = parser.parse_args()
    print("95 % intervals that hold the truth, and RMS errors in standard errors:")
    for name in ("mtmr", "psm"):
        arm = load_arm(name)
        z, share, of_effects = map(
            np.concatenate,
            zip(*(errors(arm, seed, options.noise, options.spread) for seed in range(options.arms)), strict=True),
        )
        report(f"{arm.name}, base parameters", z)
        for lower, upper in zip((0.0, 0.1, 0.5), (0.1, 0.5, np.inf), strict=True):
            which = (share >= lower) & (share < upper)
            report(f"    standard error {lower:g} to {upper:g} of what the prior alone leaves", z[which])
        report(f"{arm.name}, effects", of_effects)
    return 0


def report(what: str, z: np.ndarray) -> None:
    """One line."""
    print(f"{what:70} {np.mean(np.abs(z) < 1.96):6.1%} of {len(z):4d}, {np.sqrt(np.mean(z**2)):.2f}", flush=True)


def errors(arm: Arm, seed: int, noise: float, spread: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of base parameters in standard errors, these as shares of the prior's, and errors of the effects."""
    generator = np.random.default_rng(seed)
    motion = fourier_motion(arm, generator, 10.0, 20.0, RATE)
    truth = true_dynamics(arm, generator, friction_everywhere(arm, motion), spread)
    recording = recorded(truth, motion, noise, generator)
    grid = motion_grid(recording, arm, default_settings(arm))
    period = period_of(grid)
    problem = motion_problem(grid, recording.in_actuator_coordinates(arm).measured_effort(), period, truth.effects)
    chosen = np.arange(len(truth.effects))
    selection = problem.selection()
    selection.fit(chosen)
    fit = problem.consistent(chosen, selection.weights)
    left = residuals(problem, chosen, fit)
    cut_off = grid.settings.effort_cut_off
    covariance = parameter_covariance(problem, fit, left, grid.rate, cut_off, period)
    p = problem.num_rigid
    B = derive_base_parameters(problem.regressor).combination[:, :p]
    B = B[np.any(B, axis=1)]
    spread = np.sqrt(np.diag(B @ covariance[:p, :p] @ B.T))
    before = np.sqrt(np.diag(B @ np.diag(problem.deviation**2) @ B.T))
    z = B @ (fit.x[:p] - truth.parameters[:p]) / spread
    return z, spread / before, (fit.x[p:] - truth.coefficients) / np.sqrt(np.diag(covariance))[p:]


if __name__ == "__main__":
    sys.exit(main())
