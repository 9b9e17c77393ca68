"""Data that the figures of one reproduction share: output folder, recordings, workers, and identified arms."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.pose_identification import identify_static
from dvrk_drake.dynamics.friction_compensation import Friction
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.ground_truth import GroundTruth, collect, paper_arm, perturbed_ground_truth
from dvrk_drake.experiments.reproduction.drift_experiment import DURATION, Approach, Drifts, Release, release_all
from dvrk_drake.experiments.reproduction.published import (
    FIGURE_7_FAULTY,
    PAPER_ARM,
    PaperRecordings,
    paper_model,
    with_zero_torque,
)
from dvrk_drake.experiments.transparency import Compensation, OperatorForces, random_path, simulate_operator
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.progress import Progress
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.recordings.writing import write_recording
from dvrk_drake.systems.gravity_pid_controller import Mode


@dataclass(frozen=True)
class SampleSizes:
    """Sample sizes of the experiments. Tests use smaller sizes.

    Attributes:
        collected: Number of poses for the identification of an arm.
        releases: Number of random release poses for our model.
        paper_releases: Number of release poses, counted from the first, that are also used for the paper's parameters.
        hand_guided_releases: Number of release poses, counted from the first, that are also used for our model with an
            approach.
        psm_releases: Number of random release poses of the PSM.
        path_poses: Number of poses on the path of an operator.
        duration: Duration of a release [s].
    """

    collected: int = 40
    releases: int = 200
    paper_releases: int = 20
    hand_guided_releases: int = 20
    psm_releases: int = 20
    path_poses: int = 5
    duration: float = DURATION


@dataclass(frozen=True, eq=False)
class IdentifiedArm:
    """Ground-truth arm and its identified model.

    Attributes:
        truth: Ground-truth arm.
        poses: Static poses collected on the ground-truth arm.
        model: Model identified from the poses.
        file: Path of the model file.
    """

    truth: GroundTruth
    poses: Recording
    model: IdentifiedModel
    file: Path


@dataclass(eq=False)
class ReproductionSession:
    """Reproduction of the paper's experiments. `mtm`, `psm` and `paper_file` are created at their first use.

    Attributes:
        folder: Output folder.
        recordings: Recordings of the paper's arm.
        executor: Executor of the simulations.
        progress: Function called with the step and its finished share, 0..1.
        sample_sizes: Sample sizes of the experiments.
        seed: Seed of ground-truth arms, poses and noise.
    """

    folder: Path
    recordings: PaperRecordings
    executor: Executor
    progress: Progress = lambda step, share: None
    sample_sizes: SampleSizes = SampleSizes()
    seed: int = 0

    @cached_property
    def mtm(self) -> IdentifiedArm:
        """Identified MTM: the paper's arm if its recording is available, else a perturbed ground-truth arm."""
        self.progress("making the ground-truth MTM", 0.0)
        if self.recordings.folder is None:
            truth = perturbed_ground_truth(PAPER_ARM, self.folder, self.seed)
        else:
            truth = paper_arm(self.recordings.poses, self.folder)
        return self._identify(truth, PAPER_ARM)

    @cached_property
    def psm(self) -> IdentifiedArm:
        """Identified PSM, a perturbed ground-truth arm."""
        return self._identify(perturbed_ground_truth("psm", self.folder, self.seed), "psm")

    @cached_property
    def paper_file(self) -> Path:
        """Path of the model file with the paper's parameters.

        For a perturbed ground-truth arm, the paper's method identifies this model from the same poses as our model.
        """
        mtm, path = self.mtm, self.folder / "paper_model.yaml"
        if mtm.truth.is_paper_arm:
            paper_model(load_arm(PAPER_ARM)).save(path)
        else:
            identify_static(mtm.poses, load_arm(PAPER_ARM), "paper").model.save(path)
        return path

    def release(
        self,
        name: str,
        truth: GroundTruth,
        model: Path,
        poses: NDArray[np.float64],
        label: str,
        parts: Sequence[str] = ("all",),
        mode: Mode = "gravity",
        approach: Approach = "none",
        hysteresis_ratio: float = 0.0,
        max_duration: float = DURATION,
    ) -> Drifts:
        """Simulates releases of an arm at several poses.

        Args:
            name: Name of the arm.
            truth: Ground-truth arm to simulate.
            model: Path of the controller's model file.
            poses: Release poses (m, n) [rad, m].
            label: Name of the step for `progress`.
            parts, mode, approach, hysteresis_ratio: See `Release`.
            max_duration: Maximum duration of each release [s]. `sample_sizes` can reduce it.
        """
        duration = min(self.sample_sizes.duration, max_duration)
        template = Release(
            name,
            truth.arm,
            tuple(parts),
            str(model),
            poses[0],
            mode,
            approach,
            hysteresis_ratio,
            duration,
            self.seed,
        )
        cases = [dataclasses.replace(template, start=pose, seed=self.seed + i) for i, pose in enumerate(poses)]
        positions = release_all(cases, self.executor, lambda share: self.progress(label, share))
        return Drifts(truth.arm, positions)

    def random_poses(self, name: str, count: int) -> NDArray[np.float64]:
        """Returns random poses (count, n) inside the limits. Pose i depends on the seed and i, but not on the count."""
        poses = [load_arm(name).sample_poses(1, np.random.default_rng([self.seed, i]))[0] for i in range(count)]
        return np.array(poses)

    def without_wrist_torque(self, model: Path) -> Path:
        """Writes a model file with zero torque on joints 5 to 7; returns its path."""
        path = model.with_stem(model.stem + "_zeroed")
        with_zero_torque(IdentifiedModel.load(model), FIGURE_7_FAULTY).save(path)
        return path

    def _identify(self, truth: GroundTruth, name: str) -> IdentifiedArm:
        arm_name = name.upper()
        poses = collect(
            truth,
            name,
            self.sample_sizes.collected,
            self.seed,
            self.executor,
            lambda share: self.progress(f"collecting poses of the {arm_name}", share),
        )
        recording, file = self.folder / f"{name}_poses.csv", self.folder / f"{name}_model.yaml"
        write_recording(poses, recording, load_arm(name))
        identification = identify_static(
            poses, load_arm(name), progress=lambda share: self.progress(f"identifying the {arm_name}", share)
        )
        identification.model.provenance.recording = recording.name
        identification.model.save(file)
        return IdentifiedArm(truth, poses, identification.model, file)


@dataclass(frozen=True, eq=False)
class OperatorCase:
    """Picklable arguments of `simulate_case`.

    Attributes:
        name: Name of the compensation.
        arm: Arm to simulate.
        model: Path of the controller's model file, or "" for unpowered motors.
        friction_ratio: Compensated share of the friction.
        poses: Number of random poses that define the path.
        seed: Seed of the path and of the effects' noise.
    """

    name: str
    arm: Arm
    model: str
    friction_ratio: float
    poses: int
    seed: int


def simulate_case(case: OperatorCase) -> OperatorForces:
    """Simulates an operator who moves an arm along a path through random poses."""
    model = IdentifiedModel.load(case.model) if case.model else None
    # The controller uses the friction of the arm files, but an identified gravity model.
    friction = Friction.of_arm(load_arm(PAPER_ARM))
    compensation = Compensation(case.name, model, case.friction_ratio, friction)
    path = random_path(case.arm, case.poses, seed=case.seed)
    return simulate_operator(case.arm, path, compensation, effects=case.arm.effects, seed=case.seed)
