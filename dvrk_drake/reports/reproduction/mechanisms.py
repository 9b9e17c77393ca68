"""Compares the mechanisms of the simulated arms with the paper: DH parameters of the MTM, model of the PSM."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from dvrk_drake.experiments.reproduction.drift_experiment import BAND
from dvrk_drake.experiments.reproduction.mechanisms import (
    POSES,
    PSM_POSES,
    mechanism_errors,
    published_row,
    recomputed_table,
)
from dvrk_drake.experiments.reproduction.published import PAPER_ARM, TABLE_1
from dvrk_drake.experiments.reproduction.session import ReproductionSession
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import base_body, make_arm_plant
from dvrk_drake.reports.colours import FITTED, REFERENCE
from dvrk_drake.reports.reproduction.drift import largest_drifts_plot
from dvrk_drake.reports.reproduction.page import ResultTable, Section, numbers, share


def reproduce_table_1() -> Section:
    """Compares Table I of the paper with the DH parameters of the simulated MTM."""
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
        f"The simulated arm has the DH parameters of the paper, within {angles:.0e} rad and {lengths:.0e} m.",
        (
            f"The DH parameters of the plant are computed from the link poses at {POSES} random joint positions. "
            f"Their transformation matrices have an error of at most {worst:.0e}. These DH parameters differ from "
            f"Table I by at most {angles:.0e} rad and {lengths:.0e} m. Table I does not contain L1, which affects no "
            "joint. Table I also does not contain the parallelogram, which transmits elbow torque to the shoulder "
            "motor and has joint stops in q2 + q3.",
        ),
        (ResultTable("table1", "DH parameters [rad, m], theta = +-q + offset", header, tuple(rows)),),
    )


def reproduce_psm(session: ReproductionSession) -> Section:
    """Compares the paper's model of the PSM with ours, and simulates releases of a PSM."""
    psm, sample_sizes = session.psm, session.sample_sizes
    poses = session.random_poses("psm", sample_sizes.psm_releases)
    ours = session.release("psm", psm.truth, psm.file, poses, "PSM: releasing ours")
    nominal_file = session.folder / "psm_nominal.yaml"
    psm_nominal = type(psm.model).from_arm(load_arm("psm"))
    psm_nominal.save(nominal_file)
    nominal = session.release("psm", psm.truth, nominal_file, poses, "PSM: releasing the nominal model")
    releases = {"the nominal model": (REFERENCE, nominal), "ours": (FITTED, ours)}
    names = ours.arm.joint_names
    disabled = [joint.name for joint in psm.model.joints if joint.feedforward_scale == 0.0]
    rows = (
        ("nominal model (mean)", *numbers(np.abs(nominal.final).mean(axis=0), "{:.4f}")),
        ("ours (mean)", *numbers(np.abs(ours.final).mean(axis=0), "{:.4f}")),
        ("ours (largest at any time)", *numbers(ours.largest.max(axis=0), "{:.4f}")),
        ("nominal model, share held", *numbers(nominal.held.mean(axis=0), "{:.3f}")),
        ("ours, share held", *numbers(ours.held.mean(axis=0), "{:.3f}")),
    )
    remarks = (
        "The paper shows a model of the PSM without an experiment. The masses of this model are placeholders. The "
        "first table compares the file of the paper with our model.",
        f"{psm.truth.origin} Ours is identified from {sample_sizes.collected} poses of this arm. Each release starts "
        f"at a random pose inside the joint limits and lasts {sample_sizes.duration:g} s with gravity compensation "
        f"only. **All joints stay within {1e3 * BAND[0]:.0f} mrad ({1e3 * BAND[1]:.1f} mm) at "
        f"{share(ours.num_held, len(poses))}** of the poses with ours, and at {share(nominal.num_held, len(poses))} "
        "with the nominal model.",
        f"`identify` disabled the feedforward of these joints: {', '.join(disabled) or 'none'}. Their torque is below "
        "2 % of the effort limit, or the model is not more accurate than zero torque. Only friction resists the "
        "gravity and spring torque of these joints. Far from the middle of the joint range, the spring torque of the "
        "roll joint is larger than its friction.",
    )
    release = ResultTable("psm_release", "Absolute drift after release [rad; insertion m]", ("", *names), rows)
    finding = (
        f"With our model, all joints of the PSM stay within {1e3 * BAND[0]:.0f} mrad ({1e3 * BAND[1]:.1f} mm) at "
        f"{share(ours.num_held, len(poses))} of the poses, with the nominal model at "
        f"{share(nominal.num_held, len(poses))}."
    )
    plot = largest_drifts_plot("psm_release", "PSM", releases)
    return Section("psm", "Fig. 8: the PSM", finding, remarks, (_facts(), release), (plot,))


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
            "links with two parents: Finalize() rejects the file",
            "loop-closure constraints",
        ),
        (
            "remote centre of motion",
            "not exact: the front four-bar has bars of 0.530 and 0.535 m, ends of 0.0370 and 0.0407 m",
            f"error {remote:.0e} m at {PSM_POSES} random poses",
        ),
        (
            "wrist yaw axis",
            "identical to the wrist pitch axis",
            f"{np.degrees(angle):.1f} degrees from the wrist pitch axis",
        ),
        ("yaw", "locked by its limits", f"{arm.position_lower[yaw]:+.3f}..{arm.position_upper[yaw]:+.3f} rad"),
        ("inertias", "1 kg m^2 each, centres of mass at the origins", f"from shapes, total mass {sum(masses):.2f} kg"),
        (
            "prismatic joint",
            "all 15 joints revolute in the file, one prismatic in the text",
            "insertion, one of 7 joints",
        ),
    )
    return ResultTable("psm", "Models of the PSM", ("", "file of the paper", "ours"), rows)


def _instance(plant: MultibodyPlant) -> str:
    return plant.GetModelInstanceName(base_body(plant).model_instance())
