"""Shared resources of the figures of one run: folder, recordings, workers, and identified arms."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.analysis.static.static_identification import identify_static
from dvrk_drake.dynamics.friction_compensation import Friction
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.experiments.ground_truth import GroundTruth, collect, paper_arm, perturbed_ground_truth
from dvrk_drake.experiments.reproduction.drift_experiment import DURATION, Drifts, Release, release_all
from dvrk_drake.experiments.reproduction.published import (
    FIGURE_7_FAULTY,
    PAPER_ARM,
    PaperRecordings,
    paper_model,
    with_zeroed,
)
from dvrk_drake.experiments.transparency import Compensation, OperatorForces, random_path, simulate_operator
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.progress import Progress
from dvrk_drake.recordings.recording import Recording, write_recording


@dataclass(frozen=True)
class SampleSizes:
    """Sample sizes of the experiments. Tests use smaller ones.

    Attributes:
        collected: Number of poses for the identification of an arm.
        releases: Number of random release poses with our model.
        paper_releases: Number of these poses for the paper's parameters.
        hand_guided_releases: Number of these poses for our model with a previous approach.
        psm_releases: Number of release poses of the PSM.
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
class Identified:
    """Ground-truth arm, poses collected on it, and the model identified from them, with its file."""

    truth: GroundTruth
    poses: Recording
    model: IdentifiedModel
    file: Path


@dataclass(eq=False)
class ReproductionSession:
    """Session of the reproduction. All resources are created at their first use.

    Attributes:
        folder: Folder of the results.
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
    def mtm(self) -> Identified:
        """Identified MTM: the paper's arm if its recording is available, else a perturbed ground-truth arm."""
        self.progress("finding the true MTM", 0.0)
        if self.recordings.folder is None:
            truth = perturbed_ground_truth(PAPER_ARM, self.folder, self.seed)
        else:
            truth = paper_arm(self.recordings.poses, self.folder)
        return self._identified(truth, PAPER_ARM)

    @cached_property
    def psm(self) -> Identified:
        """Identified PSM, a perturbed ground-truth arm."""
        return self._identified(perturbed_ground_truth("psm", self.folder, self.seed), "psm")

    @cached_property
    def paper_file(self) -> Path:
        """File of the paper's parameters. On another arm, the paper's method is applied to the same poses."""
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
        what: str,
        parts: Sequence[str] = ("all",),
        damped: bool = False,
        led: bool = False,
        hysteresis_ratio: float = 0.0,
        longest: float = DURATION,
    ) -> Drifts:
        """Releases the arm `name` at `poses` (m, n) with the model of a file for at most `longest` [s].

        See `Release` for `parts`, `damped`, `led` and `hysteresis_ratio`.
        """
        duration = min(self.sample_sizes.duration, longest)
        every = Release(
            name, truth.arm, tuple(parts), str(model), poses[0], damped, led, hysteresis_ratio, duration, self.seed
        )
        cases = [dataclasses.replace(every, start=pose, seed=self.seed + i) for i, pose in enumerate(poses)]
        positions = release_all(cases, self.executor, lambda share: self.progress(what, share))
        return Drifts(truth.arm, positions)

    def random_poses(self, name: str, count: int) -> NDArray[np.float64]:
        """Returns random poses (count, n) inside the limits. The first ones do not depend on the count."""
        poses = [load_arm(name).sample_poses(1, np.random.default_rng([self.seed, i]))[0] for i in range(count)]
        return np.array(poses)

    def zeroed(self, model: Path) -> Path:
        """Returns the file of the same model without torque on joints 5-7."""
        path = model.with_stem(model.stem + "_zeroed")
        with_zeroed(IdentifiedModel.load(model), FIGURE_7_FAULTY).save(path)
        return path

    def _identified(self, truth: GroundTruth, name: str) -> Identified:
        label = name.upper()
        poses = collect(
            truth,
            name,
            self.sample_sizes.collected,
            self.seed,
            self.executor,
            lambda share: self.progress(f"collecting poses of the {label}", share),
        )
        recording, file = self.folder / f"{name}_poses.csv", self.folder / f"{name}_model.yaml"
        write_recording(poses, recording)
        identification = identify_static(
            poses, load_arm(name), progress=lambda share: self.progress(f"identifying the {label}", share)
        )
        identification.model.provenance.recording = recording.name
        identification.model.save(file)
        return Identified(truth, poses, identification.model, file)


@dataclass(frozen=True, eq=False)
class Lead:
    """Picklable description of an operator who moves an arm; `model` is a file, or "" for unpowered motors."""

    name: str
    arm: Arm
    model: str
    friction_ratio: float
    poses: int
    seed: int


def led(lead: Lead) -> OperatorForces:
    """Simulates the interaction forces along a path through random poses."""
    model = IdentifiedModel.load(lead.model) if lead.model else None
    # The controller uses the friction of the arm files, but an identified gravity model.
    friction = Friction.of_arm(load_arm(PAPER_ARM))
    compensation = Compensation(lead.name, model, lead.friction_ratio, friction)
    path = random_path(lead.arm, lead.poses, seed=lead.seed)
    return simulate_operator(lead.arm, path, compensation, effects=lead.arm.effects, seed=lead.seed)
