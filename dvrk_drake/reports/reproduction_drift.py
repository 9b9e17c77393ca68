"""Sections of Fig. 5, 6 and 8: drift of released arms, compared with the published drift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.dynamics.friction_compensation import MAX_HYSTERESIS_RATIO
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.paper import PAPER, ReproductionSession, with_zero_torque
from dvrk_drake.experiments.releases import APPROACH, APPROACH_TIME, APPROACHED_RELEASE, BAND, SAMPLE_PERIOD, Drifts
from dvrk_drake.experiments.study_run import wilson_interval
from dvrk_drake.experiments.tuning_model_based import friction
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.reports.colours import FITTED, LIMIT, MEASURED, REFERENCE
from dvrk_drake.reports.page import Block, Plot, Section, Table, Text
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel, joint_label, length_unit

#: Smallest drawn drift [rad; m]. Smaller drifts are drawn at this value.
SMALLEST_DRIFT = 1e-5
JOINTS = tuple(f"J{j}" for j in range(1, 8))
PAPERS, OURS = "the paper's", "ours"


def numbers(values: ArrayLike, pattern: str) -> tuple[str, ...]:
    """Returns each number as text, formatted with a pattern such as ".3f"."""
    return tuple(f"{x:{pattern}}" for x in np.asarray(values).tolist())


def share(held: int, total: int) -> str:
    """Returns the share held / total, with its 95 % confidence interval (Wilson, 1927), as text."""
    low, high = wilson_interval(held, total)
    return f"{held} of {total} ({100 * held / total:.1f} %, 95 % interval {100 * low:.1f}..{100 * high:.1f} %)"


def reproduce_figure_5(session: ReproductionSession) -> Section:
    """Simulates releases with torques on all joints: with both models, and after an approach."""
    mtm, sizes, theirs = session.mtm, session.sample_sizes, session.paper_model
    many, few = sizes.releases, sizes.few_releases
    approached = partial(session.release, mtm, mtm.model, few, approach=True)
    ours = session.release(mtm, mtm.model, many, "releasing ours")
    paper = session.release(mtm, theirs, few, "releasing the paper's")
    drifts = {
        PAPERS: paper,
        OURS: ours,
        "ours, after an approach": approached("releasing ours after an approach"),
        "ours, after an approach, hysteresis compensated": approached(
            "releasing ours, hysteresis compensated", hysteresis_ratio=MAX_HYSTERESIS_RATIO
        ),
    }
    remarks = (
        "The controller compensates gravity only. Each release starts at rest, at a random pose inside the limits, and "
        f"lasts {sizes.duration:g} s. Joints that the paper's model does not hold in half of the releases: "
        f"{_lost(paper)}. There, its torque error exceeds the dry friction.",
        f"**After an approach**: the controller moves the arm to the pose from a distance of {APPROACH[0]:g} rad and "
        f"regulates it for {APPROACHED_RELEASE - APPROACH_TIME:g} s. This motion loads the presliding springs of the "
        "friction, which then push joints back. Failed releases by joint: "
        + "; ".join(f"{name}: {_failed(drifts[name])}" for name in list(drifts)[2:])
        + f". Hysteresis is compensated with a ratio of {MAX_HYSTERESIS_RATIO:g} and the exact friction model.",
    )
    tables = (
        _drift_table("fig5", "all torques on", drifts, PAPER.figure_5, PAPER.figure_5_means),
        _torque_table(session),
    )
    plots = _plots("fig5", "all torques on", ours, paper, PAPER.figure_5, PAPER.figure_5_means)
    title = "Fig. 5: drift after release, all torques"
    return Section(title, [_finding(ours, paper, "the paper's"), *tables, *plots, *map(Text, remarks)])


def reproduce_figure_6(session: ReproductionSession) -> Section:
    """Simulates releases with zero torque on the joints of the wrist, as in the paper."""
    mtm, few = session.mtm, session.sample_sizes.few_releases
    paper, ours = (
        session.release(mtm, with_zero_torque(model, PAPER.wrist), few, f"releasing {whose}")
        for whose, model in ((PAPERS, session.paper_model), (OURS, mtm.model))
    )
    what = "zero torque on joints 5-7"
    table = _drift_table("fig6", what, {PAPERS: paper, OURS: ours}, PAPER.figure_6, PAPER.figure_6_means)
    remark = Text(
        f"Same arm and first {few} poses as in Fig. 5. The identified gravity torque of joints 6 and 7 is about as "
        "large as their friction. Therefore these joints drift less than in the published trials."
    )
    plots = _plots("fig6", what, ours, paper, PAPER.figure_6, PAPER.figure_6_means)
    finding = _finding(ours, paper, "the paper's")
    return Section(f"Fig. 6: drift after release, {what}", [finding, table, *plots, remark])


def reproduce_psm(session: ReproductionSession) -> Section:
    """Simulates releases of a PSM with the nominal model and with ours."""
    psm, few = session.psm, session.sample_sizes.few_releases
    nominal_model = IdentifiedModel.from_arm(load_arm(psm.arm.source))
    ours = session.release(psm, psm.model, few, "releasing ours")
    nominal = session.release(psm, nominal_model, few, "releasing the nominal model")
    drifts = {"the nominal model": nominal, OURS: ours}
    disabled = [joint.name for joint in psm.model.joints if joint.feedforward_scale == 0.0]
    remark = Text(
        "The paper shows a model of the PSM without an experiment. Its masses are placeholders. `identify` disabled "
        f"the feedforward of these joints: {', '.join(disabled) or 'none'}. Only friction resists their torque."
    )
    plot = largest_drifts_plot("psm_release", "PSM", {name: (COLOURS[name], d) for name, d in drifts.items()})
    blocks: list[Block] = [
        _finding(ours, nominal, "the nominal model"),
        _drift_table("psm_release", "PSM", drifts),
        plot,
        remark,
    ]
    return Section("Fig. 8: the PSM", blocks)


COLOURS = {PAPERS: REFERENCE, "the nominal model": REFERENCE, OURS: FITTED}


def _drift_table(
    name: str,
    what: str,
    drifts: Mapping[str, Drifts],
    trial: Sequence[float] = (),
    means: Sequence[float] = (),
) -> Table:
    """Returns a table of the drifts with each model, and of the published drifts.

    Args:
        name: Name of the table.
        what: Condition of the experiment, for the caption.
        drifts: Drifts by the name of the model.
        trial, means: Published drifts (n - 1,) of all joints but the first: at the end of one trial, and means [rad].
    """
    arm, rows = next(iter(drifts.values())).arm, []
    if means:
        rows.append(("published, trial of the figure (final)", "-", *numbers(np.abs(trial), ".4f")))
        rows.append(("published, five trials (mean)", "-", *numbers(means, ".4f")))
    for label, case in drifts.items():
        rows.append((f"{label}, {len(case.positions)} poses (mean)", *numbers(np.abs(case.final).mean(axis=0), ".4f")))
        rows.append((f"{label} (largest at any time)", *numbers(case.largest.max(axis=0), ".4f")))
        rows.append((f"{label}, share held", *numbers(case.held.mean(axis=0), ".3f")))
    unit = "rad; m" if np.any(arm.prismatic) else "rad"
    headings = [joint_label(arm, j) for j in range(arm.num_joints)] if np.any(arm.prismatic) else JOINTS
    caption = f"Absolute drift after release [{unit}], {what}"
    note = f"A joint is held if it stays within {_band(arm)} of its release position."
    return Table(("", *headings), rows, caption, note, name=name)


def _torque_table(session: ReproductionSession) -> Table:
    """Returns a table of the RMS torque errors of the paper's model and of ours at random poses."""
    mtm = session.mtm
    q = session.random_poses(mtm.arm, 500)
    true = mtm.exact.holding_torque(q)

    def rms(values: NDArray[np.float64]) -> tuple[str, ...]:
        return numbers(np.sqrt(np.mean(values**2, axis=0)), ".4f")

    rows = (
        ("zero torque", *rms(true)),
        (PAPERS, *rms(session.paper_model.holding_torque(q) - true)),
        (OURS, *rms(mtm.model.holding_torque(q) - true)),
        ("dry friction of the joint (for comparison)", *numbers(friction(mtm.arm)[0], ".4f")),
    )
    caption = "RMS torque error [N m] at random poses over the joint range"
    return Table(("", *JOINTS), rows, caption, name="fig5_torques")


