"""Reproduces Fig. 5 and 6: drift of the released arm, compared with the published drift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.friction_compensation import MAX_HYSTERESIS_RATIO
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.reproduction import published
from dvrk_drake.experiments.reproduction.drift_experiment import APPROACH, APPROACH_TIMES, BAND, SAMPLE_PERIOD, Drifts
from dvrk_drake.experiments.reproduction.published import PAPER_ARM
from dvrk_drake.experiments.reproduction.session import ReproductionSession
from dvrk_drake.experiments.tuning.model_based import friction
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_NAMES
from dvrk_drake.reports.colours import FITTED, LIMIT, MEASURED, REFERENCE
from dvrk_drake.reports.page import Plot
from dvrk_drake.reports.plot import Curve, Guide, Mark, Panel, joint_label, length_unit
from dvrk_drake.reports.reproduction.page import ResultTable, Section, numbers, share
from dvrk_drake.systems.gravity_pid_controller import Mode

#: Interval over which a drift rate is averaged [s].
RATE_TIME = 1.0
#: Smallest drawn drift [rad; m]. Smaller drifts are drawn at this value.
SMALLEST_DRIFT = 1e-5
_UNPUBLISHED = ("-",)


def drift_table(
    name: str,
    what: str,
    trial: Sequence[float],
    means: Sequence[float],
    paper: Drifts,
    ours: Drifts,
    hand_guided: Drifts | None = None,
    hysteresis_compensated: Drifts | None = None,
) -> ResultTable:
    """Returns a table of the published drifts, and of the simulated drifts with the paper's model and with ours.

    Args:
        name: Name of the table.
        what: Condition of the experiment, for the title.
        trial: Published drifts (6,) of joints 2-7 at the end of one trial [rad].
        means: Published mean drifts (6,) of joints 2-7 [rad].
        paper: Drifts with the paper's model.
        ours: Drifts with our model.
        hand_guided: Drifts with our model after a hand guided the arm to the pose. None: no rows for this case.
        hysteresis_compensated: Like `hand_guided`, but with hysteresis compensation.
    """
    rows: tuple[tuple[str, ...], ...] = (
        ("published, trial of the figure (final)", *_UNPUBLISHED, *numbers(np.abs(trial), "{:.4f}")),
        ("published, five trials (mean)", *_UNPUBLISHED, *numbers(means, "{:.4f}")),
        (f"the paper's, {len(paper.positions)} poses (mean)", *numbers(np.abs(paper.final).mean(axis=0), "{:.4f}")),
        (f"ours, {len(ours.positions)} poses (mean)", *numbers(np.abs(ours.final).mean(axis=0), "{:.4f}")),
        ("the paper's (largest at any time)", *_largest(paper)),
        ("ours (largest at any time)", *_largest(ours)),
        ("the paper's, share held", *_shares(paper)),
        ("ours, share held", *_shares(ours)),
    )
    if hand_guided is not None:
        rows += (
            (f"ours, hand-guided, {len(hand_guided.positions)} poses (largest at any time)", *_largest(hand_guided)),
            ("ours, hand-guided, share held", *_shares(hand_guided)),
        )
    if hysteresis_compensated is not None:
        rows += (
            ("ours, hand-guided, hysteresis compensated (largest at any time)", *_largest(hysteresis_compensated)),
            ("ours, hand-guided, hysteresis compensated, share held", *_shares(hysteresis_compensated)),
        )
    return ResultTable(name, f"Absolute drift after release [rad], {what}", ("", *_JOINTS), rows)


def _largest(drifts: Drifts) -> tuple[str, ...]:
    return numbers(drifts.largest.max(axis=0), "{:.4f}")


def _shares(drifts: Drifts) -> tuple[str, ...]:
    return numbers(drifts.held.mean(axis=0), "{:.3f}")


def torque_table(session: ReproductionSession) -> ResultTable:
    """Returns a table of the RMS torque errors of the paper's model and of ours at random poses."""
    mtm = session.mtm
    q = session.random_poses(PAPER_ARM, 500)
    true = mtm.truth.model.holding_torque(q)
    paper = IdentifiedModel.load(session.paper_file).holding_torque(q)

    def rms(values: NDArray[np.float64]) -> tuple[str, ...]:
        return numbers(np.sqrt(np.mean(values**2, axis=0)), "{:.4f}")

    rows = (
        ("zero torque", *rms(true)),
        ("the paper's", *rms(paper - true)),
        ("ours", *rms(mtm.model.holding_torque(q) - true)),
        ("dry friction of the joint (for comparison)", *numbers(friction(mtm.truth.arm)[0], "{:.4f}")),
    )
    return ResultTable(
        "fig5_torques", "RMS torque error [N m] at random poses over the joint range", ("", *_JOINTS), rows
    )


