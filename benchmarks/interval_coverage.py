"""Coverage of the 95 % intervals of `identify`, and share of selected effects that are not in the arm.

    python benchmarks/interval_coverage.py [--recordings 30] [--poses 40] [--noise 0.02]

Simulated recordings of an arm with two springs; noise is Gaussian, a share of each joint's effort limit.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from dvrk_drake.analysis.static.effect_selection import StaticProblem
from dvrk_drake.analysis.static.static_identification import identify_static
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.static_model import compile_static_model
from dvrk_drake.models.arm import load_arm
from dvrk_drake.recordings.recording import Recording

TRUE_EFFECTS = {
    ActuatorEffect("joint.wrist_platform", "cable sine", 1.0): 0.05,
    ActuatorEffect("joint.wrist_pitch", "cable sine", 1.0): -0.05,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=30)
    parser.add_argument("--poses", type=int, default=40)
    parser.add_argument("--noise", type=float, default=0.02)
    options = parser.parse_args()
    arm = load_arm("mtmr")
    truth = compile_static_model(arm, tuple(TRUE_EFFECTS))
    beta = truth.gravity.base_values
    theta = np.array([*beta, *TRUE_EFFECTS.values()])
    base, effects, given, spurious = [], [], [], 0
    for seed in range(options.recordings):
        generator = np.random.default_rng(seed)
        q = arm.sample_poses(options.poses, generator, margin=0.05)
        tau = truth.torque(q, [*beta, *TRUE_EFFECTS.values()])
        tau += options.noise * arm.effort_limits * generator.normal(size=q.shape)
        right = StaticProblem(arm, q, tau, np.ones(q.shape, dtype=bool)).fit(tuple(TRUE_EFFECTS)).fit
        given.append(np.abs(right.theta - theta) < 1.96 * np.sqrt(np.diag(right.covariance)))
        model = identify_static(Recording(q=q, tau=tau, source=f"seed {seed}"), arm).model
        for estimate, value in zip(model.base_parameters, beta, strict=True):
            base.append(abs(estimate.value - value) < 1.96 * estimate.standard_error)
        for e in model.effects:
            value = TRUE_EFFECTS.get(ActuatorEffect.of(e))
            spurious += value is None
            effects.append(abs(e.coefficient - (value or 0.0)) < 1.96 * e.standard_error)
    print(f"{options.recordings} recordings of {options.poses} poses, noise {options.noise:g} of the effort limit")
    print(f"95 % intervals hold the truth: base parameters {np.mean(base):.0%}, chosen effects {np.mean(effects):.0%}")
    of_base, of_effects = np.mean(np.array(given)[:, : len(beta)]), np.mean(np.array(given)[:, len(beta) :])
    print(f"the same, given which effects there are: base parameters {of_base:.0%}, effects {of_effects:.0%}")
    print(f"effects chosen that are not there: {spurious / options.recordings:.1f} a recording")
    return 0


if __name__ == "__main__":
    sys.exit(main())
