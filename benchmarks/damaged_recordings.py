"""Evaluates how `check` and `identify` handle damaged recordings.

    python benchmarks/damaged_recordings.py FOLDER [NAME ...]

FOLDER contains the public recordings (docs/public_recordings.md). NAME is a motion, by default mtm_one (MTMR) and
psm_one (PSM). Each damage is applied separately to each motion. Outcomes:

    refused         the check or the identification refuses the recording
    warned          there is a new warning, or the cross-validated error of an actuator exceeds half of its RMS effort
    harmless        there is no actuator whose error on the undamaged motion rises by more than half and also by more
                    than 5 % of its RMS effort
    undetectable    the error of an actuator rises by more than in `harmless`, and a note of the check states that the
                    offset or the scale of the damaged joint cannot be checked
    undetected      the error of an actuator rises by more than in `harmless`, without such a note

The script also prints the findings about the channels of the undamaged recordings. There should be no such findings.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import combinations, repeat
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from dvrk_drake.analysis.check.recording_check import check_with_channels
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import IdentificationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.recording import Recording

DEFAULT = ("mtm_one", "psm_one")
PSM_MOTIONS = ("psm_one", "psm_one_no_weight", "psm_one_105g_parallel", "psm_one_205g_insertion")
MOTIONS = {"mtm_one": "mtmr", **dict.fromkeys(PSM_MOTIONS, "psm")}
COLUMNS = ("refused", "warned", "harmless", "undetectable", "undetected")
CHANNEL_KINDS = ("exchanged channels", "effort sign", "effort scale", "position offset")


def damages(recording: Recording, arm: Arm) -> Iterator[tuple[str, str, Recording]]:
    """Yields the kind of each damage, the damaged channels, and the damaged recording."""
    n, tau, qd = arm.num_joints, recording.measured_effort(), np.asarray(recording.qd)
    for i, j in combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        yield "efforts exchanged", f"{i + 1} {j + 1}", replace(recording, tau=tau[:, order])
        exchanged = replace(recording, q=recording.q[:, order], qd=qd[:, order], tau=tau[:, order])
        yield "all signals exchanged", f"{i + 1} {j + 1}", exchanged
    for i, unit in enumerate(np.eye(n)):
        yield "effort inverted", f"{i + 1}", replace(recording, tau=tau * (1 - 2 * unit))
        yield (
            "position inverted",
            f"{i + 1}",
            replace(recording, q=recording.q * (1 - 2 * unit), qd=qd * (1 - 2 * unit)),
        )
        yield "effort doubled", f"{i + 1}", replace(recording, tau=tau * (1 + unit))
        yield "effort halved", f"{i + 1}", replace(recording, tau=tau * (1 - unit / 2))
        offset = arm.per_joint(0.1, 0.01)[i] * unit
        yield "position +0.1 rad, +10 mm", f"{i + 1}", replace(recording, q=recording.q + offset)
        yield "position -0.1 rad, -10 mm", f"{i + 1}", replace(recording, q=recording.q - offset)


@cache
def undamaged(folder: Path, name: str) -> tuple[Recording, Arm, set[tuple[str, str]], list[tuple[str, str, Recording]]]:
    """Returns the recording, its arm, the findings of its check as (kind, where), and all damages."""
    arm = load_arm(MOTIONS[name])
    recording = read_recording(folder / f"{name}.csv", arm, "actuator")
    usual = {(finding.kind, finding.where) for finding in check_with_channels(Observations(recording, arm)).findings}
    return recording, arm, usual, list(damages(recording, arm))


@cache
def errors_of_undamaged(folder: Path, name: str) -> np.ndarray:
    """Returns the relative errors (n,) of a model identified from the undamaged recording, on the same recording."""
    recording, arm, *_ = undamaged(folder, name)
    return relative_errors(identify_dynamic([Observations(recording, arm)]).model, recording)


def relative_errors(model: IdentifiedModel, recording: Recording) -> np.ndarray:
    """Returns the relative errors (n,) of the actuators' efforts."""
    return np.array(
        [a.relative_error for a in validate_motion(model, Observations.for_model(recording, model)).actuators]
    )


def outcome(folder: Path, name: str, number: int) -> tuple[str, str, str, str]:
    """Returns kind, channels, outcome and detail of one damage."""
    recording, arm, usual, all_damages = undamaged(folder, name)
    kind, channels, damaged = all_damages[number]
    findings = check_with_channels(Observations(damaged, arm)).findings
    new = [finding for finding in findings if (finding.kind, finding.where) not in usual]
    for severity, what in (("refusal", "refused"), ("warning", "warned")):
        if found := [f for f in new if f.severity == severity]:
            where = "recording" if found[0].where == recording.source else found[0].where
            return kind, channels, what, f"{where}: {found[0].kind}"
    try:
        model = identify_dynamic([Observations(damaged, arm)]).model
    except IdentificationError as error:
        return kind, channels, "refused", f"identify: {error}"
    assert model.dynamics is not None
    if poorly := [a.name for a in model.dynamics.actuators if a.rms_cross_validation > 0.5 * a.rms_effort]:
        return kind, channels, "warned", f"{', '.join(poorly)}: most of the effort is not explained"
    before, after = errors_of_undamaged(folder, name), relative_errors(model, recording)
    worst = int(np.argmax(after - before))
    detail = f"{arm.joint_names[worst]} {before[worst]:.1%} -> {after[worst]:.1%}"
    if not np.any((after > 1.5 * before) & (after > before + 0.05)):
        return kind, channels, "harmless", detail
    note = "undetectable offset" if kind.startswith("position") else "uncertain effort scale"
    listed = any(f.kind == note and int(channels.split()[0]) - 1 in f.joints for f in findings)
    return kind, channels, "undetectable" if listed else "undetected", detail


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    parser.add_argument("name", nargs="*", default=DEFAULT, help=f"motions; allowed: {', '.join(MOTIONS)}")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count(), help="number of worker processes; default: %(default)s"
    )
    options = parser.parse_args()
    for name, arm_name in MOTIONS.items():
        arm = load_arm(arm_name)
        report = check_with_channels(Observations(read_recording(options.folder / f"{name}.csv", arm, "actuator"), arm))
        bad = [str(f) for f in report.findings if f.kind in CHANNEL_KINDS]
        print(f"{name}, undamaged: {'; '.join(bad) or 'no findings about the channels'}", flush=True)
    for name in options.name:
        count = len(undamaged(options.folder, name)[-1])
        outcomes: dict[str, Counter] = {}
        print(f"\n{name}\n| damage | channels | outcome | detail |\n|---|---|---|---|")
        with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
            for kind, channels, what, detail in pool.map(outcome, repeat(options.folder), repeat(name), range(count)):
                outcomes.setdefault(kind, Counter())[what] += 1
                print(f"| {kind} | {channels} | {what} | {detail} |", flush=True)
        print(f"\n{name}\n| damage | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
        for kind, found in sorted(outcomes.items()):
            print(f"| {kind} | {' | '.join(str(found[column]) for column in COLUMNS)} |")


if __name__ == "__main__":
    main()
