"""Prints what half and twice the value of a constant change, for the reasons beside the constants of `analysis`.

    python benchmarks/thresholds.py FOLDER check.measurement_check.MIN_JITTER ... [--results motions poses ...]

FOLDER contains the folders trajectories, psm_three_joints and mtm_static with the public recordings
(docs/public_recordings.md). A constant is named by its module in `dvrk_drake.analysis`. The output lists the findings
of `check` that appear and disappear. With `--results`, it contains other results instead: the mean cross-validated
errors of `mtm_one` and `psm_one`, or of static poses, the estimates of two payloads, or the expected errors of designed
poses and of a random motion. A constant that a module uses while it is imported cannot be varied.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import dvrk_drake as dvrk
from dvrk_drake.analysis.excitation.information import MotionInformation, random_motion, state_of

Recordings = dict[str, tuple[dvrk.Recording, dvrk.Arm]]

LOCKED = {"roll": 0.0, "wrist_pitch": 0.0, "wrist_yaw": 0.0, "jaw": 0.0}
MOTIONS = {"mtm_one": "mtmr", "psm_one": "psm"}


def recordings(folder: Path) -> Recordings:
    """Returns the public recordings of dVRK arms, with their arms, by the names of their files."""
    mtmr, psm = dvrk.load_arm("mtmr"), dvrk.load_arm("psm")
    three = dvrk.lock_joints(psm, LOCKED)
    found = {}
    for path in sorted(folder.glob("trajectories/*.csv")):
        if path.stem.endswith("cable_test"):  # one joint only
            continue
        arm = psm if path.stem.startswith("psm") else mtmr
        found[path.stem] = dvrk.read_recording(path, arm, coordinates="actuator" if arm is mtmr else "wpi"), arm
    found |= {path.stem: (dvrk.read_recording(path, three), three) for path in folder.glob("psm_three_joints/*.csv")}
    return found | {
        path.stem: (dvrk.read_recording(path, mtmr), mtmr) for path in folder.glob("mtm_static/mtm*_20*.csv")
    }


def results(name: str, factor: float, folder: Path, which: tuple[str, ...]) -> dict[str, str]:
    """Returns the findings, or the results of some kinds, with a constant times a factor, each with its name."""
    module, _, constant = f"dvrk_drake.{name if name.startswith('dynamics.') else f'analysis.{name}'}".rpartition(".")
    value = getattr(importlib.import_module(module), constant)
    # The modules that import the constant by its name have a copy.
    for other in [m for n, m in sys.modules.items() if n.startswith("dvrk_drake.")]:
        if getattr(other, constant, None) is value:
            setattr(other, constant, scaled(value, factor))
    kinds = {"motions": motion_errors, "poses": pose_errors, "payloads": payloads, "design": design_errors}
    if which:
        return {key: text for kind in which for key, text in kinds[kind](recordings(folder)).items()}
    return {
        f"{file}: {finding.severity} {finding.kind}, {finding.where}": ""
        for file, (recording, arm) in recordings(folder).items()
        for finding in dvrk.check(recording, arm).findings
    }


def motion_errors(read: Recordings) -> dict[str, str]:
    """Returns the mean cross-validated errors of models of two motions."""
    errors = {}
    for file in MOTIONS:
        actuators = dvrk.identify(*read[file]).model.dynamics.actuators
        errors[file] = f"{100 * np.mean([a.rms_cross_validation / a.rms_effort for a in actuators]):.3f} %"
    return errors


def pose_errors(read: Recordings) -> dict[str, str]:
    """Returns the mean cross-validated errors of static models, and the joints without a full feedforward."""
    errors = {}
    for file, (recording, arm) in read.items():
        if recording.tau is not None and not recording.is_motion and "coupled12" not in file:
            joints = dvrk.identify(recording, arm).model.joints
            shares = [j.rms_cross_validation_included / j.rms_zero_torque_included for j in joints]
            scales = {j.name: round(j.feedforward_scale, 2) for j in joints if j.feedforward_scale < 1}
            errors[file] = f"{100 * np.mean(shares):.2f} %, feedforward scales {scales}"
    return errors


def payloads(read: Recordings) -> dict[str, str]:
    """Returns the mass and the position of two payloads, with standard errors, and the link that explains each best."""
    reference, arm = read["psm_one_no_weight"]
    model = dvrk.identify(reference, arm).model
    texts = {}
    for file, link in (("psm_one_105g_parallel", "bottom_bar_link"), ("psm_one_205g_insertion", "end_link")):
        result = dvrk.payload(reference, read[file][0], model, link)
        found, error = result.payload, np.linalg.norm(np.nan_to_num(result.payload.position_error))
        texts[file] = (
            f"best {result.estimates[0].link}; {found.body.mass:.4f} +- {found.mass_error:.4f} kg at "
            f"{found.body.position.round(4)} +- {error:.4f} m, error {found.relative_error:.3f}"
        )
    return texts


def design_errors(read: Recordings) -> dict[str, str]:
    """Returns the expected errors of designed poses of an MTML, and of the best random motions of an MTML."""
    arm = dvrk.load_arm("mtml")
    poses = dvrk.design_poses(arm, 30)
    limits = dvrk.MotionLimits()
    information = MotionInformation(arm, limits)
    motions = [random_motion(arm, limits, 30.0, 16, np.random.default_rng(seed)) for seed in range(4)]
    errors = [information.expected_error(state_of(motion, 128), 30.0) for motion in motions]
    return {
        "30 poses": f"{100 * poses.expected_error:.2f} %, random {100 * poses.random_error:.2f} %",
        "random motions": f"{' '.join(f'{100 * error:.2f}' for error in errors)} %",
    }


def scaled(value: Any, factor: float) -> Any:
    """Returns a number, or a tuple of numbers, times a factor. Integers are rounded, and are at least 1."""
    if isinstance(value, tuple):
        return tuple(scaled(part, factor) for part in value)
    return max(1, round(factor * value)) if isinstance(value, int) else factor * value


def main() -> None:
    """Prints the changes, one line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    parser.add_argument("names", nargs="+", help="constants, e.g. check.measurement_check.MIN_JITTER")
    parser.add_argument("--results", nargs="+", default=(), choices=("motions", "poses", "payloads", "design"))
    options = parser.parse_args()
    before = _in_process(options.names[0], 1.0, options.folder, tuple(options.results))
    for name in options.names:
        for factor in (0.5, 2.0):
            after = _in_process(name, factor, options.folder, tuple(options.results))
            changed = sorted(key for key in before.keys() | after.keys() if before.get(key) != after.get(key))
            print(f"{name} x {factor:g}: {len(changed)} results change", flush=True)
            for key in changed:
                if options.results:
                    print(f"    {key}: {before.get(key)} -> {after.get(key)}")
                else:
                    print(f"  {'-' if key in before else '+'} {key}")


def _in_process(*arguments: Any) -> dict[str, str]:
    """Returns `results`, computed in a process of its own, because caches may contain the value of a constant."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        return executor.submit(results, *arguments).result()


if __name__ == "__main__":
    main()