def rate_table(releases: dict[str, Drifts]) -> ResultTable:
    """Returns a table of drift rates in the first, the last and the worst interval of length `RATE_TIME`.

    Args:
        releases: Mapping from the name of a controller to the drifts with this controller.
    """
    window = round(RATE_TIME / SAMPLE_PERIOD)
    rows = []
    for label, drifts in releases.items():
        q = drifts.positions
        rate = np.abs(q[:, window:] - q[:, :-window]) / RATE_TIME
        rows.append((f"{label}: first second, median", *numbers(np.median(rate[:, 0], axis=0), "{:.3f}")))
        rows.append((f"{label}: last second, median", *numbers(np.median(rate[:, -1], axis=0), "{:.3f}")))
        rows.append((f"{label}: any second, largest", *numbers(rate.max(axis=(0, 1)), "{:.3f}")))
    title = "Drift rate without friction, averaged over one second [rad/s]"
    return ResultTable("fig5_without_friction", title, ("", *_JOINTS), tuple(rows))


_JOINTS = tuple(f"J{j}" for j in range(1, 8))
#: Simulated time after the release of an arm without friction [s].
FRICTIONLESS_DURATION = 3.0


def reproduce_figure_5(session: ReproductionSession) -> Section:
    """Simulates releases with torques on all joints: with both models, after hand guiding, and without friction."""
    mtm, sample_sizes = session.mtm, session.sample_sizes
    poses = session.random_poses(PAPER_ARM, sample_sizes.releases)
    few = poses[: sample_sizes.paper_releases]
    ours = session.release(PAPER_ARM, mtm.truth, mtm.file, poses, "Fig. 5: releasing ours")
    paper = session.release(PAPER_ARM, mtm.truth, session.paper_file, few, "Fig. 5: releasing the paper's")
    hand_guided = session.release(
        PAPER_ARM,
        mtm.truth,
        mtm.file,
        poses[: sample_sizes.hand_guided_releases],
        "Fig. 5: hand-guiding and releasing ours",
        approach="regulated",
    )
    hysteresis_compensated = session.release(
        PAPER_ARM,
        mtm.truth,
        mtm.file,
        poses[: sample_sizes.hand_guided_releases],
        "Fig. 5: hand-guiding and releasing, hysteresis compensated",
        approach="regulated",
        hysteresis_ratio=MAX_HYSTERESIS_RATIO,
    )
    other_effects = [name for name in EFFECT_NAMES if name != "friction"]

    def release_without_friction(model: Path, where: NDArray[np.float64], what: str, mode: Mode = "gravity") -> Drifts:
        return session.release(
            PAPER_ARM,
            mtm.truth,
            model,
            where,
            f"Fig. 5: no friction, {what}",
            other_effects,
            mode,
            max_duration=FRICTIONLESS_DURATION,
        )

    frictionless_paper = release_without_friction(session.paper_file, few, "the paper's")
    frictionless_ours = release_without_friction(mtm.file, few, "ours")
    damped = release_without_friction(mtm.file, poses, "ours damped", mode="damped")
    without_friction = {"the paper's": frictionless_paper, "ours": frictionless_ours, "ours with damping": damped}
    what = "all torques on"
    plots = _plots("fig5", what, ours, paper, published.FIGURE_5, published.FIGURE_5_MEANS)
    tables = (
        drift_table(
            "fig5",
            "all torques on",
            published.FIGURE_5,
            published.FIGURE_5_MEANS,
            paper,
            ours,
            hand_guided,
            hysteresis_compensated,
        ),
        torque_table(session),
        rate_table(without_friction),
    )
    remarks = (
        mtm.truth.origin,
        f"**Ours** is identified from {sample_sizes.collected} poses, collected on the ground-truth arm with "
        "friction, noise and encoders. Each pose was approached from both sides. The controller compensates gravity "
        f"with this model and applies no other torque. **The paper's** is {_whose(session)}. Each release starts at "
        "rest, with unloaded presliding springs of the friction, at a random pose inside the joint limits. Each "
        f"simulation lasts {sample_sizes.duration:g} s. In the first table, a joint is held if it stays within "
        f"{1e3 * BAND[0]:.0f} mrad.",
        f"**Ours keeps all joints within {1e3 * BAND[0]:.0f} mrad at {share(ours.num_held, len(poses))}** of the "
        f"poses. The shares for single joints are: {_per_joint(ours)}. The paper's parameters hold all joints at "
        f"{share(paper.num_held, len(few))} of the poses. Most releases fail at {_lost(paper)}, where the torque error "
        "exceeds the dry friction (second table). This torque error is caused by the unweighted least squares and the "
        "missing spring, as in Fig. 4. The published drifts differ, because the real arm was placed by hand, its "
        "cables have hysteresis, and the friction of the simulated arm was identified on another MTM.",
        f"**Hand-guided**: the arm is moved to the pose from a distance of {APPROACH[0]:g} rad and regulated for "
        f"{APPROACH_TIMES['regulated'][1]:g} s. This motion loads the presliding springs of the friction. Then ours "
        f"holds all joints at {share(hand_guided.num_held, len(hand_guided.positions))} of the poses. Number of failed "
        f"releases by joint: {_any_lost(hand_guided)}. The gravity compensation does not compensate the loaded "
        "springs. Hysteresis with a width of 0.06-0.25 rad pushes joints 2 and 3 back, and less friction remains to "
        "resist the model error. "
        "The friction of joint 7 deflects by 15 mrad before it slips. An exact model causes the same drift. The "
        "published drifts of joints 2 and 3, up to 0.13 rad, have a similar size.",
        f"**With compensated hysteresis** (`control --hysteresis-ratio {MAX_HYSTERESIS_RATIO:g}`, exact friction "
        f"model), the arm is released at {len(hysteresis_compensated.positions)} poses. Number of failed releases by "
        f"joint: {_any_lost(hysteresis_compensated)}. The largest drift is {_furthest(hysteresis_compensated)} mrad.",
        "**Without friction**, only an exact model keeps an arm at rest, because a small torque error accelerates "
        f"the wrist by tens of rad/s^2. Within {FRICTIONLESS_DURATION:g} s, the arm usually reaches a joint limit "
        f"with both models. No joint reaches a limit at {_num_staying(frictionless_paper)} (paper's) and "
        f"{_num_staying(frictionless_ours)} (ours) of {len(few)} poses. **No gravity compensation alone passes this "
        "test.** With damping (`control --mode damped`), the arm creeps at the rates of the third table. Each rate is "
        "the torque error divided by the damping. The arm does not accelerate.",
    )
    title = "Fig. 5: drift after release, all torques"
    return Section("fig5", title, _finding(ours, paper), remarks, tables, plots)


