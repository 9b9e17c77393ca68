"""Simulation and recording of a controlled arm, and functions that advance a simulation and read its logged samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource, VectorLogSink
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.dynamics.friction_compensation import Friction, holding_error
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ScenarioError, SimulationError
from dvrk_drake.experiments.scenario import Scenario, Target
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import Closure
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import Recording, Setpoints
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config
from dvrk_drake.systems.arm_view.overlay import ArmOverlay, add_overlay
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.gravity_pid_controller import GravityPidController, Mode
from dvrk_drake.systems.hand import Hand, HandPath


@dataclass(frozen=True, eq=False)
class Simulation:
    """Result of `simulate`.

    Attributes:
        recording: Measured t (m,) and q, qd, tau (m, n). Without `simulated_effects`, the measurements are exact,
            except for the noise of tau.
        state_true: True state (m, 2n): positions [rad, m], then velocities [rad/s, m/s].
        hand: Torque [N m], then force [N] of the hand on the arm (m, 6) at the grasped frame, expressed in the base
            frame. Zero without a hand.
        desired: Desired positions (m, n) [rad, m]. None if the mode is not "hold" during the whole simulation.
        effort_commanded: Efforts (m, n) that the controller commands [N m, N], or None.
    """

    recording: Recording
    state_true: NDArray[np.float64]
    hand: NDArray[np.float64]
    desired: NDArray[np.float64] | None
    effort_commanded: NDArray[np.float64] | None = None

    @property
    def setpoints(self) -> Setpoints:
        """Commanded positions and efforts, for `write_recording`."""
        return Setpoints(self.desired, self.effort_commanded)

    @property
    def time(self) -> NDArray[np.float64]:
        """Times (m,) of the recording's samples [s]."""
        assert self.recording.t is not None
        return self.recording.t


