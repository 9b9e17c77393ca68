"""Page of the interaction force at the handle of an arm, and a CSV file with its values."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dvrk_drake.experiments.transparency import GRASP_TIME, OperatorForces
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.reports.page import Page, Plot, Section, Table, Text
from dvrk_drake.reports.plot import Curve, Panel, series


def transparency_page(arm: Arm, forces: Sequence[OperatorForces], *, command: str = "") -> Page:
    """Returns the page of simulated interaction forces.

    Args:
        arm: Simulated arm.
        forces: One result per compensation. The first is without compensation.
        command: Command line that simulated them, for the suggested next command. "": there is none.
    """
    best, without = min(forces, key=lambda one: one.rms_force), forces[0]
    answer = f"Smallest interaction force at the handle: {best.rms_force:.2f} N RMS with {best.name}"
    answer += "." if best is without else f", {without.rms_force:.2f} N without compensation."
    note = Text(
        "95 %: 95th percentile over time. Deviation: distance of the handle from the path of the hand. "
        f"The first {GRASP_TIME:g} s are excluded.",
        show="details",
    )
    return Page(
        f"Transparency of {arm.name}, simulated",
        answer,
        [Section("Interaction force and torque", [forces_table(arm, forces), note, forces_plot(forces)])],
        "good",
        f"{command} --model MODEL.yaml" if command else "",
    )


def forces_table(arm: Arm, forces: Sequence[OperatorForces]) -> Table:
    """Returns force, torque and deviation with each compensation."""
    scales, formats = (1, 1, 1e3, 1e3, 1e3), (".2f", ".2f", ".0f", ".0f", ".1f")
    rows = []
    for one in forces:
        values = zip(one.measures.values(), scales, formats, strict=True)
        rows.append((_name(one, forces), *(f"{scale * value:{form}}" for value, scale, form in values)))
    return Table(
        (
            "compensation",
            "RMS force [N]",
            "95 % force [N]",
            "RMS torque [mN m]",
            "95 % torque [mN m]",
            "largest deviation [mm]",
        ),
        rows,
        f"{arm.name}, simulated: interaction force and torque at the handle during {forces[0].time[-1]:.3g} s",
    )


def forces_plot(forces: Sequence[OperatorForces]) -> Plot:
    """Returns the magnitudes of force and torque over time, after the initial transient of the grasp."""
    panels = []
    quantities = (("force", "N", 1.0), ("torque", "mN m", 1e3))
    for quantity, unit, scale in quantities:
        curves = []
        for i, one in enumerate(forces):
            size = scale * np.linalg.norm(getattr(one, quantity), axis=1)
            curves.append(Curve(_name(one, forces), one.time, size, **series(i)))
        panels.append(Panel("", curves, "time [s]", f"{quantity} [{unit}]", height=220))
    caption = f"Magnitude of interaction force and torque at the handle, from {GRASP_TIME:g} s on"
    return Plot("transparency", caption, panels, shared_x=True)


def write_transparency(path: Path, forces: Sequence[OperatorForces]) -> None:
    """Writes a CSV file with the values of the page in SI units. Replaces the file atomically."""
    with atomic_write(path) as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(["compensation", *forces[0].measures])
        rows.writerows([one.name, *(f"{value:.6g}" for value in one.measures.values())] for one in forces)


def _name(one: OperatorForces, forces: Sequence[OperatorForces]) -> str:
    return "none" if one is forces[0] else one.name
