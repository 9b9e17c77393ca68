"""Runs the complete workflow on a simulated arm: pose collection, identification, validation, release and step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, VectorLogSink

from dvrk_drake.analysis.static.static_identification import StaticIdentification, identify_static
from dvrk_drake.analysis.static.validation import StaticValidation, validate_static
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import ArmError
from dvrk_drake.experiments.ground_truth import collect_static_poses, damped_station, perturbed_links, with_links
from dvrk_drake.experiments.simulation import advance, recorded_in, sample_times, samples
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, DriveEffect
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.loop_closure import Closure
from dvrk_drake.progress import Progress
from dvrk_drake.recordings.recording import Recording, write_recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.arm_view.page import start_meshcat
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: Numbers of poses for identification and for validation.
POSES, FRESH_POSES = 40, 15
#: Standard deviation of the noise of one effort sample, as a share of the effort limit.
EFFORT_NOISE = 0.01
#: Maximum displacement of the ground-truth arm's centres of mass along each axis [m].
MAX_SHIFT = 0.002
#: End times of the segments of the release: regulated pose, released arm, motion to the home pose [s].
HELD_UNTIL, RELEASED_UNTIL, HOME_UNTIL = 0.5, 4.5, 7.5
#: Duration of the step response [s].
STEP_DURATION = 4.0
#: Sample period of the motions [s].
SAMPLE_PERIOD = 0.01
#: Note on the interpretation of the drift.
NO_DRY_FRICTION = (
    "The simulation has no dry friction, so every model error moves the released arm. On a real arm, dry friction "
    "reduces this drift."
)


@dataclass(frozen=True)
class DemoPlan:
    """Effects, poses and settings of the demo for one type of arm.

    Attributes:
        effects: Effects of the ground-truth arm that are not in the nominal model.
        release: Pose (n,) of the release [rad, m].
        step: Start pose (n,) of the step to `home` [rad, m].
        home: Desired pose (n,) at the end of both simulations, release and step [rad, m].
        step_title: Title of the plot of the step.
        closure: Method for closing the loops of the ground-truth arm's linkage, see `add_arm`.
    """

    effects: tuple[DriveEffect, ...]
    release: tuple[float, ...]
    step: tuple[float, ...]
    home: tuple[float, ...]
    step_title: str
    closure: Closure = "mimic"


MTM_PLAN = DemoPlan(
    effects=(
        DriveEffect("joint.wrist_platform", "offset", 0.0, 0.02),
        DriveEffect("joint.wrist_platform", "cable sine", 1.0, 0.05),
        DriveEffect("joint.wrist_pitch", "cable sine", 1.0, -0.03),
    ),
    release=(0.2, 0.4, -0.25, 0.6, 0.9, 0.3, 0.5),
    # Start pose of the paper's Fig. 7. The sum q2 + q3 exceeds the limit of the real linkage.
    step=(0.0, -0.22, -0.79, 0.0, 3.13, 0.0, 0.0),
    home=(0.0,) * 7,
    step_title="Step of the paper's Fig. 7 to zero, gravity + PID",
)
PLANS = {
    "mtml": MTM_PLAN,
    "mtmr": MTM_PLAN,
    "psm": DemoPlan(
        effects=(
            DriveEffect("joint.yaw", "offset", 0.0, 0.05),
            DriveEffect("joint.roll", "cable sine", 1.0, 0.03),
            DriveEffect("joint.wrist_pitch", "offset", 0.0, 0.01),
        ),
        release=(0.4, 0.3, 0.15, 0.6, 0.5, -0.3, 0.5),
        step=(0.5, -0.4, 0.2, -0.8, 0.6, 0.4, 0.8),
        home=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0),
        step_title="Step of all joints, gravity + PID",
        closure="ball",
    ),
}


@dataclass(frozen=True)
class DemoResult:
    """Results of one run of the demo for n joints. The release has m samples, and the step has k samples.

    Attributes:
        arm: Arm of the demo.
        identification: Identification from the collected poses.
        fresh: Errors of the identified model at fresh poses, which are not used for identification.
        fresh_paper: Errors at the fresh poses for the model identified by the paper's least-squares method.
        release_time: Times (m,) of the release [s].
        released: Positions (m, n) during the release with the identified model [rad, m].
        released_nominal: Positions (m, n) during the release with the nominal model [rad, m].
        drift: Largest distance (n,) of each joint from its release position [rad, m], by name of the model:
            "identified" or "nominal".
        step_time: Times (k,) of the step [s].
        step: Positions (k, n) during the step to the home pose [rad, m].
        step_error: Distance (n,) of each joint from its home position at the end of the step [rad, m].
    """

    arm: Arm
    identification: StaticIdentification
    fresh: StaticValidation
    fresh_paper: StaticValidation
    release_time: NDArray[np.float64]
    released: NDArray[np.float64]
    released_nominal: NDArray[np.float64]
    drift: dict[str, NDArray[np.float64]]
    step_time: NDArray[np.float64]
    step: NDArray[np.float64]
    step_error: NDArray[np.float64]


def run_demo(
    output: Path,
    arm_name: str = "mtml",
    seed: int = 0,
    progress: Progress = lambda step, share: None,
) -> DemoResult:
    """Runs the demo and writes its results to an existing folder.

    Args:
        output: Folder for model.yaml, poses.csv, fresh_poses.csv and arm.html (Meshcat animation). `plot_demo` adds the
            plots.
        arm_name: Name of the arm.
        seed: Seed of the ground-truth arm, the poses and the noise.
        progress: Function called with the current step and its finished share, 0..1.

    Raises:
        ArmError: The demo does not support this arm.
    """
    if arm_name not in PLANS:
        raise ArmError(f'the demo does not support the arm "{arm_name}"; allowed: {", ".join(PLANS)}')
    with TemporaryDirectory() as folder:
        return _run_demo(output, Path(folder) / "ground_truth_arm.sdf", arm_name, seed, progress)


def _run_demo(output: Path, true_sdf: Path, arm_name: str, seed: int, progress: Progress) -> DemoResult:
    generator = np.random.default_rng(seed)
    arm, plan = load_arm(arm_name), PLANS[arm_name]
    nominal = IdentifiedModel.from_arm(arm)
    links = perturbed_links(arm, generator, shift=MAX_SHIFT)
    ground_truth_arm = with_links(arm, links, true_sdf, "a simulated arm with random link inertias")

    def station(meshcat: Meshcat | None = None) -> ArmStation:
        return damped_station(arm, ground_truth_arm, ArmEffects(cables=list(plan.effects)), plan.closure, meshcat)

    def collect(count: int, step: str) -> Recording:
        poses = arm.sample_poses(count, generator, margin=0.1)
        # An operator rotates the platform and the handle (PSM: the roll joint) only within the range of a human wrist.
        poses[:, [3, 6]] = np.clip(poses[:, [3, 6]], -1.5, 1.5)
        return collect_static_poses(
            station(),
            nominal,
            poses,
            effort_noise=EFFORT_NOISE,
            generator=generator,
            progress=lambda share: progress(step, share),
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

    def third(index: int) -> Callable[[float], object]:
        return lambda share: progress("simulating release and step", (index + share) / 3)

    meshcat = start_meshcat(arm)
    t, released = _release(station(meshcat), model, plan, meshcat, third(0))
    with atomic_write(output / "arm.html") as stream:
        stream.write(meshcat.StaticHtml())
    _, with_nominal = _release(station(), nominal, plan, None, third(1))
    t_step, step = _step(station(), model, plan, third(2))

    window = (t >= HELD_UNTIL) & (t <= RELEASED_UNTIL)
    drift = {
        label: np.abs(q[window] - q[window][0]).max(axis=0)
        for label, q in (("identified", released), ("nominal", with_nominal))
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
    station: ArmStation, model: IdentifiedModel, q_start: Sequence[float]
) -> tuple[Simulator, VectorLogSink, GravityPidController, ConstantVectorSource]:
    """Returns a simulator of the arm at q_start, the log of the arm's state, the controller, and the desired state."""
    controller = GravityPidController(model)
    desired = ConstantVectorSource(_at_rest(q_start))
    builder = DiagramBuilder()
    add_closed_loop(builder, station, controller, desired)
    log = LogVectorOutput(station.GetOutputPort(f"{station.arm.name.lower()}.state_true"), builder, SAMPLE_PERIOD)
    simulator = Simulator(builder.Build())
    context = station.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    station.SetPositions(context, q_start)
    return simulator, log, controller, desired


