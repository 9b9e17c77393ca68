"""Compares the identified dynamics with published models on the public recordings of a real MTM and PSM.

    python benchmarks/dynamic_recordings.py FOLDER

FOLDER contains mtm_one.csv and psm_one.csv in actuator coordinates, with a header and times
(docs/public_recordings.md). Optional files are mtm_two.csv and psm_two.csv (other motions), and mtm_earlier_day.csv and
psm_one_no_weight.csv (other days). Each model is also identified from each optional file.

Errors are |tau - tau_hat| / |tau| of each actuator, without the ends of the motion. Both efforts are low-pass filtered
with a zero-phase Butterworth filter of order 6 (5.65 Hz for the MTM, 16.96 Hz for the PSM). Rows:

    published                    models of Wang et al., "A Convex Optimization-based Dynamic Model Identification
                                 Package for the da Vinci Research Kit", RA-L 2019, on the motion of the fit and on
                                 another one
    ours, fit                    model identified by `dvrk-drake identify`, on the motion of the fit
    ours, cross-validated        prediction of phases of the motion that were not used for the fit
    repeatability of the motion  smallest possible error of any function of q, v and vd over all periods
    FILE on OTHER                model identified from FILE, on another recording
    FILE on OTHER, refitted      the same model and recording, after refitting friction to the other half of the phases

The second table has the shares of efforts inside the 95 % prediction intervals of the same day, and of another day.
"""

from __future__ import annotations

import argparse
import itertools
import resource
import sys
import time
from pathlib import Path

import numpy as np
from timing import print_table

from dvrk_drake.analysis.check.recording_check import check_recording
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.recalibration import cross_validated_errors
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_section import ActuatorStatistics
from dvrk_drake.dynamics.inertial_parameters import pseudo_inertia
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.recording import Recording

#: Published errors [%] per joint: on the motion of the fit, and on another motion.
PUBLISHED = {
    "mtmr": ([7.95, 15.63, 11.79, 18.56, 24.22, 18.25, 28.00], [8.18, 16.31, 19.06, 20.90, 26.30, 23.48, 33.96]),
    "psm": ([6.59, 15.56, 17.73, 13.61, 21.07, 20.96, 25.56], [10.28, 18.28, 19.76, 13.44, 23.99, 21.11, 26.62]),
}


def main() -> None:
    """Prints one table per arm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    parser.add_argument(
        "--poses", type=int, default=2000, help="number of random poses at which the eigenvalues of M(q) are computed"
    )
    options = parser.parse_args()
    for name, file, others in (
        ("mtmr", "mtm_one.csv", ["mtm_two.csv", "mtm_earlier_day.csv"]),
        ("psm", "psm_one.csv", ["psm_two.csv", "psm_one_no_weight.csv"]),
    ):
        arm = load_arm(name)
        files = [own for own in (file, *others) if (options.folder / own).is_file()]
        recordings = {own: read_public(options.folder / own, arm) for own in files}
        models, inside = {}, {}
        begin = time.process_time()
        models[file] = identify_dynamic([Observations(recordings[file], arm)]).model
        seconds = time.process_time() - begin
        models |= {own: identify_dynamic([Observations(recordings[own], arm)]).model for own in files[1:]}
        dynamics = models[file].dynamics
        assert dynamics is not None

        def percent(which: str, actuators: list[ActuatorStatistics] = dynamics.actuators) -> np.ndarray:
            return np.array([100 * getattr(a, which) / a.rms_effort for a in actuators])

        rows = {
            "published, fit": PUBLISHED[name][0],
            "published, another motion": PUBLISHED[name][1],
            "ours, fit": percent("rms_fit"),
            "ours, cross-validated": percent("rms_cross_validation"),
            "repeatability of the motion": percent("rms_repeatability"),
        }
        for own, other in itertools.permutations(files, 2):
            errors = validate_motion(models[own], Observations.for_model(recordings[other], models[own])).actuators
            rows[f"{own} on {other}"] = [100 * (e.relative_error or 0.0) for e in errors]
            rows[f"{own} on {other}, refitted"] = (
                100 * cross_validated_errors(models[own], Observations.for_model(recordings[other], models[own]), 2)[1]
            )
            for day, which in (("same day", "inside"), ("another day", "inside_other_day")):
                inside[f"{own} on {other}, {day}"] = [100 * (getattr(e, which) or 0.0) for e in errors]
        headings = [*(f"J{j + 1}" for j in range(arm.num_joints)), "mean"]
        for what, table in (("relative RMS effort error of the actuators", rows), ("efforts inside", inside)):
            cells = {row: [f"{value:.1f}" for value in (*values, np.mean(values))] for row, values in table.items()}
            print_table(f"{arm.name}: {what} [%]", headings, cells)
        box = (arm.position_lower, arm.position_upper)
        q = np.random.default_rng(0).uniform(*box, (options.poses, arm.num_joints))
        least = float(np.linalg.eigvalsh(DynamicModel(arm, dynamics).mass_matrix(q)).min())
        eigenvalues = [np.linalg.eigvalsh(pseudo_inertia(link.parameters))[0] for link in dynamics.links]
        print(f"smallest eigenvalue of all pseudo-inertias: {min(eigenvalues):.1e}\n")
        print(f"smallest eigenvalue of M(q) at {len(q)} random poses: {least:.1e}\n")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"processor time of the identification: {seconds:.1f} s; peak memory of this process: {peak:.0f} MB\n")


def read_public(path: Path, arm: Arm) -> Recording:
    """Reads a recording in the coordinates of WPI; exits with a message if the check refuses it."""
    try:
        recording = read_recording(path, arm, "wpi")
    except RecordingError as error:
        sys.exit(str(error))
    refusals = [f for f in check_recording(Observations(recording, arm)).findings if f.severity == "refusal"]
    if refusals:
        sys.exit(
            f"{path}: {refusals[0].where}: {refusals[0].what}. This benchmark requires the coordinates of the public "
            "file. Convert it without --arm."
        )
    return recording


if __name__ == "__main__":
    main()
