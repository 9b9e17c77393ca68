"""Reproduces Fig. 7: step to zero with the controller of the paper and with ours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.experiments.reproduction import published
from dvrk_drake.experiments.reproduction.published import PAPER_ARM
from dvrk_drake.experiments.reproduction.session import ReproductionSession
from dvrk_drake.experiments.reproduction.step_response import (
    DURATION,
    LINK_INERTIA,
    OUR_DURATION,
    PERIOD,
    longest_period,
    oscillation_modes,
    paper_simulated_arm,
    simulate_ours,
    simulate_paper_controller,
)
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.colours import COMMANDED, SERIES
from dvrk_drake.reports.page import Plot
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel
from dvrk_drake.reports.reproduction.page import ResultTable, Section, numbers

_JOINTS = tuple(f"J{j}" for j in range(1, 8))


def reproduce_figure_7(session: ReproductionSession, duration: float = DURATION) -> Section:
    """Simulates the paper's controller on the paper's arm and ours on the ground-truth arm."""
    folder, mtm = session.folder, session.mtm

    def progress(share: float) -> None:
        session.progress("stepping to zero", share)

    theirs_arm = paper_simulated_arm(load_arm(PAPER_ARM), folder / "paper_simulated_mtm.sdf")
    faulty = simulate_paper_controller(theirs_arm, duration, True, lambda share: progress(0.4 * share))
    damped = simulate_paper_controller(theirs_arm, duration, False, lambda share: progress(0.4 + 0.4 * share))
    ours = simulate_ours(mtm.truth.arm, mtm.model, min(duration, OUR_DURATION))
    progress(1.0)
    rows = (
        (
            "published (read from the figure)",
            "-",
            f"{published.FIGURE_7_VALUES['J2 at 59 s']:.3f}",
            "-",
            "-",
            "-",
            "0.0220",
            "0.0155",
        ),
        ("the paper's controller, as published", *numbers(_late(faulty), "{:.4f}")),
        ("the paper's controller, fault corrected", *numbers(_late(damped), "{:.4f}")),
        (
            f"ours, from {min(3.0, duration / 2):g} s on",
            *numbers(_late(ours, from_time=min(3.0, duration / 2)), "{:.1e}"),
        ),
    )
    with_fault, without = (oscillation_modes(theirs_arm, fault)[0].real.max() for fault in (True, False))
    remarks = (
        "The step is from J5 = 3.13, J3 = -0.79, J2 = -0.22 rad to zero. The controller of the paper runs at 100 Hz "
        "with the published gains, on an arm with the published masses. This controller has a fault: the damping "
        "terms of joints 5-7 use positions instead of velocities. These terms add stiffness but no damping.",
        f"Each link has an inertia of {LINK_INERTIA:g} kg m^2, as in the PSM file of the paper. The oscillation period "
        f"of J2 confirms this value: {published.FIGURE_7_VALUES['J2 period']:.0f} s published, "
        f"{longest_period(theirs_arm):.0f} s here.",
        f"With the fault, the least damped oscillation near zero (joint 7) has a decay rate of "
        f"{max(0.0, -with_fault):.3f} /s, and integral action can increase its amplitude. Without the fault, all "
        f"oscillations have a decay rate of at least {-without:.3f} /s. Joints 6 and 7 start at their published "
        "amplitudes, because the planar start pose does not excite these joints.",
        "Our controller regulates the ground-truth MTM of Fig. 5 with all effects except joint stops, because the "
        "start pose is beyond the stops. The controller uses the effort limits of the arm, the identified model, the "
        "gains of `mechanisms/mtm.yaml` and a rate of 1 kHz. The largest position error in the last second is "
        f"{1e3 * np.abs(ours[-round(1 / PERIOD) :]).max():.1f} mrad, because friction resists small integral efforts.",
        "The solver, joint limits and friction of Gazebo differ from those here. Therefore the phases of the "
        "oscillations cannot be compared. Only the decay of the oscillations is compared.",
    )
    table = ResultTable(
        "fig7",
        "Largest |q| [rad] in the last 10 s (published: J2 at 59 s, J6 and J7 near the end)",
        ("", *_JOINTS),
        rows,
    )
    finding = (
        f"In the last 10 s, joint 7 moves up to {_late(faulty)[6]:.3f} rad with the paper's controller as published, "
        f"and up to {_late(damped)[6]:.0e} rad after its programming fault is corrected."
    )
    return Section("fig7", "Fig. 7: step to zero", finding, remarks, (table,), (_plot(faulty, ours),))


def _late(q: NDArray[np.float64], from_time: float | None = None) -> NDArray[np.float64]:
    first = len(q) - round(10.0 / PERIOD) if from_time is None else round(from_time / PERIOD)
    return np.abs(q[max(first, 0) :]).max(axis=0)


def _plot(faulty: NDArray[np.float64], ours: NDArray[np.float64]) -> Plot:
    """Returns the positions of all joints in the step to zero, beside them enlarged."""
    names, panels = load_arm(PAPER_ARM).joint_names, []
    runs = ((ours, "ours on the ground-truth arm"), (faulty, "the paper's controller on the paper's arm"))
    for q, label in runs:
        t = PERIOD * np.arange(len(q))
        marks: list[Mark] = [
            Curve(f"{joint} {name}", t[::5], q[::5, j], SERIES[j], "dashed" if j % 2 else "line")
            for j, (joint, name) in enumerate(zip(_JOINTS, names, strict=True))
        ]
        marks.append(Guide("y", 0.0, None, COMMANDED, "target"))
        title, labels = f"{label}, {t[-1]:.0f} s", ("time [s]", "position [rad]")
        panels.append(Panel(title, marks, *labels, height=260))
        panels.append(Panel(f"{title}, enlarged", marks, *labels, y_range=(-0.1, 0.1), height=260))
    caption = "Fig. 7 reproduced: joint positions in the step to zero"
    return Plot("fig7", caption, panels, columns=2)
