"""Compares static models from designed and from random poses, on simulated arms with known gravity.

    python benchmarks/static_poses.py [--arms 20] [--poses 40] [--arm mtml]

The links of each simulated arm differ from those of the SDF, with a standard deviation of 20 % of their mass. The
torques of cables and springs are 0 to 100 % of those in the arm file, and the friction is 50 % to 150 %. Each pose is
approached from below and from above, at the distances of `collect poses --transport ros`. Friction is elastic before it
slides, so it does not cancel completely. The noise of the averaged efforts is 0.5 % of the effort limits. The models
are tested at 200 random poses of the whole workspace. An error is relative to the RMS holding effort of the joint, or
to 2 % of its effort limit if the RMS holding effort is smaller.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path

import numpy as np
from timing import print_table

import dvrk_drake as dvrk
from dvrk_drake.analysis.estimation.pose_effects import MIN_TORQUE
from dvrk_drake.analysis.excitation.pose_file import approach_offset, offset_pose
from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, joint_row, position_along
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.processes.collector import CollectionSettings, estimated_duration

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from motions import true_dynamics

SPREAD, NOISE, TESTS = 0.1, 0.005, 200


def main() -> None:
    """Prints the tables of each arm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=20, help="number of simulated arms; default: %(default)s")
    parser.add_argument("--poses", type=int, default=40, help="number of poses; default: %(default)s")
    parser.add_argument("--arm", choices=("mtml", "mtmr", "psm"), help="only this arm")
    options = parser.parse_args()
    for name in (options.arm,) if options.arm else ("mtml", "psm"):
        compare(dvrk.load_arm(name), options.arms, options.poses)


def compare(arm: Arm, arms: int, count: int) -> None:
    """Prints the tables of one arm."""
    start = time.perf_counter()
    design = dvrk.design_poses(arm, count)
    print(f"{arm.name}: design of {count} poses in {time.perf_counter() - start:.0f} s", flush=True)
    names = [f"{count} designed", f"{count} random", f"{3 * count // 2} random"]
    errors: dict[str, list[np.ndarray]] = {which: [] for which in names}
    duration: dict[str, list[float]] = {which: [] for which in names}
    residuals, signs = [], np.array(list(itertools.product((1.0, -1.0), repeat=arm.num_joints - 1)))
    signs = np.column_stack([np.ones(len(signs)), signs])
    for seed in range(arms):
        rng = np.random.default_rng(seed)
        truth, friction = simulated_arm(arm, rng)
        test = arm.sample_poses(TESTS, rng)
        expected = holding(truth, test)
        scale = np.maximum(np.sqrt(np.mean(expected**2, axis=0)), MIN_TORQUE * arm.effort_limits)
        others = [arm.sample_poses(size, rng, margin=0.1) for size in (count, 3 * count // 2)]
        for which, poses in zip(names, (design.poses, *others), strict=True):
            average = averaged_friction(arm, friction, poses)
            tau = holding(truth, poses) + average + NOISE * arm.effort_limits * rng.normal(size=poses.shape)
            model = identify_static(dvrk.Recording(q=poses, tau=tau, source="simulated"), arm).model
            error = model.holding_torque(test) - expected
            errors[which].append(np.sqrt(np.mean(error**2, axis=0)) / scale)
            duration[which].append(estimated_duration(arm, poses[0], poses, CollectionSettings()) / 60)
        # Friction that the average does not cancel, for equal signs (first row) and for all other sign patterns.
        own = np.sum([abs(e.coefficient * joint_row(arm, e.coordinate)) for e in friction], axis=0)
        left = [averaged_friction(arm, friction, design.poses, pattern) for pattern in signs]
        residuals.append([np.sqrt(np.mean(np.square(x), axis=0)) / own for x in left])
        print(f"arm {seed + 1} of {arms}", file=sys.stderr, flush=True)
    expectations = (f"{100 * design.expected_error:.1f}", f"{100 * design.random_error:.1f}", "")
    rows = {
        which: [
            expectation,
            *(f"{100 * x:.1f}" for x in np.mean(of, axis=0)),
            f"{100 * np.mean(of):.1f}",
            f"{100 * np.mean(np.max(of, axis=1)):.1f}",
            f"{np.mean(duration[which]):.1f}",
        ]
        for (which, of), expectation in zip(errors.items(), expectations, strict=True)
    }
    headings = ["expected mean", *arm.joint_names, "mean", "worst joint", "duration [min]"]
    print_table(
        f"{arm.name}: relative error of holding efforts at {TESTS} unseen poses of {arms} arms [%]", headings, rows
    )
    found = 100 * np.mean(residuals, axis=0)
    rows = {
        name: [*(f"{x:.1f}" for x in of), f"{np.mean(of):.1f}"]
        for name, of in (
            ("equal signs", found[0]),
            ("other signs, mean", found[1:].mean(axis=0)),
            ("best signs", found[np.argmin(found.mean(axis=1))]),
        )
    }
    title = f"{arm.name}: RMS friction that the average of both approaches does not cancel [% of the dry friction]"
    print_table(title, [*arm.joint_names, "mean"], rows)


def simulated_arm(arm: Arm, rng: np.random.Generator) -> tuple[DynamicModel, list[DriveEffect]]:
    """Returns an arm with other links, cables and springs than the SDF and the arm file, and its dry friction."""

    def varied(effect: DriveEffect, least: float) -> DriveEffect:
        coefficient = effect.coefficient * rng.uniform(least, least + 1.0)
        return DriveEffect(effect.coordinate, effect.kind, effect.scale, coefficient)

    friction = [varied(e, 0.5) for e in arm.effects.friction if e.kind != "viscous"]
    truth = true_dynamics(arm, rng, [varied(e, 0.0) for e in (*arm.effects.cables, *arm.effects.springs)], SPREAD)
    return truth, friction


def holding(truth: DynamicModel, q: np.ndarray) -> np.ndarray:
    """Returns the joint efforts (m, n) that hold an arm at poses (m, n), without friction."""
    return truth.arm.transmission.pull_back_effort(truth.effort(q, 0 * q, 0 * q))


def averaged_friction(
    arm: Arm, friction: list[DriveEffect], poses: np.ndarray, signs: np.ndarray | float = 1.0
) -> np.ndarray:
    """Returns the mean friction (m, n) of both approaches, for a collection of poses (m, n) in their order.

    Args:
        arm: Arm.
        friction: Dry friction, which is constant while the arm is at rest.
        poses: Poses [rad, m].
        signs: Signs (n,) of the approach offsets of the joints.
    """
    path = [
        point
        for pose in poses
        for side in (-1, 1)
        for point in (offset_pose(arm, pose, side * signs * approach_offset(arm)), pose)
    ]
    q, total = np.array(path), np.zeros((len(path), arm.num_joints))
    for effect in friction:
        x = position_along(arm, effect.coordinate, q)
        # Between two points, the coordinate is monotonic, so the ends determine the state of a presliding element.
        shape = ActuatorEffect.of(effect).column(x, 0 * x)
        total += effect.coefficient * shape[:, None] * joint_row(arm, effect.coordinate)
    return (total[1::4] + total[3::4]) / 2


if __name__ == "__main__":
    main()