def simulate(
    what: Arm | Scenario,
    *,
    controller: IdentifiedModel | System | None = None,
    mode: Mode | None = None,
    release_time: float | None = None,
    effects: bool | Sequence[str] | None = None,
    duration: float | None = None,
    start: ArrayLike | None = None,
    targets: Sequence[tuple[float, ArrayLike]] | None = None,
    sample_period: float | None = None,
    seed: int | None = None,
    closure: Closure | None = None,
    meshcat: Meshcat | None = None,
    progress: Progress | None = None,
) -> Simulation:
    """Simulates a controlled arm and records it. The same arguments give bitwise identical results.

    The desired motion between two poses is a cubic in time along a straight line in joint space. Therefore it stays
    inside the limits of the arm, which are linear.

    Args:
        what: Arm that is regulated at a pose or moves to `targets`, or a scenario. With a scenario, the arguments from
            `controller` to `closure` are not allowed, because the scenario contains these settings.
        controller: Model for a `GravityPidController`, or a System with an input port `state_estimated` (2n) and an
            output port `effort` (n), e.g. a `GravityPidController`. Default: the model of the arm's SDF. `targets` have
            an effect only if the System has an input port `desired_state` (2n). A System can be used only once.
        mode: Mode of the `GravityPidController`: "hold", "gravity", "damped" or "guide". Default: "hold".
        release_time: Time at which the controller changes from mode "hold" to `mode` [s]. Default: `mode` from the
            start.
        effects: Whether to simulate the effects of a real arm (friction, cables, stops, encoders, motors), or the names
            of the effects to simulate. Default: True.
        duration: Duration of the simulation [s]. Default: 5.
        start: Start pose (n,), at rest [rad, m]. Default: zero, or the nearest pose inside the limits.
        targets: Pairs of a time [s] and the desired pose (n,) [rad, m] at this time, with zero desired velocity.
        sample_period: Sample period of the recording [s]. Default: 0.01.
        seed: Seed of the effects' noise. Default: 0.
        closure: Method that closes the loops of the linkage, "ball" or "mimic", see `add_arm`. Default: "ball".
        meshcat: Meshcat that shows the arm in real time, and the recorded animation at the end. None: no animation.
        progress: Function called with the name of the step ("simulating") and its finished share, 0..1.

    Returns:
        Measured recording, true states, forces of the hand, and desired positions.

    Raises:
        ScenarioError: An argument is invalid, e.g. a pose is outside the limits, or a setting is given together with a
            scenario.
        SimulationError: The simulation diverged.
        ArmError: An effect does not exist.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.load_arm("mtmr")
        >>> run = dvrk.simulate(arm, controller=dvrk.IdentifiedModel.from_arm(arm), effects=False, duration=0.5)
        >>> run.recording.q.shape, bool(abs(run.recording.q).max() < 1e-3)  # regulates its start pose
        ((51, 7), True)
    """
    if not isinstance(what, Arm | Scenario):
        raise ScenarioError(f'`what` is a {type(what).__name__}; allowed: an Arm, e.g. load_arm("mtml"), or a Scenario')
    if not isinstance(controller, IdentifiedModel | System | None):
        kind = type(controller).__name__
        raise ScenarioError(
            f"`controller` is a {kind}; allowed: an IdentifiedModel (attribute `model` of an identification result) or "
            "a System"
        )
    settings: dict[str, Any] = {"mode": mode, "release_time": release_time}
    given: dict[str, Any] = {"duration": duration, "sample_period": sample_period, "seed": seed, "closure": closure}
    if isinstance(what, Arm):
        scenario = scenario_of_arm(what, True if effects is None else effects, start, targets or ())
        for part, values in ((scenario, given), (scenario.controller, settings)):
            for name, value in values.items():
                if value is not None:
                    setattr(part, name, value)
        if isinstance(controller, IdentifiedModel):
            if controller.arm.name != what.name:
                raise ScenarioError(
                    f"`controller` is a model of {controller.arm.name}, but the simulated arm is {what.name}. "
                    f"Use a model of {what.name}."
                )
            scenario.model = controller
    else:
        given |= settings | {"controller": controller, "effects": effects, "start": start, "targets": targets}
        if extra := [name for name, value in given.items() if value is not None]:
            raise ScenarioError(
                f"`{extra[0]}` cannot be given with a scenario. Set it in the scenario, or give an arm."
            )
        scenario = what
    return _simulate(scenario, controller if isinstance(controller, System) else None, meshcat, progress)


