"""The mechanisms of the simulated arms beside what is published: DH parameters of the MTM, remote centre of the PSM."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.experiments.reproduction.drift_experiment import BAND, Drifts
from dvrk_drake.experiments.reproduction.mechanisms import (
    POSES,
    PSM_POSES,
    mechanism_errors,
    published_row,
    recomputed_table,
)
from dvrk_drake.experiments.reproduction.published import PAPER_ARM, TABLE_1
from dvrk_drake.experiments.reproduction.session import ReproductionSession
from dvrk_drake.models.arm import load_arm
from dvrk_drake.models.plant import make_arm_plant
from dvrk_drake.reports.figures.style import MODEL_COLOUR, save_figure
from dvrk_drake.reports.reproduction.page import ResultTable, Section, numbers, share


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
            "carries elbow torque to the shoulder's motor and has stops in q2 + q3, and L1, which affects no joint.",
        ),
        (ResultTable("table1", "DH parameters [rad, m], theta = +-q + offset", header, tuple(rows)),),
    )


_FILE = "psm_release.png"


def reproduce_psm(session: ReproductionSession) -> Section:
    """The mechanism's facts beside the paper's file's, then releases of a simulated PSM."""
    psm, sample_sizes = session.psm, session.sample_sizes
    poses = session.random_poses("psm", sample_sizes.psm_releases)
    ours = session.release("psm", psm.truth, psm.file, poses, "PSM: releasing ours")
    nominal = session.folder / "psm_nominal.yaml"
    psm_nominal = type(psm.model).from_arm(load_arm("psm"))
    psm_nominal.save(nominal)
    drawn = session.release("psm", psm.truth, nominal, poses, "PSM: releasing the model as drawn")
    _plot(session.folder / _FILE, ours, drawn)
    names = ours.arm.joint_names
    disabled = [joint.name for joint in psm.model.joints if joint.feedforward_scale == 0.0]
    rows = (
        ("model as drawn (mean)", *numbers(np.abs(drawn.final).mean(axis=0), "{:.4f}")),
        ("ours (mean)", *numbers(np.abs(ours.final).mean(axis=0), "{:.4f}")),
        ("ours (largest at any time)", *numbers(ours.largest.max(axis=0), "{:.4f}")),
        ("model as drawn, share held", *numbers(drawn.held.mean(axis=0), "{:.3f}")),
        ("ours, share held", *numbers(ours.held.mean(axis=0), "{:.3f}")),
    )
    remarks = (
        "The paper shows a model and no experiment: its masses are placeholders. The table sets its file's faults "
        "beside what our plant gives when it is asked.",
        f"{psm.truth.origin} Ours is identified from {sample_sizes.collected} poses collected on it. Each release is "
        f"at a random pose inside the limits, watched for {sample_sizes.duration:g} s under gravity compensation "
        f"alone. **Every joint stays within {1e3 * BAND[0]:.0f} mrad ({1e3 * BAND[1]:.1f} mm) at "
        f"{share(ours.num_held, len(poses))}** of the poses with ours, at {share(drawn.num_held, len(poses))} with "
        "the model as drawn.",
        f"`identify` gives no torque to {', '.join(disabled) or 'no joint'}: what it measured there is below 2 % of "
        "the effort limit or no better than zero. Friction alone must hold these, and where the spring of the roll "
        "exceeds it, far from its middle, it does not.",
    )
    release = ResultTable("psm_release", "Absolute drift after release [rad; insertion m]", ("", *names), rows)
    shows = "PSM: largest drift of each release, sorted"
    return Section("psm", "Fig. 8: the PSM", remarks, (_facts(), release), {_FILE: shows})


def _facts() -> ResultTable:
    arm = load_arm("psm")
    remote, angle = mechanism_errors(arm)
    plant = make_arm_plant(arm, closure="ball")
    masses = [
        plant.get_body(i).default_mass() for i in plant.GetBodyIndices(plant.GetModelInstanceByName(_instance(plant)))
    ]
    yaw = arm.joint_names.index("yaw")
    rows = (
        (
            "loops of the linkage",
            "second parents of links: Finalize() refuses the file",
            "cut and pinned: it simulates",
        ),
        (
            "remote centre of motion",
            "none exactly: the front four-bar has bars .530/.535, ends .0370/.0407 m",
            f"kept to {remote:.0e} m over {PSM_POSES} random poses",
        ),
        ("wrist yaw axis", "equals the wrist pitch axis", f"{np.degrees(angle):.1f} degrees from the wrist pitch axis"),
        ("yaw", "locked by its limits", f"{arm.position_lower[yaw]:+.3f}..{arm.position_upper[yaw]:+.3f} rad"),
        ("inertias", "1 kg m^2 each, centres of mass at the origins", f"from shapes, {sum(masses):.2f} kg in all"),
        (
            "prismatic joint",
            "all 15 joints revolute in the file, one prismatic in the text",
            "insertion, one of 7 joints",
        ),
    )
    return ResultTable("psm", "The PSM's model", ("", "the paper's file", "ours"), rows)


def _instance(plant: MultibodyPlant) -> str:
    return plant.GetModelInstanceName(plant.GetBodyByName("base_link").model_instance())


def _plot(path: Path, ours: Drifts, drawn: Drifts) -> None:
    names, prismatic = ours.arm.joint_names, ours.arm.prismatic
    figure, axes = plt.subplots(2, 4, figsize=(13, 6.5), layout="constrained", sharey=True)
    band = ours.arm.per_joint(*BAND)
    for j, ax in enumerate(axes.flat[: len(names)]):
        for drifts, colour, label in ((drawn, "#8d8d8d", "model as drawn"), (ours, MODEL_COLOUR, "ours")):
            sizes = np.sort(np.maximum(drifts.largest[:, j], 1e-6))
            shares = 100 * np.arange(len(sizes) + 1) / len(sizes)
            ax.step(np.append(sizes[0], sizes), shares, where="post", color=colour, label=label)
        ax.axvline(band[j], color="black", linestyle=":", label="15 mrad (1.5 mm)")
        ax.set_xscale("log")
        ax.set_title(names[j], fontsize=10)
        ax.set_xlabel(f"largest drift [{'m' if prismatic[j] else 'rad'}]", fontsize=8)
        ax.set_ylabel("poses [%]", fontsize=8)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(names) :]:
        ax.axis("off")
    axes.flat[-1].legend(*axes.flat[0].get_legend_handles_labels(), loc="center", fontsize=9)
    figure.suptitle(f"PSM after release: largest drift at {len(ours.positions)} random poses")
    save_figure(figure, path)
