"""Measures the coverage of the 95 % intervals of `payload` on simulated arms whose drives change between two days.

    python benchmarks/payload_coverage.py [--seeds 40]

Each arm has different links, friction, springs and cables. tests/support/loaded_arm.py defines their random changes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.payload import estimate_payload

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from loaded_arm import two_days

CASES = [
    ("psm", "end_link", 0.2, [0.02, 0.02, 0.39]),
    ("psm", "bottom_bar_link", 0.1, [0.03, 0.165, 0.056]),
    ("psm", "insertion_link", 0.05, [0.02, -0.02, 0.40]),
    ("mtmr", "forearm_link", 0.15, [0.02, -0.2, 0.03]),
]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40, help="number of simulated arms per case; default: %(default)s")
    options = parser.parse_args()
    inside = []
    for name, link, mass, position in CASES:
        errors, sizes = [], []
        for seed in range(options.seeds):
            model, reference, loaded = two_days(name, link, mass, position, seed)
            (payload,) = estimate_payload(
                Observations(reference, model.arm, model.section.signals),
                Observations(loaded, model.arm, model.section.signals),
                model,
                [link],
            )
            known = np.append(True, payload.body.determined)
            difference = np.append(payload.body.mass - mass, payload.body.position - position)[known]
            spread = np.append(payload.mass_error, payload.position_error)[known]
            errors.append(difference / spread)
            inside += list(np.abs(difference) < payload.quantile * spread)
            sizes.append(payload.mass_error)
        rms = ", ".join(f"{x:.2f}" for x in np.sqrt(np.mean(np.square(errors), axis=0)))
        print(
            f"{name} {link}, {mass:.2f} kg: median standard error {np.median(sizes):.4f} kg; "
            f"RMS error / standard error of mass and position: {rms}"
        )
    print(f"coverage of the 95 % intervals: {100 * np.mean(inside):.1f} % of {len(inside)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
