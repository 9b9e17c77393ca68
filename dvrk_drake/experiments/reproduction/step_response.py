"""Step responses of a simulated MTM with the paper's controller and with our controller (Fig. 7 of the paper)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import LinkInertia, link_inertias
from dvrk_drake.experiments.ground_truth import with_links
from dvrk_drake.experiments.reproduction import published
from dvrk_drake.experiments.reproduction.published import PAPER_ARM
from dvrk_drake.experiments.simulation import samples
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import holding_torque, make_arm_plant, set_arm_positions, tree_selector
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: Duration of the simulations with the paper's controller and with our controller [s].
DURATION, OUR_DURATION = 60.0, 10.0
#: Period of the paper's controller and sample period of all results [s].
PERIOD = 0.01
#: Inertia of each link about each axis in the paper's model [kg m^2], from the PSM file of the paper's team and the
#: period of J2 in Fig. 7.
LINK_INERTIA = 1.0
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
            mass, inertia = published.FIGURE_7_MASSES[1 + driven_links.index(link.link)], LINK_INERTIA
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
    tree = tree_selector(plant, arm)
    own = tree[[arm.tree_joint_names.index(name) for name in arm.joint_names]]
    kp, kv, ki = map(np.array, (published.FIGURE_7_KP, published.FIGURE_7_KV, published.FIGURE_7_KI))
    integral, force = np.zeros(arm.num_joints), np.zeros(plant.num_velocities())
    port = plant.get_applied_generalized_force_input_port()
    start = np.array(published.FIGURE_7_START)
    start[5:] = published.FIGURE_7_VALUES["J6"], published.FIGURE_7_VALUES["J7 early"]
    set_arm_positions(plant, context, arm, start)
    samples = round(duration / PERIOD) + 1
    q = np.empty((samples, arm.num_joints))
    for k in range(samples):
        q[k] = plant.GetPositions(context)[own]
        v = plant.GetVelocities(context)[own]
        if faulty:
            v[list(published.FIGURE_7_FAULTY)] = q[k, list(published.FIGURE_7_FAULTY)]
        integral -= q[k]
        force[own] = _gravity(plant, simulator, arm) - kp * q[k] - kv * v + ki * integral
        port.FixValue(context, force)
        if k + 1 < samples:
            simulator.AdvanceTo((k + 1) * PERIOD)
        if k % 100 == 0:
            progress(k / samples)
    return q


def simulate_ours(ground_truth_arm: Arm, model: IdentifiedModel, duration: float) -> NDArray[np.float64]:
    """Simulates our controller with all effects except stops; returns q (samples, n) [rad], one row per `PERIOD`."""
    arm = load_arm(PAPER_ARM)
    station = ArmStation(arm, plant_arm=ground_truth_arm, effects=ground_truth_arm.effects.without("stops"))
    builder = DiagramBuilder()
    controller = GravityPidController(model)
    add_closed_loop(builder, station, controller, ConstantVectorSource(np.zeros(2 * arm.num_joints)))
    log = LogVectorOutput(station.GetOutputPort(f"{PAPER_ARM}.state_true"), builder, PERIOD)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    station.SetPositions(station.GetMyMutableContextFromRoot(context), published.FIGURE_7_START)
    simulator.AdvanceTo(duration)
    return samples(log, simulator)[:, : arm.num_joints]


def _gravity(plant: MultibodyPlant, simulator: Simulator, arm: Arm) -> NDArray[np.float64]:
    return holding_torque(plant, simulator.get_context(), arm)


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
    K, D = np.diag(published.FIGURE_7_KP), np.diag(published.FIGURE_7_KV)
    if faulty:
        wrist = list(published.FIGURE_7_FAULTY)
        K[wrist] += D[wrist]
        D[wrist] = 0.0
    zero, one = np.zeros_like(M), np.eye(len(M))
    values, vectors = np.linalg.eig(np.block([[zero, one], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]]))
    use = values.imag > 1e-6
    return values[use], vectors[: len(M), use]


def longest_period(arm: Arm) -> float:
    """Returns the longest period of the modes that move joint 2, with the faulty damping terms [s]."""
    values, vectors = oscillation_modes(arm, faulty=True)
    moves_joint_2 = np.abs(vectors[1]) > 0.1 * np.abs(vectors).max(axis=0)
    return float(2 * np.pi / values.imag[moves_joint_2].min())
