"""The whole way on a simulated arm: collect, identify, validate, release, hold; everything written to one folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from dvrk_drake.analysis.static.static_identification import StaticIdentification, identify_static
from dvrk_drake.analysis.static.validation import StaticValidation, validate_static
from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError
from dvrk_drake.experiments.demo.true_arm import TrueArm, make_true_arm
from dvrk_drake.experiments.static_pose_collection import collect_static_poses
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.loop_closure import Closure
from dvrk_drake.recordings.recording import Recording, write_recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.arm_view import start_meshcat
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

POSES, FRESH_POSES = 40, 15
#: Effort noise of one sample, as a share of the effort limit.
EFFORT_NOISE = 0.01
#: Release: pose held, then let go, then driven home; phases end at these times [s].
HELD_UNTIL, RELEASED_UNTIL, HOME_UNTIL = 0.5, 4.5, 7.5
STEP_DURATION = 4.0
#: What a reader of the drift must know.
NO_DRY_FRICTION = (
    "Dry friction is not simulated here: every error of the model moves the released arm. On a real arm dry friction "
    "resists this drift."
)


@dataclass(frozen=True)
class DemoPlan:
    """What the demo does with one kind of arm; poses in rad and m.

    Attributes:
        effects, coefficients: what its true arm has beside the model [N m].
        release: where it is held, then let go.
        step: where the step to `home` starts.
        home: where both end.
        step_title: of the step's plot.
        closure: how the loops of the true arm's linkage are held, see `add_arm`.
    """

    effects: tuple[ActuatorEffect, ...]
    coefficients: tuple[float, ...]
    release: tuple[float, ...]
    step: tuple[float, ...]
    home: tuple[float, ...]
    step_title: str
    closure: Closure = "mimic"


MTM_PLAN = DemoPlan(
    effects=(
        ActuatorEffect("joint.wrist_platform", "offset"),
        ActuatorEffect("joint.wrist_platform", "cable sine", 1.0),
        ActuatorEffect("joint.wrist_pitch", "cable sine", 1.0),
    ),
    coefficients=(0.02, 0.05, -0.03),
    release=(0.2, 0.4, -0.25, 0.6, 0.9, 0.3, 0.5),
    # The paper's Fig. 7: J5, J3 and J2 off home; q2 + q3 is beyond a real linkage's stop.
    step=(0.0, -0.22, -0.79, 0.0, 3.13, 0.0, 0.0),
    home=(0.0,) * 7,
    step_title="Step of the paper's Fig. 7 to zero, gravity + PID",
)
PLANS = {
    "mtml": MTM_PLAN,
    "mtmr": MTM_PLAN,
    "psm": DemoPlan(
        effects=(
            ActuatorEffect("joint.yaw", "offset"),
            ActuatorEffect("joint.roll", "cable sine", 1.0),
            ActuatorEffect("joint.wrist_pitch", "offset"),
        ),
        coefficients=(0.05, 0.03, 0.01),
        release=(0.4, 0.3, 0.15, 0.6, 0.5, -0.3, 0.5),
        step=(0.5, -0.4, 0.2, -0.8, 0.6, 0.4, 0.8),
        home=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0),
        step_title="Step of all joints, gravity + PID",
        closure="ball",
    ),
}


@dataclass(frozen=True)
class DemoResult:
    """Models, errors and motions of one run; m, k samples of n joints.

    Attributes:
        arm: which arm.
        identification: of the collected poses.
        fresh: errors of the identified model at the fresh poses.
        fresh_paper: errors of the paper's least squares at the same poses.
        release_time: (m,) [s].
        released: (m, n) positions of the release with the identified model [rad, m].
        released_as_drawn: (m, n) the same with the model that the SDF states.
        drift: (n,) largest distance from the pose of the release, by model.
        step_time: (k,) [s].
        step: (k, n) positions of the step home [rad, m].
        step_error: (n,) distance from home at the end [rad, m].
    """

    arm: Arm
    identification: StaticIdentification
    fresh: StaticValidation
    fresh_paper: StaticValidation
    release_time: NDArray[np.float64]
    released: NDArray[np.float64]
    released_as_drawn: NDArray[np.float64]
    drift: dict[str, NDArray[np.float64]]
    step_time: NDArray[np.float64]
    step: NDArray[np.float64]
    step_error: NDArray[np.float64]


def run_demo(
    output: Path,
    arm_name: str = "mtml",
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> DemoResult:
    """Runs it and writes `output`, an existing folder.

    Args:
        output: for model.yaml, poses.csv, fresh_poses.csv and arm.html, a Meshcat recording; `plot_demo` adds plots.
        arm_name: which arm.
        seed: of the true arm, the poses and the noise.
        progress: called with what is being done and the finished share of it, 0..1.

    Raises:
        ArmError: an arm that the demo has no plan for.
    """
    generator = np.random.default_rng(seed)
    if arm_name not in PLANS:
        raise ArmError(f'the demo has no plan for "{arm_name}"; it has for {", ".join(PLANS)}')
    arm, plan = load_arm(arm_name), PLANS[arm_name]
    nominal = IdentifiedModel.from_arm(arm)
    true_arm = make_true_arm(arm, generator, plan.effects, plan.coefficients, plan.closure)

    def collect(count: int, what: str) -> Recording:
        poses = arm.sample_poses(count, generator, margin=0.1)
        # A person turns platform and handle (or roll) by a hand's reach, not by turns.
        poses[:, [3, 6]] = np.clip(poses[:, [3, 6]], -1.5, 1.5)
        return collect_static_poses(
            true_arm.station(),
            nominal,
            poses,
            effort_noise=EFFORT_NOISE,
            generator=generator,
            prepare=true_arm.prepare,
            progress=lambda share: progress(what, share),
        )

    poses = collect(POSES, "collecting poses")
    write_recording(poses, output / "poses.csv")
    identification = identify_static(poses, arm, progress=lambda share: progress("identifying", share))
    model = identification.model
    model.provenance.recording = "poses.csv"
    model.save(output / "model.yaml")
    fresh_poses = collect(FRESH_POSES, "collecting fresh poses")
    write_recording(fresh_poses, output / "fresh_poses.csv")
    fresh = validate_static(model, fresh_poses)
    paper_model = identify_static(poses, arm, "paper").model
    fresh_paper = validate_static(paper_model, fresh_poses)

    meshcat = start_meshcat(true_arm.arm)
    t, released = _release(true_arm, model, plan, meshcat, lambda share: progress("releasing and holding", share / 3))
    with atomic_write(output / "arm.html") as stream:
        stream.write(meshcat.StaticHtml())
    _, with_nominal = _release(
        true_arm, nominal, plan, None, lambda share: progress("releasing and holding", (1 + share) / 3)
    )
    t_step, step = _step(true_arm, model, plan, lambda share: progress("releasing and holding", (2 + share) / 3))

    window = (t >= HELD_UNTIL) & (t <= RELEASED_UNTIL)
    drift = {
        label: np.abs(q[window] - q[window][0]).max(axis=0)
        for label, q in (("identified", released), ("as drawn", with_nominal))
    }
    return DemoResult(
        arm,
        identification,
        fresh,
        fresh_paper,
        t,
        released,
        with_nominal,
        drift,
        t_step,
        step,
        np.abs(step[-1] - plan.home),
    )


def _closed_loop(
    true_arm: TrueArm, model: IdentifiedModel, q_start: Sequence[float], meshcat: Meshcat | None
) -> tuple[Simulator, ArmStation, GravityPidController, ConstantVectorSource]:
    station, controller = true_arm.station(meshcat), GravityPidController(model)
    desired = ConstantVectorSource(_at_rest(q_start))
    builder = DiagramBuilder()
    add_closed_loop(builder, station, controller, desired)
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    true_arm.prepare(station, context)
    station.SetPositions(context, q_start)
    return simulator, station, controller, desired


def _at_rest(q: Sequence[float]) -> NDArray[np.float64]:
    return np.concatenate([q, np.zeros(len(q))])


def _release(
    true_arm: TrueArm,
    model: IdentifiedModel,
    plan: DemoPlan,
    meshcat: Meshcat | None,
    progress: Callable[[float], None],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Holds a pose, releases the arm under gravity compensation, drives it home; t (m,) and q (m, n)."""
    simulator, station, controller, desired = _closed_loop(true_arm, model, plan.release, meshcat)
    root = simulator.get_mutable_context()
    settings = controller.GetMyMutableContextFromRoot(root)
    home = _at_rest(plan.home)

    def at(t: float) -> None:
        if abs(t - HELD_UNTIL) < 1e-9:
            controller.SetMode(settings, "gravity")
        if abs(t - RELEASED_UNTIL) < 1e-9:
            desired.get_mutable_source_value(desired.GetMyMutableContextFromRoot(root)).SetFromVector(home)
            controller.SetMode(settings, "hold")

    if meshcat is not None:
        meshcat.StartRecording()
    t, q = _sample(simulator, station, HOME_UNTIL, at, progress)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
    return t, q


def _step(
    true_arm: TrueArm, model: IdentifiedModel, plan: DemoPlan, progress: Callable[[float], None]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From the plan's step to its home under gravity + PID."""
    simulator, station, _, desired = _closed_loop(true_arm, model, plan.step, None)
    home = _at_rest(plan.home)
    root = simulator.get_mutable_context()
    desired.get_mutable_source_value(desired.GetMyMutableContextFromRoot(root)).SetFromVector(home)
    return _sample(simulator, station, STEP_DURATION, lambda t: None, progress)


def _sample(
    simulator: Simulator,
    station: ArmStation,
    duration: float,
    at: Callable[[float], None],
    progress: Callable[[float], None],
    period: float = 0.01,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulates and samples the pose every `period`; `at(t)` is called before the arm moves on from t."""
    context = station.GetMyContextFromRoot(simulator.get_context())
    times = np.arange(round(duration / period) + 1, dtype=np.float64) * period
    q = []
    for t in times:
        simulator.AdvanceTo(t)
        q.append(station.GetPositions(context))
        at(t)
        progress(t / duration)
    return times, np.array(q)
