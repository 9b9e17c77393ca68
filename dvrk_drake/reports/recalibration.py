"""A recalibration as a table in a terminal."""

from __future__ import annotations

import numpy as np
from rich.console import Console

from dvrk_drake.analysis.recalibration import FOLDS, Recalibration
from dvrk_drake.reports.terminal_tables import make_table


def print_recalibration(console: Console, result: Recalibration) -> None:
    """Errors before and after, what is kept, and the new scales."""
    title = f"Error over {result.seconds:.1f} s*, and friction after the fit to all of it"
    table = make_table(title, "", "before", "refit", "", "dry friction x", "viscous x", "offset +")
    for a in result.actuators:
        new = [_scale(a.dry), _scale(a.viscous), f"{a.offset:+.4f}"] if a.kept else ["as it was", "", ""]
        table.add_row(a.name, f"{100 * a.before:.1f} %", f"{100 * a.after:.1f} %", "kept" if a.kept else a.reason, *new)
    before, after = (float(np.mean([getattr(a, which) for a in result.actuators])) for which in ("before", "after"))
    table.add_row("mean", f"{100 * before:.1f} %", f"{100 * after:.1f} %", "", "", "", "")
    console.print(table)
    console.print(
        "* actuators: |tau_f - tau_hat| / |tau_f| behind the model's low-pass; refit: each of "
        f"{FOLDS} parts of the motion predicted from the others\n",
        style="dim",
    )
    console.print(
        "This gain is for motions like the recalibration recording. At other positions and speeds it can be much "
        "smaller: validate the new model on the motion that you need.\n",
        soft_wrap=True,
    )
    shared = [f"{name} x {scale:.2f}" for name, scale in result.shared.items()]
    if shared:
        console.print(f"friction that actuators share: {', '.join(shared)}", soft_wrap=True)


def _scale(scale: float | None) -> str:
    return "none" if scale is None else f"{scale:.2f}"
