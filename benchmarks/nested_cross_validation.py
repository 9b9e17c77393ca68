"""Computes nested cross-validation errors of a motion directly, to check the faster method of `identify`.

    python benchmarks/nested_cross_validation.py MOTION.csv --arm mtmr [--coordinates actuator]

For each fold, the script removes the rows of two twelfths of the period, and of the tenth of a second before and after
them. It then selects the effects and estimates all parameters from the other rows. `identify` instead subtracts the
sums of squares of the fold from those of all rows, and linearises the base tilt. Both errors should be equal.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from dvrk_drake.analysis.estimation.motion_effects import NUM_HELD_OUT_FOLDS, select_effects
from dvrk_drake.analysis.motion_identification import motion_problem
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.observations.repetition import FOLDS
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording


def main() -> None:
    """Prints one row per fold, and the error over all folds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motion", help="recording of the motion")
    parser.add_argument("--arm", required=True, help="name of the arm")
    parser.add_argument(
        "--coordinates",
        choices=("joint", "actuator"),
        default="joint",
        help="coordinates of the recording; default: %(default)s",
    )
    options = parser.parse_args()
    arm = load_arm(options.arm)
    recording = read_recording(options.motion, arm, options.coordinates)
    problem = motion_problem([Observations(recording, arm)])
    squares = np.zeros(arm.num_joints)
    print("relative RMS effort error of each actuator and mean [%], 6-fold cross-validation over the phase")
    for first in range(0, FOLDS, NUM_HELD_OUT_FOLDS):
        held_out = (problem.fold >= first) & (problem.fold < first + NUM_HELD_OUT_FOLDS)
        before = (problem.fold == (first - 1) % FOLDS) & problem.edge[:, 1]
        after = (problem.fold == (first + NUM_HELD_OUT_FOLDS) % FOLDS) & problem.edge[:, 0]
        selection, fit = select_effects(problem.subset(~(held_out | before | after))).consistent()
        part = replace(problem.subset(held_out), tilt=selection.problem.tilt).with_fit(fit)
        errors = np.sum((part.columns.tau - part.predict(selection.effects, fit.x)) ** 2, axis=0)
        squares += errors
        show(f"phases {first}-{first + NUM_HELD_OUT_FOLDS - 1} of {FOLDS}", errors, np.sum(part.columns.tau**2, axis=0))
    show("all phases", squares, np.sum(problem.columns.tau**2, axis=0))


def show(name: str, errors: np.ndarray, efforts: np.ndarray) -> None:
    """Prints one row of relative errors [%], from sums (n,) of squared errors and squared efforts."""
    percent = 100 * np.sqrt(errors / efforts)
    print(f"{name:20}", " ".join(f"{p:5.1f}" for p in percent), f" {percent.mean():5.1f}", flush=True)


if __name__ == "__main__":
    main()
