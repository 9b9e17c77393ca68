"""Runs the complete workflow on a simulated arm: pose collection, identification, validation and release.

Each step is a call of the public API, so a script can do the same with another arm.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
from numpy.typing import NDArray

import dvrk_drake as dvrk
from dvrk_drake.analysis.pose_identification import StaticIdentification
from dvrk_drake.analysis.validation import StaticValidation
from dvrk_drake.errors import ArmError
from dvrk_drake.experiments.ground_truth import APPROACH
from dvrk_drake.experiments.releases import BAND
from dvrk_drake.experiments.simulation import Simulation
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, DriveEffect
from dvrk_drake.models.typed_yaml import load_yaml, typed_content
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.systems.gravity_pid_controller import Mode

#: Numbers of poses for identification and for validation. Settling time at a pose [s].
POSES, FRESH_POSES, SETTLE = 24, 8, 0.5
#: Maximum displacement of the simulated arm's centres of mass along each axis [m].
MAX_SHIFT = 0.002
#: Largest magnitude of a joint angle in the collected poses [rad]. Larger angles need more time.
MAX_ANGLE = 2.0
#: Time of the release, and duration of the motion after it [s].
RELEASE_TIME, DURATION = 1.0, 4.0
_PLANS = Path(__file__).with_name("demo_plans.yaml")


@dataclass
class DemoPlan:
    """Simulated arm of the demo for one type of arm.

    Attributes:
        effects: Effects of the simulated arm that are neither in the nominal model nor in the arm file.
        release: Pose (n,) of the release [rad, m].
        mass_ratios: Smallest and largest ratio of the mass of a link to its mass in the SDF.
        counterweights: Links with the inertia in the SDF.
        omitted: Names of effects of the arm file that the simulated arm does not have.
    """

    effects: list[DriveEffect]
    release: list[float]
    mass_ratios: list[float]
    counterweights: list[str]
    omitted: list[str] = field(default_factory=list)


def load_plan(arm_name: str) -> DemoPlan:
    """Returns the plan for an arm.

    Raises:
        ArmError: The demo does not support this arm.
    """
    plans = load_yaml(_PLANS, ArmError)
    if arm_name not in plans:
        raise ArmError(f'the demo does not support the arm "{arm_name}"; allowed: {", ".join(plans)}')
    return typed_content(DemoPlan, plans[arm_name], str(_PLANS), ArmError, "a plan of the demo")


@dataclass(frozen=True)
class DemoResult:
    """Results of one run of the demo for n joints.

    Attributes:
        arm: Arm of the demo.
        identification: Identification from the collected poses.
        fresh: Errors of the identified model at fresh poses, which are not used for identification.
        fresh_nominal: Errors of the nominal model (SDF) at the fresh poses.
        time: Times (m,), relative to the release [s]. Before it, the controller regulates the pose.
        identified: Positions (m, n) of the arm with the identified model [rad, m].
        nominal: Positions (m, n) of the arm with the nominal model [rad, m].
    """

    arm: Arm
    identification: StaticIdentification
    fresh: StaticValidation
    fresh_nominal: StaticValidation
    time: NDArray[np.float64]
    identified: NDArray[np.float64]
    nominal: NDArray[np.float64]

    def drift(self, model: str) -> NDArray[np.float64]:
        """Returns the displacements (m, n) from the release pose [rad, m], with the model "identified" or "nominal"."""
        q: NDArray[np.float64] = getattr(self, model)
        return q - q[np.argmin(np.abs(self.time))]

    @property
    def drifts(self) -> dict[str, NDArray[np.float64]]:
        """Largest distance (n,) of each joint from its release position [rad, m] by model: "identified", "nominal"."""
        return {model: np.abs(self.drift(model)[self.time >= 0]).max(axis=0) for model in ("identified", "nominal")}

    @property
    def limits(self) -> NDArray[np.float64]:
        """Largest drift (n,) of a joint that counts as held [rad, m]."""
        return self.arm.per_joint(*BAND)

    def holds(self, model: str) -> bool:
        """Returns whether all joints of the released arm stay within `limits` with a model of `drifts`."""
        return bool(np.all(self.drifts[model] <= self.limits))


def run_demo(
    output: Path,
    arm_name: str = "mtml",
    seed: int = 0,
    progress: Progress = lambda step, share: None,
) -> DemoResult:
    """Runs the demo and writes its results to an existing folder.

    Args:
        output: Folder for model.yaml, poses.csv and fresh_poses.csv. `reports.demo.write_demo` adds the pages.
        arm_name: Name of the arm.
        seed: Seed of the simulated arm, the poses and the noise.
        progress: Function called with the current step and its finished share, 0..1.

    Raises:
        ArmError: The demo does not support this arm.
    """
    plan, arm, generator = load_plan(arm_name), dvrk.load_arm(arm_name), np.random.default_rng(seed)
    nominal = dvrk.IdentifiedModel.from_arm(arm)
    with TemporaryDirectory() as folder:
        simulated = dvrk.perturbed_arm(
            arm,
            Path(folder) / "simulated_arm.sdf",
            generator,
            mass_ratios=(plan.mass_ratios[0], plan.mass_ratios[1]),
            max_shift=MAX_SHIFT,
            unchanged_links=plan.counterweights,
            without=plan.omitted,
        )
        simulated = dataclasses.replace(simulated, effects=simulated.effects.joined(ArmEffects(cables=plan.effects)))

        def collect(count: int, step: str) -> Recording:
            poses = arm.sample_poses(count, generator, margin=0.1)
            poses = np.where(arm.prismatic, poses, np.clip(poses, -MAX_ANGLE, MAX_ANGLE))
            station = dvrk.ArmStation(simulated, closure="ball", effects=simulated.effects, seed=seed)
            approach, report = arm.per_joint(*APPROACH), step_progress(progress, step)
            return dvrk.simulate_poses(station, nominal, poses, approach=approach, settle=SETTLE, progress=report)

        poses = collect(POSES, "collecting poses")
        dvrk.write_recording(poses, output / "poses.csv", arm)
        identification = dvrk.identify(poses, arm, progress=lambda _, share: progress("identifying", share))
        model = identification.model
        model.provenance.recording = "poses.csv"
        model.save(output / "model.yaml")
        fresh_poses = collect(FRESH_POSES, "collecting fresh poses")
        dvrk.write_recording(fresh_poses, output / "fresh_poses.csv", arm)

        def release(model: dvrk.IdentifiedModel, mode: Mode, start: float) -> Simulation:
            return dvrk.simulate(
                simulated,
                controller=model,
                mode=mode,
                release_time=RELEASE_TIME,
                start=plan.release,
                duration=RELEASE_TIME + DURATION,
                seed=seed,
                progress=lambda _, share: progress("simulating the release", start + share / 2),
            )

        with_nominal, with_identified = release(nominal, "gravity", 0.0), release(model, "guide", 0.5)
    n = arm.num_joints
    fresh, fresh_nominal = (dvrk.validate(used, fresh_poses) for used in (model, nominal))
    return DemoResult(
        arm,
        cast(StaticIdentification, identification),
        cast(StaticValidation, fresh),
        cast(StaticValidation, fresh_nominal),
        with_identified.time - RELEASE_TIME,
        with_identified.state_true[:, :n],
        with_nominal.state_true[:, :n],
    )
