"""Releases of a simulated arm with all effects under the gravity compensation of a calibration.

    python benchmarks/calibrated_releases.py CALIBRATION [--releases 200]

CALIBRATION is a folder of `dvrk-drake calibrate`. The arm is released at random poses and moves freely for 10 s. A
release passes if no joint is ever further than 15 mrad (1.5 mm for the insertion) from its release pose. Without an
approach, the arm is released at rest. With an approach, it first moves to the pose by 0.2 rad (20 mm) in all joints,
which loads the friction. The models are static.yaml and model.yaml of the calibration, and the exact model. Poses at
which the exact holding effort exceeds the limit of a motor are omitted, because no model can hold the arm there.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from timing import print_table

import dvrk_drake as dvrk
from dvrk_drake.experiments.reproduction.drift_experiment import BAND, Drifts, Release, release_all


def main() -> None:
    """Prints a table of the releases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", type=Path, help="folder of a calibration")
    parser.add_argument("--releases", type=int, default=200, help="number of releases; default: %(default)s")
    parser.add_argument("--models", nargs="+", default=["static", "model", "exact"], help="models; default: all")
    parser.add_argument("--seed", type=int, default=12345, help="seed of the poses; default: %(default)s")
    options = parser.parse_args()
    arm = dvrk.IdentifiedModel.load(options.calibration / "static.yaml").arm
    true = dvrk.IdentifiedModel.from_arm(arm, arm.effects.position_dependent)
    sampled = arm.sample_poses(4 * options.releases, np.random.default_rng(options.seed), margin=0.05)
    can_hold = np.all(np.abs(true.holding_torque(sampled)) <= arm.effort_limits, axis=1)
    poses = sampled[can_hold][: options.releases]
    print(f"{100 * np.mean(~can_hold):.0f} % of the poses are omitted, because a motor is too weak")
    rows = {}
    with ProcessPoolExecutor() as executor, TemporaryDirectory() as folder:
        exact = Path(folder) / "exact.yaml"
        true.save(exact)
        for name in options.models:
            path = str(exact if name == "exact" else options.calibration / f"{name}.yaml")
            for what, with_approach in (("at rest", False), ("after an approach", True)):
                cases = [
                    Release(arm.name.lower(), arm, ("all",), path, pose, with_approach=with_approach, seed=k)
                    for k, pose in enumerate(poses)
                ]
                drifts = Drifts(arm, release_all(cases, executor))
                share = drifts.largest / arm.per_joint(*BAND)
                rows[f"{name}, {what}"] = [
                    f"{drifts.num_held} of {len(cases)}",
                    *(f"{15 * x:.1f}" for x in share.max(axis=0)),
                ]
    headings = [
        "within 15 mrad",
        *(f"{name} [{'0.1 mm' if p else 'mrad'}]" for name, p in zip(arm.joint_names, arm.prismatic, strict=True)),
    ]
    print_table(f"{arm.name}: releases, and largest distance of each joint from its release pose", headings, rows)


if __name__ == "__main__":
    main()
