"""DH table of an arm (Table I of the paper), and step responses with the paper's and with our controller (Fig. 7)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

import dvrk_drake as dvrk
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.experiments.ground_truth import with_links
from dvrk_drake.experiments.paper import PAPER
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import EFFECT_NAMES
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions, tree_selector

#: Duration of the simulations with the paper's controller and with our controller [s].
DURATION, OUR_DURATION = 60.0, 10.0
#: Period of the paper's controller and sample period of all results [s].
PERIOD = 0.01
#: Mass [kg] and inertia [kg m^2] of linkage bars and rotors, which the paper's model does not have.
_NEGLIGIBLE = 1e-6


def paper_simulated_arm(arm: Arm, path: Path) -> Arm:
    """Returns the arm with the paper's point masses at the joints; writes its SDF to `path`."""
    plant = make_arm_plant(arm)
    driven_links = [plant.GetJointByName(name).child_body().name() for name in arm.joint_names]
    links = []
    for link in link_inertias(arm):
        mass, inertia = _NEGLIGIBLE, _NEGLIGIBLE
        if link.link in driven_links:
            mass, inertia = PAPER.masses[driven_links.index(link.link)], PAPER.link_inertia
        links.append(LinkInertia(link.link, np.array([mass, 0, 0, 0, inertia, inertia, inertia, 0, 0, 0])))
    return with_links(arm, links, path, "the paper's simulated MTM: point masses at the joints")


def simulate_paper_controller(
    arm: Arm, duration: float, faulty: bool, progress: Callable[[float], object] = lambda share: None
) -> NDArray[np.float64]:
    """Simulates the paper's controller (equation 11).

    Joints 6 and 7 start at their published amplitudes, since the published start pose does not excite them. In the
    paper's Gazebo simulation, an unknown disturbance excited them.

    Args:
        arm: Arm of `paper_simulated_arm`.
        duration: Duration [s].
        faulty: Whether the damping terms of some joints use positions instead of velocities, as in the
            controller that the paper's team published.
        progress: Function called with the finished share, 0..1.

    Returns:
        Positions (samples, n) [rad], one row per `PERIOD`.
    """
    plant = make_arm_plant(arm)
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    own = tree_selector(plant, arm)[[arm.tree_joint_names.index(name) for name in arm.joint_names]]
    kp, kv, ki = map(np.array, (PAPER.kp, PAPER.kv, PAPER.ki))
    integral, force = np.zeros(arm.num_joints), np.zeros(plant.num_velocities())
    start = [*PAPER.start[:5], PAPER.amplitude_6, PAPER.early_7]
    set_arm_positions(plant, context, arm, np.array(start))
    samples = round(duration / PERIOD) + 1
    q = np.empty((samples, arm.num_joints))
    for k in range(samples):
        q[k] = plant.GetPositions(context)[own]
        v = plant.GetVelocities(context)[own]
        if faulty:
            v[PAPER.wrist] = q[k, PAPER.wrist]
        integral -= q[k]
        force[own] = holding_torque(plant, context, arm) - kp * q[k] - kv * v + ki * integral
        plant.get_applied_generalized_force_input_port().FixValue(context, force)
        if k + 1 < samples:
            simulator.AdvanceTo((k + 1) * PERIOD)
        if k % 100 == 0:
            progress(k / samples)
    return q


def simulate_ours(arm: Arm, model: IdentifiedModel, duration: float) -> NDArray[np.float64]:
    """Simulates our controller with all effects except stops; returns q (samples, n) [rad], one row per `PERIOD`.

    The start pose is beyond the coupled limits of the arm, which its stops enforce. The desired position is zero from
    the start on, so the error is a step.
    """
    builder = DiagramBuilder()
    controller = builder.AddSystem(dvrk.GravityPidController(model))
    zero = builder.AddSystem(ConstantVectorSource(np.zeros(2 * arm.num_joints)))
    builder.Connect(zero.get_output_port(), controller.GetInputPort("desired_state"))
    builder.ExportInput(controller.GetInputPort("state_estimated"), "state_estimated")
    builder.ExportOutput(controller.GetOutputPort("effort"), "effort")
    unlimited = dataclasses.replace(arm, coupled_limits=())
    effects = [name for name in EFFECT_NAMES if name != "stops"]
    run = dvrk.simulate(
        unlimited,
        controller=builder.Build(),
        effects=effects,
        start=PAPER.start,
        duration=duration,
        sample_period=PERIOD,
        closure="mimic",
    )
    return run.state_true[:, : arm.num_joints]


