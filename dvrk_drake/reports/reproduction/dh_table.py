"""Table I of the paper beside the same table of the simulated plant."""

from __future__ import annotations

import numpy as np

from dvrk_drake.experiments.reproduction.mechanisms import POSES, published_row, recomputed_table
from dvrk_drake.experiments.reproduction.published import TABLE_1
from dvrk_drake.experiments.reproduction.recordings import PAPER_ARM
from dvrk_drake.models.arm import load_arm
from dvrk_drake.reports.reproduction.page import ResultTable, Section


def reproduce_table_1() -> Section:
    """Table I beside the same of the plant."""
    arm = load_arm(PAPER_ARM)
    ours, worst = recomputed_table(arm)
    published = np.array([published_row(row) for row in TABLE_1])
    rows = []
    for j, (mine, theirs, symbols) in enumerate(zip(ours, published, TABLE_1, strict=True)):
        theta = f"{'+' if symbols.sign > 0 else '-'}q{j + 1} {symbols.offset:+.4f}"
        mine_theta = f"{'+' if mine[0] > 0 else '-'}q{j + 1} {mine[1]:+.4f}"
        rows.append(
            (
                f"{j + 1}",
                theta,
                mine_theta,
                f"{symbols.d} = {theirs[2]:.4f}",
                f"{mine[2]:.4f}",
                f"{theirs[3]:+.4f}",
                f"{mine[3]:+.4f}",
                f"{symbols.a} = {theirs[4]:.4f}",
                f"{mine[4]:.4f}",
            )
        )
    angles = np.abs(np.angle(np.exp(1j * (ours - published)[:, [1, 3]]))).max()
    lengths = np.abs(ours - published)[:, [0, 2, 4]].max()
    header = (
        "joint",
        "theta, paper",
        "plant",
        "d [m], paper",
        "plant",
        "alpha, paper",
        "plant",
        "a [m], paper",
        "plant",
    )
    return Section(
        "table1",
        "Table I: DH parameters of the MTM",
        (
            f"Found from how the links of the simulated plant move at {POSES} random poses; the transforms that these "
            f"numbers give err by at most {worst:.0e}. They differ from the paper's by at most {angles:.0e} rad and "
            f"{lengths:.0e} m: it is the same arm. What differs is what the table leaves out: the parallelogram, which "
            "carries elbow torque to the shoulder's motor and has stops in q2 + q3, and L1, which no joint feels.",
        ),
        (ResultTable("table1", "DH parameters [rad, m], theta = +-q + offset", header, tuple(rows)),),
    )
