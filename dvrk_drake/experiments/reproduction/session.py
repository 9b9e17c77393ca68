"""Data that the figures of one reproduction share: output folder, recordings, workers, and identified arms."""

from __future__ import annotations

import dataclasses
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import dvrk_drake as dvrk
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import model_bodies
from dvrk_drake.experiments.ground_truth import collect, perturbed_arm, with_links
from dvrk_drake.experiments.releases import DURATION, Drifts, release_all
from dvrk_drake.experiments.reproduction.published import PAPER, PaperRecordings, paper_model
from dvrk_drake.models.arm import Arm
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.recording import Recording


@dataclass(frozen=True)
class SampleSizes:
    """Sample sizes of the experiments. Tests use smaller sizes.

    Attributes:
        collected: Number of poses for the identification of an arm.
        releases: Number of random release poses for our model.
        few_releases: Number of release poses, counted from the first, that are used for all other cases.
        path_poses: Number of poses on the path of an operator.
        duration: Duration of a release [s].
    """

    collected: int = 40
    releases: int = 200
    few_releases: int = 20
    path_poses: int = 5
    duration: float = DURATION


@dataclass(frozen=True, eq=False)
class IdentifiedArm:
    """Simulated arm and its identified model.

    Attributes:
        arm: Simulated arm with the effects of a real arm.
        poses: Static poses collected on the simulated arm.
        model: Model identified from the poses.
    """

    arm: Arm
    poses: Recording
    model: IdentifiedModel

    @property
    def exact(self) -> IdentifiedModel:
        """Exact model of the gravity, cable and spring torques, used only for evaluation."""
        return IdentifiedModel.from_arm(self.arm, self.arm.effects.position_dependent)


@dataclass(eq=False)
class ReproductionSession:
    """Reproduction of the paper's experiments. `mtm`, `psm` and `paper_model` are created at their first use.

    Attributes:
        folder: Output folder.
        recordings: Recordings of the paper's arm.
        executor: Executor of the simulations.
        progress: Function called with the step and its finished share, 0..1.
        sample_sizes: Sample sizes of the experiments.
        seed: Seed of perturbed arms, poses and noise.
    """

    folder: Path
    recordings: PaperRecordings
    executor: Executor
    progress: Progress = lambda step, share: None
    sample_sizes: SampleSizes = SampleSizes()
    seed: int = 0

    @cached_property
    def mtm(self) -> IdentifiedArm:
        """Identified MTM: the paper's arm if its recording is available, else a perturbed arm."""
        if self.recordings.folder is None:
            return self._identify(self._perturbed(PAPER.arm, PAPER.without))
        return self._identify(_paper_arm(self.recordings.poses, self.folder / f"true_{PAPER.arm}.sdf"))

    @cached_property
    def psm(self) -> IdentifiedArm:
        """Identified PSM, a perturbed arm."""
        return self._identify(self._perturbed(PAPER.second_arm))

    @cached_property
    def paper_model(self) -> IdentifiedModel:
        """Model with the paper's parameters.

        For a perturbed arm, the paper's method identifies this model from the same poses as our model.
        """
        arm = dvrk.load_arm(PAPER.arm)
        if self.recordings.folder is not None:
            return paper_model(arm)
        return dvrk.identify(self.mtm.poses, arm, method="paper").model

    def release(
        self,
        what: IdentifiedArm,
        model: IdentifiedModel,
        count: int,
        label: str,
        duration: float = DURATION,
        **more: Any,
    ) -> Drifts:
        """Simulates releases of an arm at random poses inside its limits. Pose i does not depend on the count.

        Args:
            what: Arm to simulate.
            model: Model of the controller.
            count: Number of poses.
            label: Name of the step for `progress`.
            duration: Largest duration of a release [s]. `sample_sizes` can reduce it.
            more: Other arguments of `release`.
        """
        duration, report = min(self.sample_sizes.duration, duration), step_progress(self.progress, label)
        poses = self.random_poses(what.arm, count)
        return release_all(what.arm, model, poses, self.executor, report, duration=duration, seed=self.seed, **more)

    @staticmethod
    def nominal(arm: Arm) -> Arm:
        """Returns the arm with the links and effects of its files."""
        return dvrk.load_arm(arm.source)

    def random_poses(self, arm: Arm, count: int) -> NDArray[np.float64]:
        """Returns random poses (count, n) inside the limits. Pose i depends on the seed and i, but not on the count."""
        return np.array([arm.sample_poses(1, np.random.default_rng([self.seed, i]))[0] for i in range(count)])

    def _perturbed(self, name: str, without: tuple[str, ...] = ()) -> Arm:
        return perturbed_arm(dvrk.load_arm(name), self.folder / f"true_{name}.sdf", self.seed, without=without)

    def _identify(self, arm: Arm) -> IdentifiedArm:
        nominal, name = dvrk.load_arm(arm.source), arm.source
        report = step_progress(self.progress, f"collecting poses of the {arm.name}")
        poses = collect(arm, self.sample_sizes.collected, self.seed, self.executor, report)
        dvrk.write_recording(poses, self.folder / f"{name}_poses.csv", nominal)
        model = dvrk.identify(poses, nominal, progress=self.progress).model
        model.provenance.recording = f"{name}_poses.csv"
        model.save(self.folder / f"{name}_model.yaml")
        return IdentifiedArm(arm, poses, model)


def _paper_arm(recording: Recording, path: Path) -> Arm:
    """Identifies the paper's MTM from its recording and writes its SDF to `path`.

    The links are physically consistent and have the identified gravity torque. They are as close as possible to the
    links of the SDF of this package. Cables and springs are those of the identified model. Friction, stops, encoders,
    motors and delays are those of `mechanisms/mtm.yaml`, because static poses do not determine them. Friction that is
    larger in one direction causes a constant torque in static poses, which is identified as an offset. The simulated
    friction already contains this torque. Therefore the identified offset of a joint with such friction is omitted.

    Raises:
        RecordingError, IdentificationError, ModelError: The recording is not of an MTM at rest.
    """
    arm = dvrk.load_arm(PAPER.arm)
    model = dvrk.identify(recording, arm).model
    one_sided = {law.coordinate for law in arm.effects.friction if law.kind == "presliding forward"}
    laws = [
        law
        for law in model.effects
        if law.kind != "offset" or law.coordinate.replace("joint.", "actuator.", 1) not in one_sided
    ]
    joints = [dataclasses.replace(joint, feedforward_scale=1.0) for joint in model.joints]
    links = model_bodies(dataclasses.replace(model, joints=joints, effects=laws)).links
    effects = dataclasses.replace(arm.effects, cables=laws, springs=[])
    return dataclasses.replace(with_links(arm, links, path, "the paper's recording"), effects=effects)