def reproduce_figure_6(session: ReproductionSession) -> Section:
    """Simulates releases with zero torque on joints 5-7, as in the paper."""
    mtm, sample_sizes = session.mtm, session.sample_sizes
    few = session.random_poses(PAPER_ARM, sample_sizes.paper_releases)
    zeroed = session.without_wrist_torque(session.paper_file)
    paper = session.release(PAPER_ARM, mtm.truth, zeroed, few, "Fig. 6: releasing the paper's")
    ours = session.release(PAPER_ARM, mtm.truth, session.without_wrist_torque(mtm.file), few, "Fig. 6: releasing ours")
    what = "zero torque on joints 5-7"
    plots = _plots("fig6", what, ours, paper, published.FIGURE_6, published.FIGURE_6_MEANS)
    table = drift_table("fig6", "zero torque on joints 5-7", published.FIGURE_6, published.FIGURE_6_MEANS, paper, ours)
    remarks = (
        f"The experiment uses the arm and the first {len(few)} poses of Fig. 5. Joints 5-7 have zero torque, so only "
        "friction resists gravity. With the paper's parameters on joints 1-4, all joints are held "
        f"at {share(paper.num_held, len(few))} of the poses. With ours, all joints are held at "
        f"{share(ours.num_held, len(few))}. Joint 5 still falls at poses where its gravity and spring torque exceeds "
        "its friction.",
        "The gravity torque of joints 6 and 7 is identified from the recording of 72 poses and is about as large as "
        "their friction. Therefore these joints drift less than in the published trials. Fig. 5 describes the "
        "ground-truth arm.",
    )
    title = "Fig. 6: drift after release, zero torque on joints 5-7"
    return Section("fig6", title, _finding(ours, paper), remarks, (table,), plots)


def _finding(ours: Drifts, paper: Drifts) -> str:
    return (
        f"All joints stay within {1e3 * BAND[0]:.0f} mrad at {share(ours.num_held, len(ours.positions))} of the poses "
        f"with our model, and at {share(paper.num_held, len(paper.positions))} with the paper's."
    )


def _whose(session: ReproductionSession) -> str:
    if session.mtm.truth.is_paper_arm:
        return "the set of twelve published parameters. It was identified with g = 9.9 m/s^2 and used with 9.81 m/s^2"
    return (
        "unweighted least squares on the same poses, because the recording for the published parameters is not "
        "available"
    )


def _lost(drifts: Drifts) -> str:
    """Returns the names of the joints that are held in less than half of the releases."""
    lost = [joint for joint, held in zip(_JOINTS, drifts.held.mean(axis=0), strict=True) if held < 0.5]
    return ", ".join(lost) if lost else "single joints"


def _any_lost(drifts: Drifts) -> str:
    lost = [f"{joint} ({n})" for joint, n in zip(_JOINTS, np.sum(~drifts.held, axis=0), strict=True) if n]
    return ", ".join(lost) or "none"