def _simulate(
    scenario: Scenario, system: System | None, meshcat: Meshcat | None, progress: Progress | None
) -> Simulation:
    """Simulates a scenario. If `system` is not None, it replaces the controller of the scenario."""
    report = step_progress(progress, "simulating")
    scenario.check()
    arm = scenario.mounted_arm
    name = arm.name.lower()
    times, poses = scenario.knots()
    mode, release_time = cast(Mode, scenario.controller.mode), scenario.controller.release_time
    holds = scenario.regulated_until > 0 and (system is None or system.HasInputPort("desired_state"))
    station = ArmStation(
        arm,
        closure=cast(Closure, scenario.closure),
        plant_config=arm_plant_config(scenario.time_step),
        meshcat=meshcat,
        effects=scenario.all_effects,
        seed=scenario.seed,
    )
    controller = system or GravityPidController(
        scenario.model,
        period=scenario.time_step,
        gains=scenario.controller.gains,
        mode="hold" if release_time else mode,
    )
    trajectory = _trajectory(times, poses, scenario.duration)
    desired = TrajectorySource(trajectory, output_derivative_order=1) if holds else None
    builder = DiagramBuilder()
    settings = scenario.controller
    friction = friction_compensator(
        arm, scenario.model, settings.friction_ratio, settings.hysteresis_ratio, period=scenario.time_step
    )
    add_closed_loop(builder, station, controller, desired, friction)
    hand = _add_hand(builder, station, scenario)
    outputs = [station.GetOutputPort(f"{name}.{port}") for port in ("state_estimated", "effort_measured", "state_true")]
    outputs.append((friction or controller).GetOutputPort("effort"))
    if hand is not None:
        outputs.append(hand.GetOutputPort("spatial_force"))
    logs = [LogVectorOutput(output, builder, scenario.sample_period) for output in outputs]
    if meshcat is not None:
        desired_port = desired.get_output_port() if desired is not None else None
        add_overlay(builder, station, ArmOverlay(arm, meshcat), desired_port, phases(scenario))
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    station.SetPositions(station.GetMyMutableContextFromRoot(root), poses[0])
    if meshcat is not None:
        simulator.set_target_realtime_rate(1.0)
    t = sample_times(scenario.duration, scenario.sample_period)
    with recorded_in(meshcat):
        if release_time and isinstance(controller, GravityPidController):
            # AdvanceTo the current time would perform a step, so the release is not a sample of the second part.
            held = np.append(t[t < release_time - 1e-9], release_time)
            advance(simulator, held, lambda share: report(share * release_time / t[-1]))
            controller.SetMode(controller.GetMyMutableContextFromRoot(root), mode)
            advance(simulator, t[t > release_time + 1e-9], report)
        else:
            advance(simulator, t, report)
    estimated, tau, state_true, effort_commanded, *hand_forces = (samples(log, simulator) for log in logs)
    q, qd = np.hsplit(estimated, 2)
    noise = np.random.default_rng(scenario.seed).normal(size=tau.shape)
    tau = tau + scenario.effort_noise * arm.effort_limits * noise
    recording = Recording(q=q, qd=qd, tau=tau, t=t, source="simulation")
    hand_force = hand_forces[0] if hand_forces else np.zeros((len(t), 6))
    desired_positions = trajectory.vector_values(t).T if holds and mode == "hold" else None
    return Simulation(recording, state_true, hand_force, desired_positions, effort_commanded)


def sample_times(duration: float, period: float) -> NDArray[np.float64]:
    """Returns the sample times (m,) [s] of a `LogVectorOutput` with this period: 0, period, ..., up to `duration`."""
    # Use multiples, not sums, since accumulated rounding errors could shift a sample across a time step.
    return period * np.arange(1 + int(duration / period + 1e-9), dtype=np.float64)


def advance(
    simulator: Simulator, times: NDArray[np.float64], progress: Callable[[float], object] = lambda share: None
) -> None:
    """Advances a simulation to each of `times` (m,) [s] and calls `progress` with the finished share, 0..1.

    Raises:
        SimulationError: A solver of Drake failed, or a system met numbers that it cannot compute with.
    """
    for t in times:
        try:
            if t > 0:
                simulator.AdvanceTo(t)
            else:  # AdvanceTo(0) would perform the first step of the plant
                simulator.Initialize()
        except (RuntimeError, np.linalg.LinAlgError, FloatingPointError) as error:
            # A RuntimeError that a system in Python raised has its frames in the traceback. Drake's own has none.
            if isinstance(error, RuntimeError) and error.__traceback__ and error.__traceback__.tb_next is not None:
                raise
            at = simulator.get_context().get_time()
            raise SimulationError(f"the simulation failed at {at:.4g} s: {' '.join(str(error).split())}") from error
        progress(t / times[-1])


def samples(log: VectorLogSink, simulator: Simulator) -> NDArray[np.float64]:
    """Returns the data (m, k) of a `LogVectorOutput`, one row per sample."""
    return np.array(log.FindLog(simulator.get_context()).data().T)


@contextmanager
def recorded_in(meshcat: Meshcat | None, **options: Any) -> Iterator[None]:
    """Records an animation of the `with` block with `options` of StartRecording; does nothing if `meshcat` is None."""
    if meshcat is not None:
        meshcat.StartRecording(**options)
    yield
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()


