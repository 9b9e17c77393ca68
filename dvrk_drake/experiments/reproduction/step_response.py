"""Step responses of a simulated MTM with the paper's controller and with our controller (Fig. 7 of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
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
from dvrk_drake.experiments.reproduction.published import PAPER
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
