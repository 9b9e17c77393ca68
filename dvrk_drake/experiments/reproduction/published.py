"""Numbers and recordings that the paper's team published, and conversion of its parameters to a model."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.tree import JacobianWrtVariable

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.models.typed_yaml import load_yaml
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording

#: Content of published.yaml, by key. The comments of this file define the numbers.
PAPER = SimpleNamespace(**load_yaml(Path(__file__).with_name("published.yaml"), RecordingError))
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
