"""Numbers and recordings that the paper's team published, and the arms and models that its reproduction shares."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.tree import JacobianWrtVariable

import dvrk_drake as dvrk
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.model_links import model_bodies
from dvrk_drake.errors import RecordingError
from dvrk_drake.experiments.ground_truth import collect, perturbed_arm, with_links
from dvrk_drake.experiments.releases import DURATION, Drifts, release_all
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.models.typed_yaml import load_yaml
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.recordings.recording import Recording

#: Content of paper.yaml, by key. The comments of this file define the numbers.
PAPER = SimpleNamespace(**load_yaml(Path(__file__).with_name("paper.yaml"), RecordingError))
#: Number of poses for the conversion to our base parameters. It must exceed the number of parameters.
_POSES = 40


def paper_torque(arm: Arm, q: ArrayLike, parameters: Sequence[float] = PAPER.parameters) -> NDArray[np.float64]:
    """Computes the torque (m, n) of the paper's twelve parameters [kg m] at poses q (m, n).

    This is equation 8 of the paper with g = 9.81 m/s^2. Each parameter is a component of the first moment h of one
    link in its frame of Table I. R_i is the rotation matrix of this frame, and z points up. Hence the potential energy
    is P = g sum_i z . R_i h_i. Its derivative is dP/dq_j = g sum_i z . (w_j x R_i h_i), where w_j is the angular
    velocity of link i per unit velocity of joint j.
    """
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    world = plant.world_frame()
    tree = [plant.GetJointByName(name).velocity_start() for name in arm.joint_names]
    torque = np.zeros(np.shape(q))
    for k, pose in enumerate(np.asarray(q, float)):
        set_arm_positions(plant, context, arm, pose)
        for value, moment in zip(parameters, PAPER.moments, strict=True):
            link, axis = moment.split()
            frame = plant.GetFrameByName(f"paper_{link}")
            h_W = value * frame.CalcPoseInWorld(context).rotation().matrix()[:, "xyz".index(axis)]
            J = plant.CalcJacobianAngularVelocity(context, JacobianWrtVariable.kV, frame, world, world)
            # The links form a serial chain. Joints of the other bars of the linkage do not rotate them.
            torque[k] += PAPER.control_gravity * np.cross(J[:, tree].T, h_W)[:, 2]
    return torque


def paper_model(arm: Arm) -> IdentifiedModel:
    """Returns a model whose torque equals `paper_torque`. The base parameters can represent these torques exactly."""
    q = arm.sample_poses(_POSES, np.random.default_rng(0))
    model = IdentifiedModel.from_arm(arm)
    Y = model.static_model.regressor(q)
    beta = np.linalg.lstsq(Y.reshape(-1, Y.shape[2]), paper_torque(arm, q).ravel(), rcond=None)[0]
    parameters = [
        dataclasses.replace(p, value=float(value)) for p, value in zip(model.base_parameters, beta, strict=True)
    ]
    return dataclasses.replace(model, base_parameters=parameters)


def with_zero_torque(model: IdentifiedModel, joints: Sequence[int]) -> IdentifiedModel:
    """Returns the model with zero torque for the joints with indices `joints`, as in the paper's Fig. 6."""
    statistics = [
        dataclasses.replace(s, feedforward_scale=0.0) if j in joints else s for j, s in enumerate(model.joints)
    ]
    return dataclasses.replace(model, joints=statistics)


#: Names of the files with the paper's identification poses and with the squared errors of its Fig. 4 (optional).
STATIC, FIGURE_4 = "mtm_2015_good72.csv", "paper_fig4_squared_errors.csv"
#: Environment variable: path of the folder that contains data/mtm_static. The tests also use it.
VARIABLE = "DVRK_DRAKE_SHARED"
_INSTRUCTIONS = "To create it from the team's repository, see docs/public_recordings.md."


@dataclass(frozen=True)
class PaperRecordings:
    """Files of the paper's recordings in `folder`. The folder is None if the files are not available."""

    folder: Path | None

    @classmethod
    def find(cls, folder: str | Path | None) -> PaperRecordings:
        """Finds the files in `folder`. None: data/mtm_static in the folder of the environment variable `VARIABLE`.

        Raises:
            RecordingError: `folder` was given and does not contain the recording.
        """
        if folder is not None:
            if not (Path(folder) / STATIC).is_file():
                raise RecordingError(f"{folder}: the folder does not contain {STATIC}. {_INSTRUCTIONS}")
            return cls(Path(folder))
        shared = os.environ.get(VARIABLE)
        below = Path(shared) / "data" / "mtm_static" if shared else None
        return cls(below if below is not None and (below / STATIC).is_file() else None)

    @property
    def files(self) -> list[Path]:
        """Existing files of the recordings."""
        return [] if self.folder is None else [p for n in (STATIC, FIGURE_4) if (p := self.folder / n).is_file()]

    @property
    def poses(self) -> Recording:
        """Reads the paper's 72 poses.

        Raises:
            RecordingError: The recording does not exist.
        """
        if self.folder is None:
            raise RecordingError(f"{STATIC} is required. Give its folder with --data. {_INSTRUCTIONS}")
        return read_recording(self.folder / STATIC)

    @property
    def figure_4(self) -> NDArray[np.float64] | None:
        """Reads the published squared errors (72, 6) of J2..J7 [(N m)^2]; returns None if there is no file.

        Raises:
            RecordingError: The file does not contain these errors.
        """
        if self.folder is None or not (path := self.folder / FIGURE_4).is_file():
            return None
        try:
            table = np.loadtxt(path, delimiter=",", skiprows=1)
        except ValueError as error:
            raise RecordingError(f"{path}: {error}") from error
        if table.shape != (72, 7):
            raise RecordingError(
                f"{path}: the table must have 72 rows and 7 columns (pose, J2..J7); its shape is {table.shape}"
            )
        return np.asarray(table[:, 1:])


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