def _at_rest(q: Sequence[float]) -> NDArray[np.float64]:
    return np.concatenate([q, np.zeros(len(q))])


def _release(
    station: ArmStation,
    model: IdentifiedModel,
    plan: DemoPlan,
    meshcat: Meshcat | None,
    progress: Callable[[float], object],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulates regulation, release with gravity compensation, and motion home; returns t (m,) and q (m, n)."""
    simulator, log, controller, desired = _closed_loop(station, model, plan.release)
    root = simulator.get_mutable_context()
    settings = controller.GetMyMutableContextFromRoot(root)
    t = sample_times(HOME_UNTIL, SAMPLE_PERIOD)
    held, released = (int(np.searchsorted(t, end - 1e-9)) + 1 for end in (HELD_UNTIL, RELEASED_UNTIL))
    with recorded_in(meshcat):
        advance(simulator, t[:held])
        controller.SetMode(settings, "gravity")
        advance(simulator, t[held:released], lambda share: progress(share * RELEASED_UNTIL / HOME_UNTIL))
        desired.get_mutable_source_value(desired.GetMyMutableContextFromRoot(root)).SetFromVector(_at_rest(plan.home))
        controller.SetMode(settings, "hold")
        advance(simulator, t[released:], progress)
    return t, samples(log, simulator)[:, : station.arm.num_joints]


def _step(
    station: ArmStation, model: IdentifiedModel, plan: DemoPlan, progress: Callable[[float], object]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulates the step to the home pose with gravity compensation and PID; returns t (m,) [s] and q (m, n)."""
    simulator, log, _, desired = _closed_loop(station, model, plan.step)
    root = simulator.get_mutable_context()
    desired.get_mutable_source_value(desired.GetMyMutableContextFromRoot(root)).SetFromVector(_at_rest(plan.home))
    t = sample_times(STEP_DURATION, SAMPLE_PERIOD)
    advance(simulator, t, progress)
    return t, samples(log, simulator)[:, : station.arm.num_joints]