def _furthest(drifts: Drifts) -> str:
    return f"{1e3 * drifts.largest.max():.0f}"


def _num_staying(drifts: Drifts) -> int:
    """Returns the number of releases in which no joint moves to one of its limits."""
    arm = drifts.arm
    edge = arm.per_joint(*BAND)
    q = drifts.positions
    inside = (q > arm.position_lower + edge) & (q < arm.position_upper - edge)
    ran = ~inside & (np.abs(q - q[:, :1]) > 2 * edge)
    return int(np.count_nonzero(~np.any(ran, axis=(1, 2))))


def _per_joint(drifts: Drifts) -> str:
    return ", ".join(
        f"{joint} {100 * held:.1f} %" for joint, held in zip(_JOINTS, drifts.held.mean(axis=0), strict=True)
    )


def _plots(
    name: str, what: str, ours: Drifts, paper: Drifts, trial: Sequence[float], means: Sequence[float]
) -> tuple[Plot, Plot]:
    """Returns the drift of one release over time, and the distribution of the largest drift of each release."""
    wrist = np.abs(paper.final[:, 4:]).max(axis=1)
    typical = int(np.argsort(wrist)[len(wrist) // 2])
    releases = {"the paper's parameters": (REFERENCE, paper), "ours": (FITTED, ours)}
    return (
        _time_plot(f"{name}_time", what, ours, paper, typical, trial),
        largest_drifts_plot(f"{name}_distribution", what, releases, means),
    )


def _band_label(arm: Arm) -> str:
    length = f" ({1e3 * BAND[1]:.1f} mm)" if np.any(arm.prismatic) else ""
    return f"limit for a held joint: {1e3 * BAND[0]:.0f} mrad{length}"


def _time_plot(name: str, what: str, ours: Drifts, paper: Drifts, release: int, trial: Sequence[float]) -> Plot:
    arm, panels = ours.arm, []
    t = SAMPLE_PERIOD * np.arange(ours.positions.shape[1])
    for j in range(arm.num_joints):
        marks: list[Mark] = []
        for drifts, colour, label in ((paper, REFERENCE, "the paper's parameters"), (ours, FITTED, "ours")):
            q = drifts.positions[release, :, j]
            marks.append(Curve(f"{label}, simulated", t, q - q[0], colour))
        marks += [Guide("y", sign * BAND[0], None, LIMIT, _band_label(arm)) for sign in (-1, 1)]
        if j:
            marks.append(Guide("y", trial[j - 1], None, MEASURED, "published (measured), end of the trial"))
        panels.append(Panel(joint_label(arm, j), marks, "time since release [s]", "drift [rad]"))
    caption = f"Drift after release, {what}, at the pose with the median wrist drift of the paper's parameters"
    return Plot(name, caption, panels, columns=2)


def largest_drifts_plot(
    name: str,
    what: str,
    releases: Mapping[str, tuple[str, Drifts]],
    published_means: Sequence[float] | None = None,
) -> Plot:
    """Returns the cumulative distribution of the largest drift of each release, with the same range for all joints.

    Args:
        name: Name of the plot.
        what: Condition of the experiment, for the caption.
        releases: Mapping from the name of a model to its colour and its drifts.
        published_means: Published mean drifts (n - 1,) of all joints but the first [rad].
    """
    first = next(iter(releases.values()))[1]
    arm, band, panels = first.arm, first.arm.per_joint(*BAND), []
    largest = max(float(drifts.largest.max()) for _, drifts in releases.values())
    limits = (0.8 * SMALLEST_DRIFT, 1.5 * max(largest, 10 * SMALLEST_DRIFT))
    for j in range(arm.num_joints):
        marks: list[Mark] = []
        for label, (colour, drifts) in releases.items():
            sizes = np.sort(np.maximum(drifts.largest[:, j], SMALLEST_DRIFT))
            shares = 100 * np.arange(len(sizes) + 1) / len(sizes)
            marks.append(Curve(label, np.append(sizes[0], sizes), shares, colour, "step"))
        marks.append(Guide("x", float(band[j]), None, LIMIT, _band_label(arm)))
        if published_means is not None and j:
            marks.append(Guide("x", published_means[j - 1], None, MEASURED, "published, mean of five trials"))
        labels = f"largest drift [{length_unit(arm, j)}]", "cumulative share [%]"
        panels.append(Panel(joint_label(arm, j), marks, *labels, x_range=limits, log_x=True))
    counts = ", ".join(f"{len(drifts.positions)} poses with {label}" for label, (_, drifts) in releases.items())
    caption = (
        f"Largest drift of each release, {what}: {counts}. The share at the dashed line is the share of held joints"
    )
    return Plot(name, caption, panels, columns=2)