def scenario_of_arm(
    arm: Arm, effects: bool | Sequence[str], start: ArrayLike | None, targets: Sequence[tuple[float, ArrayLike]]
) -> Scenario:
    """Converts an arm and other arguments of `simulate` to a scenario of this arm."""
    if isinstance(effects, bool):
        effects = ["all"] if effects else []
    scenario = Scenario(
        arm=arm.source,
        gravity=arm.gravity.tolist(),
        start=None if start is None else np.asarray(start, float).tolist(),
        targets=[Target(float(time), np.asarray(pose, float).tolist()) for time, pose in targets],
        simulated_effects=[effects] if isinstance(effects, str) else list(effects),
    )
    scenario.mounted_arm = arm
    return scenario


def _trajectory(times: NDArray[np.float64], poses: NDArray[np.float64], duration: float) -> PiecewisePolynomial:
    """Returns a trajectory that is at rest at pose `poses[i]` at time `times[i]`, and stays at the last pose."""
    times, poses = np.append(times, max(duration, times[-1]) + 1.0), np.vstack([poses, poses[-1:]])
    return PiecewisePolynomial.CubicHermite(times, poses.T, np.zeros_like(poses.T))


def phases(scenario: Scenario) -> Callable[[float], str]:
    """Returns a function from a time [s] to the name of the phase of a scenario, for a caption."""
    times, poses = scenario.knots()
    hand = [target.time for target in scenario.hand.path]

    def phase(time: float) -> str:
        if hand and hand[0] <= time <= hand[-1]:
            return "a hand moves the arm"
        if time >= scenario.regulated_until and scenario.controller.mode != "hold":
            return "gravity compensation"
        after = int(np.searchsorted(times, time, side="right"))
        if 0 < after < len(times) and np.any(poses[after] != poses[after - 1]):
            return "moves to the next target"
        return "regulates a pose"

    return phase


def friction_compensator(
    arm: Arm,
    model: IdentifiedModel,
    ratio: float,
    hysteresis_ratio: float = 0.0,
    *,
    friction: Friction | None = None,
    period: float = 1e-3,
) -> FrictionCompensator | None:
    """Returns a compensator for a simulated arm, or None if no friction is compensated.

    Args:
        arm: Simulated arm.
        model: Model of the controller. The gravity torque of a nominal model is assumed to have no error.
        ratio, hysteresis_ratio: Compensated shares, see `FrictionCompensator`.
        friction: Friction model. None: that of `arm`.
        period: Period of the controller [s].

    Raises:
        ControllerError: See `holding_error`.
    """
    if not (ratio or hysteresis_ratio):
        return None
    nominal = model.provenance.method == "nominal"
    return FrictionCompensator(
        friction or Friction.of_arm(arm),
        ratio=ratio,
        hysteresis_ratio=hysteresis_ratio,
        holding_error=np.zeros(arm.num_joints) if nominal else holding_error(model),
        period=period,
    )


def _add_hand(builder: DiagramBuilder, station: ArmStation, scenario: Scenario) -> Hand | None:
    path, frame, arm = scenario.hand.path, scenario.hand.frame, scenario.mounted_arm
    if not path:
        return None
    poses = np.array([target.pose for target in path])
    times = [target.time for target in path]
    trajectory = PiecewisePolynomial.CubicHermite(times, poses.T, np.zeros_like(poses.T))
    hand = builder.AddNamedSystem("hand", Hand(arm, frame, scenario.hand.grip, scenario.time_step))
    hand_path = builder.AddNamedSystem("hand_path", HandPath(arm, frame, trajectory))
    builder.Connect(hand_path.get_output_port(), hand.GetInputPort("X_BG_desired"))
    name = arm.name.lower()
    builder.Connect(station.GetOutputPort(f"{name}.state_true"), hand.GetInputPort("state_estimated"))
    builder.Connect(hand.GetOutputPort("effort_disturbance"), station.GetInputPort(f"{name}.effort_disturbance"))
    return hand
