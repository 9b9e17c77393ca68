"""Fig. 7: the step to zero under the paper's controller and ours, as a table and a figure."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
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
from dvrk_drake.models.arm import load_arm
from dvrk_drake.reports.figures.style import save_figure
from dvrk_drake.reports.reproduction.page import ResultTable, Section, numbers

_FILE = "fig7.png"
_JOINTS = tuple(f"J{j}" for j in range(1, 8))


def reproduce_figure_7(session: ReproductionSession, duration: float = DURATION) -> Section:
    """The paper's step with its controller on its arm, and ours on the ground-truth arm; writes fig7.png."""
    folder, mtm = session.folder, session.mtm

    def progress(share: float) -> None:
        session.progress("stepping to zero", share)

    theirs_arm = paper_simulated_arm(load_arm(PAPER_ARM), folder / "paper_simulated_mtm.sdf")
    faulty = simulate_paper_controller(theirs_arm, duration, True, lambda share: progress(0.4 * share))
    damped = simulate_paper_controller(theirs_arm, duration, False, lambda share: progress(0.4 + 0.4 * share))
    ours = simulate_ours(mtm.truth.arm, mtm.model, min(duration, OUR_DURATION))
    progress(1.0)
    _plot(folder / _FILE, faulty, ours)
    rows = (
        (
            "published, read off",
            "-",
            f"{published.FIGURE_7_VALUES['J2 at 59 s']:.3f}",
            "-",
            "-",
            "-",
            "0.0220",
            "0.0155",
        ),
        ("the paper's controller, as it was", *numbers(_late(faulty), "{:.4f}")),
        ("the same with velocities in all damping terms", *numbers(_late(damped), "{:.4f}")),
        (
            f"ours, from {min(3.0, duration / 2):g} s on",
            *numbers(_late(ours, from_time=min(3.0, duration / 2)), "{:.1e}"),
        ),
    )
    with_fault, without = (oscillation_modes(theirs_arm, fault)[0].real.max() for fault in (True, False))
    remarks = (
        "From J5 +3.13, J3 -0.79, J2 -0.22 rad to zero, gains and masses as published, 100 Hz. The paper's node fed "
        "the positions of joints 5-7 into their damping terms: a second stiffness, and no damping at all. We give "
        f"each link {LINK_INERTIA:g} kg m^2 as the paper's PSM file does; that this is so for its MTM follows from "
        f"the period of its J2, {published.FIGURE_7_VALUES['J2 period']:.0f} s as published and "
        f"{longest_period(theirs_arm):.0f} s here. About zero the least damped swing, joint 7's, decays by "
        f"{max(0.0, -with_fault):.3f} /s with the fault and can only grow under an integral; with velocities in all "
        f"damping terms it decays by {-without:.3f} /s or more. Joints 6 and 7 start at their published amplitudes "
        "here: the rest of the start lies in a plane and never moves them.",
        "Ours holds another arm: the true MTM of Fig. 5 with all its effects (its stops apart: the start is beyond "
        "them), its limits of effort, and the model that was identified from poses collected on it; gains of "
        "`mechanisms/mtm.yaml`, 1 kHz. Its largest error in the last second is "
        f"{1e3 * np.abs(ours[-round(1 / PERIOD) :]).max():.1f} mrad: friction holds what the integrators have not "
        "yet taken away.",
        "What differs: Gazebo's solver and its joints' limits and friction are not ours, so where the undamped "
        "joints are in their swing at a given time is not comparable, only whether they come to rest.",
    )
    table = ResultTable(
        "fig7", "Largest |q| [rad] in the last 10 s (the published: J2 at 59 s, J6, J7 late)", ("", *_JOINTS), rows
    )
    shows = (
        "Step to zero: the paper's controller on its arm (above), ours on the ground-truth arm (below); right: close up"
    )
    return Section("fig7", "Fig. 7: step to zero", remarks, (table,), {_FILE: shows})


def _late(q: NDArray[np.float64], from_time: float | None = None) -> NDArray[np.float64]:
    first = len(q) - round(10.0 / PERIOD) if from_time is None else round(from_time / PERIOD)
    return np.abs(q[max(first, 0) :]).max(axis=0)


def _plot(path: Path, faulty: NDArray[np.float64], ours: NDArray[np.float64]) -> None:
    figure, axes = plt.subplots(2, 2, figsize=(13, 7.5), layout="constrained")
    for row, (q, label) in enumerate(
        ((faulty, "the paper's controller on its arm"), (ours, "ours on the ground-truth arm"))
    ):
        t = PERIOD * np.arange(len(q))
        for column, ax in enumerate(axes[row]):
            for j in range(7):
                ax.plot(t, q[:, j], linewidth=1.1, label=_JOINTS[j], color=f"C{j}")
            ax.set_title(f"{label}{', close up' if column else ''}", fontsize=10)
            ax.set_xlabel("time [s]", fontsize=8)
            ax.set_ylabel("position [rad]", fontsize=8)
            ax.grid(alpha=0.3)
            ax.tick_params(labelsize=7)
            if column:
                ax.set_ylim(-0.1, 0.1)
    axes[0, 0].legend(ncols=4, fontsize=8, loc="upper right")
    figure.suptitle("Fig. 7 redone: step to zero")
    save_figure(figure, path)
