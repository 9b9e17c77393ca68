"""Runs a scenario: an arm under control, simulated and recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.analysis.scenario import Scenario
from dvrk_drake.models.plant import Closure
from dvrk_drake.models.recording import Recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode
from dvrk_drake.systems.joint_effect_torque import JointEffectTorque


@dataclass(frozen=True, eq=False)
class Simulation:
    """What a scenario gave.

    Attributes:
        recording: t, q, qd, tau (m, n) as the arm measures them: exact without `real_arm`, but for the scenario's noise
            on tau.
        desired: (m, n) where the arm was wanted; None in "gravity" mode.
    """

    recording: Recording
    desired: NDArray[np.float64] | None

    @property
    def time(self) -> NDArray[np.float64]:
        """(m,) of the recording's samples [s]."""
        assert self.recording.t is not None
        return self.recording.t


def simulate(
    scenario: Scenario, meshcat: Meshcat | None = None, progress: Callable[[float], None] = lambda share: None
) -> Simulation:
    """Simulates and records; the same scenario gives the same numbers, bit for bit.

    Between two poses the arm is led along a cubic in time, straight in joint space, so it stays inside linear limits.

    Args:
        scenario: what to do.
        meshcat: draws the arm there, in real time, and has the recording at the end.
        progress: called with the finished share, 0..1.

    Raises:
        ScenarioError: the scenario asks for what cannot be simulated.
    """
    scenario.check()
    arm = scenario.mounted_arm
    name = arm.name.lower()
    times, poses = scenario.knots()
    holds = scenario.controller.mode == "hold"
    station = ArmStation(
        arm,
        closure=cast(Closure, scenario.closure),
        time_step=scenario.time_step,
        meshcat=meshcat,
        effects=scenario.real_effects,
        seed=scenario.seed,
    )
    controller = GravityPidController(
        scenario.model,
        period=scenario.time_step,
        gains=scenario.controller.gains,
        mode=cast(Mode, scenario.controller.mode),
    )
    trajectory = _trajectory(times, poses, scenario.duration)
    desired = TrajectorySource(trajectory, output_derivative_order=1) if holds else None
    builder = DiagramBuilder()
    add_closed_loop(builder, station, controller, desired, _effect_torque(scenario))
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    station.set_positions(context, poses[0])
    if meshcat is not None:
        simulator.set_target_realtime_rate(1.0)
        meshcat.StartRecording()

    samples = 1 + int(scenario.duration / scenario.sample_period + 1e-9)
    t = scenario.sample_period * np.arange(samples, dtype=np.float64)
    ports = [station.GetOutputPort(f"{name}.{port}") for port in ("state_estimated", "effort_measured")]
    rows = []
    simulator.Initialize()
    for sample in t:
        if sample > 0:  # AdvanceTo(0) would make the plant's first step already
            simulator.AdvanceTo(sample)
        rows.append(np.concatenate([port.Eval(context) for port in ports]))
        progress(sample / scenario.duration)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    q, qd, tau = np.split(np.array(rows), 3, axis=1)
    noise = np.random.default_rng(scenario.seed).normal(size=tau.shape)
    tau = tau + scenario.effort_noise * arm.effort_limits * noise
    recording = Recording(q=q, qd=qd, tau=tau, t=t, source="simulation")
    return Simulation(recording, trajectory.vector_values(t).T if holds else None)


def _trajectory(times: NDArray[np.float64], poses: NDArray[np.float64], duration: float) -> PiecewisePolynomial:
    """At rest at each pose at its time, and at the last one until the end."""
    times, poses = np.append(times, max(duration, times[-1]) + 1.0), np.vstack([poses, poses[-1:]])
    return PiecewisePolynomial.CubicHermite(times, poses.T, np.zeros_like(poses.T))


def _effect_torque(scenario: Scenario) -> JointEffectTorque | None:
    if not scenario.effects:
        return None
    effects = [effect.effect for effect in scenario.effects]
    return JointEffectTorque(scenario.mounted_arm, effects, [effect.coefficient for effect in scenario.effects])
