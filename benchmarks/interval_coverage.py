"""Measures the coverage of the 95 % intervals of `identify` and the number of wrongly selected effects.

    python benchmarks/interval_coverage.py [--recordings 30] [--poses 40] [--noise 0.02]

The recordings are simulated static poses of an arm with two cable torques. The noise is Gaussian. Its standard
deviation is a share of each joint's effort limit.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from dvrk_drake.analysis.estimation.pose_effects import StaticProblem
from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.holding_torque import static_model
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import half_width
from dvrk_drake.recordings.recording import Recording

TRUE_EFFECTS = {
    ActuatorEffect("joint.wrist_platform", "cable sine", 1.0): 0.05,
    ActuatorEffect("joint.wrist_pitch", "cable sine", 1.0): -0.05,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--recordings", type=int, default=30, help="number of simulated recordings; default: %(default)s"
    )
    parser.add_argument("--poses", type=int, default=40, help="number of poses per recording; default: %(default)s")
    parser.add_argument(
        "--noise",
        type=float,
        default=0.02,
        help="standard deviation of the noise, as a share of the effort limits; default: %(default)s",
    )
    options = parser.parse_args()
    arm = load_arm("mtmr")
    truth = static_model(arm, tuple(TRUE_EFFECTS))
    beta = truth.gravity.base_values
    theta = np.array([*beta, *TRUE_EFFECTS.values()])
    base, effects, correct, spurious = [], [], [], 0
    for seed in range(options.recordings):
        generator = np.random.default_rng(seed)
        q = arm.sample_poses(options.poses, generator, margin=0.05)
        tau = truth.torque(q, [*beta, *TRUE_EFFECTS.values()])
        tau += options.noise * arm.effort_limits * generator.normal(size=q.shape)
        robust = StaticProblem(arm, q, tau, np.ones(q.shape, dtype=bool)).fit(tuple(TRUE_EFFECTS))
        errors = zip(np.sqrt(np.diag(robust.fit.covariance)), robust.degrees_of_freedom, strict=True)
        correct.append(np.abs(robust.fit.theta - theta) < [half_width(*error) for error in errors])
        model = identify_static(Recording(q=q, tau=tau, source=f"seed {seed}"), arm).model
        for estimate, value in zip(model.base_parameters, beta, strict=True):
            half = half_width(estimate.standard_error, estimate.degrees_of_freedom)
            base.append(abs(estimate.value - value) < half)
        for e in model.effects:
            value = TRUE_EFFECTS.get(ActuatorEffect.of(e))
            spurious += value is None
            half = half_width(e.standard_error, e.degrees_of_freedom)
            effects.append(abs(e.coefficient - (value or 0.0)) < half)
    print(f"{options.recordings} recordings of {options.poses} poses, noise {100 * options.noise:g} % of the limits")
    print("coverage of the 95 % intervals:")
    base_given, effects_given = np.array(correct)[:, : len(beta)], np.array(correct)[:, len(beta) :]
    print(f"    selected effects: base parameters {100 * np.mean(base):.0f} %, effects {100 * np.mean(effects):.0f} %")
    shares = [100 * np.mean(values) for values in (base_given, effects_given)]
    print(f"    true effects given: base parameters {shares[0]:.0f} %, effects {shares[1]:.0f} %")
    print(f"wrongly selected effects per recording: {spurious / options.recordings:.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
