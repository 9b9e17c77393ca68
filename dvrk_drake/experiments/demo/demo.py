"""Runs the complete workflow on a simulated arm: pose collection, identification, validation and release."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatAnimation, Rgba
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from dvrk_drake.analysis.pose_identification import StaticIdentification, identify_static
from dvrk_drake.analysis.pose_validation import StaticValidation, validate_static
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import link_inertias
from dvrk_drake.errors import ArmError
from dvrk_drake.experiments.ground_truth import APPROACH, collect_static_poses, perturbed_links, with_links
from dvrk_drake.experiments.reproduction.drift_experiment import BAND
from dvrk_drake.experiments.simulation import recorded_in, sample_times, samples
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.effects_schema import ArmEffects, DriveEffect
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.progress import Progress
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.writing import write_recording
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import page_html, start_meshcat
from dvrk_drake.systems.closed_loop import add_closed_loop
from dvrk_drake.systems.gravity_pid_controller import GravityPidController

#: Numbers of poses for identification and for validation. Settling time at a pose [s].
POSES, FRESH_POSES, SETTLE = 24, 8, 0.5
#: Maximum displacement of the ground-truth arm's centres of mass along each axis [m].
MAX_SHIFT = 0.002
#: Largest magnitude of a joint angle in the collected poses [rad]. Larger angles need more time.
MAX_ANGLE = 2.0
#: End times of the phases of the release: regulated pose, released arm, motion to the home pose [s].
HELD_UNTIL, RELEASED_UNTIL, HOME_UNTIL = 1.0, 5.0, 8.0
#: Sample period of the release [s]. The animation shows every third sample.
SAMPLE_PERIOD, SAMPLES_PER_FRAME = 0.01, 3
#: Name and colour of the ghost arm in the animation.
GHOST = "nominal"
#: Captions of the animation: the phases with their start times [s], and the meaning of the colours.
PHASES = (
    (0.0, "held: the controller regulates the pose"),
    (HELD_UNTIL, "released: gravity compensation only"),
    (RELEASED_UNTIL, "driven home: the controller regulates a motion"),
)
COLOURS = {"#a0a4a8": "controlled with the identified model", "#2caa67": "controlled with the model of the SDF"}
#: Colour of the ghost: that of the model of the SDF in the plots.
GHOST_COLOUR = Rgba(0.17, 0.67, 0.4, 0.5)


@dataclass(frozen=True)
class DemoPlan:
    """Ground truth and poses of the demo for one type of arm.

    The links of the ground-truth arm are heavier than those of the SDF, as in a real arm with cables and covers.
    Only the counterweights are not heavier. Therefore the arm falls if its controller uses the model of the SDF.

    Attributes:
        effects: Effects of the ground-truth arm that are neither in the nominal model nor in the arm file.
        release: Pose (n,) of the release [rad, m].
        home: Desired pose (n,) at the end of the simulation [rad, m].
        mass_ratios: Smallest and largest ratio of the mass of a link to its mass in the SDF.
        counterweights: Links with the inertia in the SDF.
        omitted: Names of effects of the arm file that the ground-truth arm does not have.
    """

    effects: tuple[DriveEffect, ...]
    release: tuple[float, ...]
    home: tuple[float, ...]
    mass_ratios: tuple[float, float]
    counterweights: tuple[str, ...]
    omitted: tuple[str, ...] = ()


MTM_PLAN = DemoPlan(
    effects=(
        DriveEffect("joint.wrist_platform", "offset", 0.0, 0.02),
        DriveEffect("joint.wrist_platform", "cable sine", 1.0, 0.05),
        DriveEffect("joint.wrist_pitch", "cable sine", 1.0, 0.01),
    ),
    release=(0.2, 0.4, -0.25, 0.6, 0.9, 0.3, 0.5),
    home=(0.0,) * 7,
    mass_ratios=(1.1, 1.3),
    counterweights=("crank_link",),
    # The spring balances a heavier wrist than that of the SDF, see `perturbed_ground_truth`.
    omitted=("springs",),
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
        release=(0.6, 0.3, 0.1, 0.6, 0.5, -0.3, 0.5),
        home=(0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0),
        mass_ratios=(1.3, 1.5),
        counterweights=("counterweight_link",),
    ),
}


@dataclass(frozen=True)
class DemoResult:
    """Results of one run of the demo for n joints.

    Attributes:
        arm: Arm of the demo.
        identification: Identification from the collected poses.
        fresh: Errors of the identified model at fresh poses, which are not used for identification.
        fresh_nominal: Errors of the nominal model (SDF) at the fresh poses.
        time: Times (m,) while the arm is released, from the release on [s].
        identified: Positions (m, n) of the released arm with the identified model [rad, m].
        nominal: Positions (m, n) of the released arm with the nominal model [rad, m].
        descent: Descent of the centre of mass of the released arm with the nominal model [m].
    """

    arm: Arm
    identification: StaticIdentification
    fresh: StaticValidation
    fresh_nominal: StaticValidation
    time: NDArray[np.float64]
    identified: NDArray[np.float64]
    nominal: NDArray[np.float64]
    descent: float

    @property
    def drifts(self) -> dict[str, NDArray[np.float64]]:
        """Largest distance (n,) of each joint from its release position [rad, m] by model: "identified", "nominal"."""
        released = {"identified": self.identified, "nominal": self.nominal}
        return {model: np.abs(q - q[0]).max(axis=0) for model, q in released.items()}

    @property
    def limits(self) -> NDArray[np.float64]:
        """Largest drift (n,) of a joint that counts as held [rad, m]."""
        return self.arm.per_joint(*BAND)

    def holds(self, model: str) -> bool:
        """Tells whether all joints of the released arm stay within `limits` with a model of `drifts`."""
        return bool(np.all(self.drifts[model] <= self.limits))

    @property
    def nominal_outcome(self) -> str:
        """Verb for the released arm with the nominal model: "stays", "falls" or "moves away"."""
        if self.holds("nominal"):
            return "stays"
        return "falls" if self.descent > 0 else "moves away"


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
    heavier = perturbed_links(arm, generator, shift=MAX_SHIFT, mass_ratios=plan.mass_ratios)
    links = [
        nominal_link if nominal_link.link in plan.counterweights else link
        for link, nominal_link in zip(heavier, link_inertias(arm), strict=True)
    ]
    ground_truth_arm = with_links(arm, links, true_sdf, "a simulated arm with random, heavier links")
    effects = _effects(arm, plan)

    def station(meshcat: Meshcat | None = None) -> ArmStation:
        return ArmStation(arm, plant_arm=ground_truth_arm, meshcat=meshcat, closure="ball", effects=effects, seed=seed)

    def collect(count: int, step: str) -> Recording:
        poses = arm.sample_poses(count, generator, margin=0.1)
        poses = np.where(arm.prismatic, poses, np.clip(poses, -MAX_ANGLE, MAX_ANGLE))
        return collect_static_poses(
            station(),
            nominal,
            poses,
            approach=arm.per_joint(*APPROACH),
            settle=SETTLE,
            progress=lambda share: progress(step, share),
        )

    poses = collect(POSES, "collecting poses")
    write_recording(poses, output / "poses.csv", arm)
    identification = identify_static(poses, arm, progress=lambda share: progress("identifying", share))
    model = identification.model
    model.provenance.recording = "poses.csv"
    model.save(output / "model.yaml")
    fresh_poses = collect(FRESH_POSES, "collecting fresh poses")
    write_recording(fresh_poses, output / "fresh_poses.csv", arm)

    def part(start: float, end: float) -> Callable[[float], object]:
        return lambda share: progress("simulating the release", start + (end - start) * share)

    t, with_nominal = _release(station(), nominal, plan, RELEASED_UNTIL, part(0.0, 0.3))
    meshcat = start_meshcat(arm)
    released = _animated_release(station(meshcat), model, plan, meshcat, with_nominal, part(0.3, 1.0))
    with atomic_write(output / "arm.html") as stream:
        title = f"{arm.name} (simulated) - dvrk-drake demo"
        stream.write(page_html(meshcat, title, phases=PHASES, colors=COLOURS))
    window = slice(_index(HELD_UNTIL), _index(RELEASED_UNTIL) + 1)
    return DemoResult(
        arm=arm,
        identification=identification,
        fresh=validate_static(model, fresh_poses),
        fresh_nominal=validate_static(nominal, fresh_poses),
        time=t[window] - HELD_UNTIL,
        identified=released[window],
        nominal=with_nominal[window],
        descent=_height(ground_truth_arm, with_nominal[window.start]) - _height(ground_truth_arm, with_nominal[-1]),
    )


def _height(arm: Arm, q: NDArray[np.float64]) -> float:
    """Returns the height of the centre of mass of an arm at the pose q (n,) [m]."""
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, q)
    return float(plant.CalcCenterOfMassPositionInWorld(context)[2])


def _effects(arm: Arm, plan: DemoPlan) -> ArmEffects:
    effects = arm.effects
    for name in plan.omitted:
        effects = effects.without(name)
    return dataclasses.replace(effects, cables=[*effects.cables, *plan.effects])


def _index(time: float) -> int:
    """Returns the index of the sample at `time` [s]."""
    return round(time / SAMPLE_PERIOD)


def _release(
    station: ArmStation,
    model: IdentifiedModel,
    plan: DemoPlan,
    duration: float,
    progress: Callable[[float], object],
    draw: Callable[[int, NDArray[np.float64]], object] = lambda index, q: None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulates regulation, release with gravity compensation, and motion home; returns t (m,) and q (m, n).

    At the start, the arm is at rest, and the presliding springs of its friction carry no force. `draw` is called with
    the index and the pose of each sample.
    """
    arm = station.arm
    knots = np.array([plan.release, plan.release, plan.home, plan.home]).T
    times = [0.0, RELEASED_UNTIL, 0.75 * HOME_UNTIL + 0.25 * RELEASED_UNTIL, HOME_UNTIL]
    desired = TrajectorySource(
        PiecewisePolynomial.CubicHermite(times, knots, np.zeros_like(knots)), output_derivative_order=1
    )
    controller = GravityPidController(model)
    builder = DiagramBuilder()
    add_closed_loop(builder, station, controller, desired)
    log = LogVectorOutput(station.GetOutputPort(f"{arm.name.lower()}.state_true"), builder, SAMPLE_PERIOD)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    station_context = station.GetMyMutableContextFromRoot(context)
    station.SetPositions(station_context, plan.release)
    settings = controller.GetMyMutableContextFromRoot(context)
    t = sample_times(duration, SAMPLE_PERIOD)
    for i, time in enumerate(t):
        if i == 0:
            simulator.Initialize()  # AdvanceTo(0) would perform the first step of the plant
        else:
            simulator.AdvanceTo(time)
        draw(i, station.GetPositions(station_context))
        progress(time / t[-1])
        if i == _index(HELD_UNTIL):
            controller.SetMode(settings, "gravity")
        elif i == _index(RELEASED_UNTIL):
            controller.SetMode(settings, "hold")
    q = samples(log, simulator)[:, : arm.num_joints]
    simulator.get_system().ForcedPublish(context)  # the recording of the links ends at the last sample
    return t, q


def _animated_release(
    station: ArmStation,
    model: IdentifiedModel,
    plan: DemoPlan,
    meshcat: Meshcat,
    ghost: NDArray[np.float64],
    progress: Callable[[float], object],
) -> NDArray[np.float64]:
    """Simulates the release and records an endless animation; returns q (m, n).

    While the arm is released, the animation shows the poses `ghost` (k, n) of another simulation as a ghost arm.
    """
    overlay = ArmOverlay(station.arm, meshcat)
    overlay.add_ghost(GHOST, GHOST_COLOUR)

    def draw(i: int, q: NDArray[np.float64]) -> None:
        if i % SAMPLES_PER_FRAME and i != _index(HOME_UNTIL):
            return
        time = i * SAMPLE_PERIOD
        ghosts = {GHOST: ghost[i]} if _index(HELD_UNTIL) <= i < len(ghost) else None
        overlay.draw(q, ghosts=ghosts, time=time)

    with recorded_in(meshcat):
        _, q = _release(station, model, plan, HOME_UNTIL, progress, draw)
        overlay.end_recording(HOME_UNTIL)
        animation = meshcat.get_mutable_recording()
        animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
        animation.set_repetitions(10_000)
    return q