def _finding(ours: Drifts, other: Drifts, whose: str) -> Text:
    return Text(
        f"All joints stay within {_band(ours.arm)} at {share(ours.num_held, len(ours.positions))} of the poses with "
        f"our model, and at {share(other.num_held, len(other.positions))} with {whose}."
    )


def _band(arm: Arm) -> str:
    length = f" ({1e3 * BAND[1]:.1f} mm)" if np.any(arm.prismatic) else ""
    return f"{1e3 * BAND[0]:.0f} mrad{length}"


def _lost(drifts: Drifts) -> str:
    """Returns the names of the joints that are held in less than half of the releases."""
    lost = [joint for joint, held in zip(JOINTS, drifts.held.mean(axis=0), strict=True) if held < 0.5]
    return ", ".join(lost) or "none"


def _failed(drifts: Drifts) -> str:
    """Returns the joints that were not held, each with the number of such releases, and the largest drift."""
    lost = [f"{joint} ({n})" for joint, n in zip(JOINTS, np.sum(~drifts.held, axis=0), strict=True) if n]
    return f"{', '.join(lost) or 'none'}, largest drift {1e3 * drifts.largest.max():.0f} mrad"


def _plots(
    name: str, what: str, ours: Drifts, paper: Drifts, trial: Sequence[float], means: Sequence[float]
) -> tuple[Plot, Plot]:
    """Returns the drift of one release over time, and the distribution of the largest drift of each release."""
    wrist = np.abs(paper.final[:, PAPER.wrist]).max(axis=1)
    typical = int(np.argsort(wrist)[len(wrist) // 2])
    releases = {"the paper's parameters": (REFERENCE, paper), OURS: (FITTED, ours)}
    arm, panels = ours.arm, []
    t = SAMPLE_PERIOD * np.arange(ours.positions.shape[1])
    for j in range(arm.num_joints):
        marks: list[Mark] = []
        for label, (colour, drifts) in releases.items():
            q = drifts.positions[typical, :, j]
            marks.append(Curve(f"{label}, simulated", t, q - q[0], colour))
        band_label = f"limit for a held joint: {_band(arm)}"
        marks += [Guide("y", sign * BAND[0], None, LIMIT, band_label) for sign in (-1, 1)]
        if j:
            marks.append(Guide("y", trial[j - 1], None, MEASURED, "published (measured), end of the trial"))
        panels.append(Panel(joint_label(arm, j), marks, "time since release [s]", "drift [rad]"))
    caption = f"Drift after release, {what}, at the pose with the median wrist drift of the paper's parameters"
    over_time = Plot(f"{name}_time", caption, panels, columns=2)
    return over_time, largest_drifts_plot(f"{name}_distribution", what, releases, means)


def largest_drifts_plot(
    name: str,
    what: str,
    releases: Mapping[str, tuple[str, Drifts]],
    published_means: Sequence[float] = (),
) -> Plot:
    """Returns the cumulative distribution of the largest drift of each release, with the same range for all joints.

    Args:
        name: Name of the plot.
        what: Condition of the experiment, for the caption.
        releases: Mapping from the name of a model to its colour and its drifts.
        published_means: Published mean drifts (n - 1,) of all joints but the first [rad].
    """
    arm, panels = next(iter(releases.values()))[1].arm, []
    largest = max(float(drifts.largest.max()) for _, drifts in releases.values())
    limits = (0.8 * SMALLEST_DRIFT, 1.5 * max(largest, 10 * SMALLEST_DRIFT))
    for j in range(arm.num_joints):
        marks: list[Mark] = []
        for label, (colour, drifts) in releases.items():
            sizes = np.sort(np.maximum(drifts.largest[:, j], SMALLEST_DRIFT))
            shares = 100 * np.arange(len(sizes) + 1) / len(sizes)
            marks.append(Curve(label, np.append(sizes[0], sizes), shares, colour, "step"))
        band_label = f"limit for a held joint: {_band(arm)}"
        marks.append(Guide("x", float(arm.per_joint(*BAND)[j]), None, LIMIT, band_label))
        if published_means and j:
            marks.append(Guide("x", published_means[j - 1], None, MEASURED, "published, mean of five trials"))
        labels = f"largest drift [{length_unit(arm, j)}]", "cumulative share [%]"
        panels.append(Panel(joint_label(arm, j), marks, *labels, x_range=limits, log_x=True))
    counts = ", ".join(f"{len(drifts.positions)} poses with {label}" for label, (_, drifts) in releases.items())
    caption = (
        f"Largest drift of each release, {what}: {counts}. The share at the dashed line is the share of held joints"
    )
    return Plot(name, caption, panels, columns=2)