def oscillation_modes(arm: Arm, faulty: bool) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Computes the oscillation modes of the arm about zero with the paper's gains, without the integral term.

    Args:
        arm: Arm of `paper_simulated_arm`.
        faulty: See `simulate_paper_controller`.

    Returns:
        Eigenvalues (k,) [1/s] with positive imaginary part, and the position components (n, k) of their eigenvectors.
    """
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, np.zeros(arm.num_joints))
    tree, G = tree_selector(plant, arm), arm.linkage.matrix
    M = G.T @ plant.CalcMassMatrix(context)[np.ix_(tree, tree)] @ G
    K, D = np.diag(PAPER.kp), np.diag(PAPER.kv)
    if faulty:
        K[PAPER.wrist] += D[PAPER.wrist]
        D[PAPER.wrist] = 0.0
    zero, one = np.zeros_like(M), np.eye(len(M))
    values, vectors = np.linalg.eig(np.block([[zero, one], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]]))
    use = values.imag > 1e-6
    return values[use], vectors[: len(M), use]


def longest_period(arm: Arm) -> float:
    """Returns the longest period of the modes that move joint 2, with the faulty damping terms [s]."""
    values, vectors = oscillation_modes(arm, faulty=True)
    moves_joint_2 = np.abs(vectors[1]) > 0.1 * np.abs(vectors).max(axis=0)
    return float(2 * np.pi / values.imag[moves_joint_2].min())


#: Number of random poses from which the rows of the DH table are computed.
TABLE_POSES = 20


def recomputed_table(arm: Arm) -> tuple[NDArray[np.float64], float]:
    """Computes the DH table of an arm from the motion of the plant's frames `paper_0` to `paper_n`.

    These frames are fixed to the links. If the motion between two consecutive frames is not that of a DH
    joint, the returned error is large.

    Returns:
        - Table (n, 5) with the columns sign, offset [rad], d [m], alpha [rad] and a [m].
        - Error: largest difference between corresponding entries of the DH matrices and the plant's transforms
          (translations in m).
    """
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    frames = [plant.GetFrameByName(f"paper_{i}") for i in range(arm.num_joints + 1)]
    poses = np.vstack([np.zeros(arm.num_joints), arm.sample_poses(TABLE_POSES, np.random.default_rng(0))])
    links = np.empty((len(poses), arm.num_joints, 4, 4))
    for k, q in enumerate(poses):
        set_arm_positions(plant, context, arm, q)
        links[k] = [child.CalcPose(context, parent).GetAsMatrix4() for parent, child in pairwise(frames)]
    rows, max_error = [], 0.0
    for j in range(arm.num_joints):
        A = links[:, j]
        theta = np.arctan2(A[:, 1, 0], A[:, 0, 0])
        sign = float(np.sign(np.median(np.sin(theta[1:] - theta[0]) * np.sin(poses[1:, j]))))
        offset = float(np.angle(np.mean(np.exp(1j * (theta - sign * poses[:, j])))))
        alpha = float(np.arctan2(A[0, 2, 1], A[0, 2, 2]))
        a = float(A[0, :2, 3] @ [np.cos(theta[0]), np.sin(theta[0])])
        rows.append([sign, offset, float(A[0, 2, 3]), alpha, a])
        recomputed = np.array([_dh_transform(sign * q + offset, rows[-1][2], alpha, a) for q in poses[:, j]])
        max_error = max(max_error, float(np.abs(recomputed - A).max()))
    table = np.round(rows, 12) + 0.0  # no -0
    table[:, [1, 3]] = np.where(table[:, [1, 3]] == np.round(-np.pi, 12), np.pi, table[:, [1, 3]])
    return table, max_error


def _dh_transform(theta: float, d: float, alpha: float, a: float) -> NDArray[np.float64]:
    """Returns the transform Rz(theta) Tz(d) Tx(a) Rx(alpha) (4, 4)."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1.0]])
