"""Estimates the known payloads of the public PSM recordings, and the effect of refitting friction.

    python benchmarks/payload_recordings.py FOLDER

FOLDER contains psm_one.csv, psm_one_no_weight.csv, psm_one_105g_parallel.csv and psm_one_205g_insertion.csv in the
coordinates "wpi", with a header and times (docs/public_recordings.md).

The first table contains the estimated payloads, with a reference recording and with a model only. The second table
shows how the model error depends on the duration of the recording to which friction is refitted. The third table
compares the model errors after refitting to the same phases of the motion and to other phases.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np

from dvrk_drake.analysis.estimation.point_mass import point_mass_parameters
from dvrk_drake.analysis.motion_identification import identify_dynamic
from dvrk_drake.analysis.motion_validation import validate_motion
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.analysis.payload import Payload, estimate_payload
from dvrk_drake.analysis.recalibration import cross_validated_errors, refit_friction
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.recording import Recording

#: File, link, mass [kg], and position in the link's frame [m]; see docs/payload.md for the source of the positions.
WEIGHTS = [
    ("psm_one_105g_parallel", "bottom_bar_link", 0.105, [0.0, 0.165, 0.0563]),
    ("psm_one_205g_insertion", "end_link", 0.205, [0.0, 0.023, 0.3913]),
]
SECONDS = (5.5, 6.0, 7.0, 8.0, 10.0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the recordings, see above")
    options = parser.parse_args()
    arm = load_arm("psm")

    def read(name: str) -> Recording:
        return read_recording(options.folder / f"{name}.csv", arm, "wpi")

    models = {
        name: identify_dynamic([Observations(read(name), arm)]).model for name in ("psm_one_no_weight", "psm_one")
    }
    for reference, model in models.items():
        for name, link, mass, position in WEIGHTS:
            for known, what in ((read(reference), f"reference {reference}"), (None, f"model of {reference}")):
                (payload,) = estimate_payload(
                    Observations(known, model.dynamic_model.arm, model.dynamic_model.section.signals),
                    Observations(read(name), model.dynamic_model.arm, model.dynamic_model.section.signals),
                    model.dynamic_model,
                    [link],
                )
                _print_payload(arm, read(name), what, name, payload, mass, np.array(position))
    # To the recording of the other day, which has no payload, add the torque of an exactly known payload.
    for reference, other in (("psm_one_no_weight", "psm_one"), ("psm_one", "psm_one_no_weight")):
        model = models[reference].dynamic_model
        for _, link, mass, position in WEIGHTS:
            loaded = _with_payload(read(other), model, link, mass, np.array(position))
            (payload,) = estimate_payload(
                Observations(read(reference), model.arm, model.section.signals),
                Observations(loaded, model.arm, model.section.signals),
                model,
                [link],
            )
            name = f"{other} with the torque of {1000 * mass:.0f} g added"
            _print_payload(arm, loaded, f"reference {reference}", name, payload, mass, np.array(position))
    _print_seconds(models["psm_one"], read("psm_one_no_weight"))
    _print_phases(models["psm_one"], read("psm_one_no_weight"))
    return 0


def _with_payload(recording: Recording, model: DynamicModel, link: str, mass: float, position: np.ndarray) -> Recording:
    """Returns the recording plus the efforts of a point mass on a link."""
    arm = model.arm
    recording = recording.in_actuator_coordinates(arm)
    grid = Observations(recording, arm, model.section.signals).grid
    k = [link.link for link in model.regressor.links].index(link)
    Y = model.regressor.regressor(grid.q, grid.v, grid.vd)[..., 10 * k : 10 * k + 10]
    added = Y @ point_mass_parameters(mass, position) @ arm.transmission.inverse.matrix
    return dataclasses.replace(recording, tau=recording.measured_effort() + grid.efforts_at_rows(added))


def _print_payload(
    arm: Arm, recording: Recording, compared_with: str, name: str, payload: Payload, mass: float, position: np.ndarray
) -> None:
    body, offset = payload.body, payload.position_in_base - payload.body.position
    print(f"{name}, {compared_with}, payload on {payload.link}")
    print(f"  mass {1000 * body.mass:.0f} +- {1000 * payload.mass_error:.0f} g (true {1000 * mass:.0f})")
    for axis in range(3):
        estimate = "not determined"
        if body.determined[axis]:
            estimate = f"{100 * payload.position_in_base[axis]:+.1f} +- {100 * payload.position_error[axis]:.1f} cm"
        print(f"  {'xyz'[axis]} from the remote centre: {estimate} (true {100 * (position + offset)[axis]:+.1f})")
    regressor = DynamicRegressor(arm)
    grid = Observations(recording, arm).grid
    k = [link.link for link in regressor.links].index(payload.link)
    Y = regressor.regressor(grid.q, grid.v, grid.vd)[..., 10 * k : 10 * k + 10]
    # Subtract the means, which are not identifiable separately from the offset of the drive.
    ours, true = (
        tau - np.mean(tau, axis=0) for tau in (Y @ body.parameters, Y @ point_mass_parameters(mass, position))
    )
    share = np.sum(ours * true, axis=0)[:2] / np.sum(true**2, axis=0)[:2]
    print(f"  estimated torque, projected on the true torque: yaw {100 * share[0]:.0f} %, pitch {100 * share[1]:.0f} %")


def _print_seconds(model: IdentifiedModel, whole: Recording) -> None:
    """Prints the errors on the last two thirds of the recording after refitting friction to its first seconds."""
    evaluation = _rows(whole, slice(len(whole) // 3, None))

    def percent(which: IdentifiedModel) -> str:
        validation = validate_motion(which, Observations.for_model(evaluation, which))
        return "  ".join(f"{100 * (a.relative_error or 0):5.1f}" for a in validation.actuators)

    print("\nrelative RMS effort error of each actuator [%], by the duration of the recording for refitting friction")
    print(f"before    {percent(model)}")
    for seconds in SECONDS:
        assert whole.t is not None
        result = refit_friction(
            model, Observations.for_model(_rows(whole, slice(0, int(np.searchsorted(whole.t, seconds)))), model)
        )
        not_refitted = [a.name for a in result.actuators if not a.kept]
        print(f"{seconds:5.1f} s   {percent(result.model)}   not refitted: {', '.join(not_refitted) or 'none'}")


def _print_phases(model: IdentifiedModel, whole: Recording) -> None:
    """Prints the errors after refitting friction to the same phases at another time, and to the other phases."""
    first, second = (_rows(whole, rows) for rows in (slice(0, len(whole) // 2), slice(len(whole) // 2, None)))

    def errors(which: IdentifiedModel) -> list[float]:
        return [
            a.relative_error or 0.0 for a in validate_motion(which, Observations.for_model(second, which)).actuators
        ]

    before, after = cross_validated_errors(model, Observations.for_model(whole, model), 2)
    print("\nrelative RMS effort error of each actuator and mean [%]")
    for name, values in (
        ("same phases, second half of the time: before", errors(model)),
        (
            "same phases, refitted to the first half of the time",
            errors(refit_friction(model, Observations.for_model(first, model)).model),
        ),
        ("other phases: before", list(before)),
        ("other phases, each half refitted to the other half", list(after)),
    ):
        print(f"{name:52}", "  ".join(f"{100 * x:5.1f}" for x in (*values, np.mean(values))))


def _rows(recording: Recording, rows: slice) -> Recording:
    fields = {name: getattr(recording, name) for name in ("q", "qd", "tau", "t")}
    return dataclasses.replace(recording, lines=None, **{name: x[rows] for name, x in fields.items() if x is not None})


if __name__ == "__main__":
    sys.exit(main())
