"""Numbers and recordings that the paper's team published, and conversion of its parameters to a model.

Source: Rutfield, Zia, Boos, Santoso, Sujumnong, "Gravity Compensation Control of da Vinci Robot", WPI 2015, and the
team's repository WPI-AIM/dvrk_gravity_comp. Drifts are digitised from the team's plots.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.tree import JacobianWrtVariable

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.recordings.recording import Recording

#: Values of the length symbols in Table I for the real arm [m]. L1 does not affect any joint and is 0 in the SDF.
LENGTHS = {"0": 0.0, "L1": 0.0, "L2": 0.2794, "L3": 0.3645, "L4": 0.1506}


class TableRow(NamedTuple):
    """Row of Table I, the DH table of the MTM.

    Attributes:
        sign, offset: Sign and offset [rad] of the joint angle theta = sign q + offset.
        d, a: Names of the lengths along z and x, see `LENGTHS`.
        alpha: Twist angle [rad].
    """

    sign: int
    offset: float
    d: str
    alpha: float
    a: str


_QUARTER = np.pi / 2
TABLE_1 = (
    TableRow(+1, 0.0, "-L1", -_QUARTER, "0"),
    TableRow(-1, +_QUARTER, "0", 0.0, "L2"),
    TableRow(-1, -_QUARTER, "0", +_QUARTER, "L3"),
    TableRow(+1, 0.0, "L4", -_QUARTER, "0"),
    TableRow(-1, np.pi, "0", -_QUARTER, "0"),
    TableRow(+1, -_QUARTER, "0", +_QUARTER, "0"),
    TableRow(-1, 0.0, "0", 0.0, "0"),
)

#: The paper's twelve parameters [kg m] in its order, identified with g = 9.9 m/s^2. Its controller uses 9.81 m/s^2.
PARAMETERS = (0.0414, -0.0192, 0.0328, 0.0095, -0.0033, -0.0003, -0.0071, -0.0188, -0.0015, -0.0003, -0.0001, 0.0005)
#: First moment that each parameter represents: link (from 1), and axis of its frame in Table I. Each parameter also
#: contains other first moments with the same effect on the torques.
PARAMETER_COMPONENTS = (
    (2, "x"),
    (2, "y"),
    (3, "x"),
    (4, "y"),
    (5, "z"),
    (6, "z"),
    (4, "x"),
    (5, "y"),
    (5, "x"),
    (6, "x"),
    (7, "x"),
    (7, "y"),
)
#: Gravitational acceleration in the paper's identification and in its controller [m/s^2].
IDENTIFICATION_GRAVITY, CONTROL_GRAVITY = 9.9, 9.81

#: Mean squared errors of Fig. 4 over the 72 poses [(N m)^2], J2..J7.
FIGURE_4_MEANS = (8.14e-3, 7.96e-3, 1.97e-3, 4.62e-4, 3.98e-5, 1.92e-5)

#: Final drifts [rad] of J2..J7 in the trial that each figure shows (`FIGURE_5`, `FIGURE_6`), and means of the absolute
#: final drifts over the team's five trials for each figure (`FIGURE_5_MEANS`, `FIGURE_6_MEANS`).
FIGURE_5 = (0.0102, 0.0051, -0.0138, -0.174, -0.021, 0.0)
FIGURE_6 = (0.0101, -0.0099, 0.0050, -0.003, -0.316, -0.071)
FIGURE_5_MEANS = (0.070, 0.020, 0.0085, 1.29, 0.315, 0.730)
FIGURE_6_MEANS = (0.013, 0.041, 0.038, 0.491, 0.481, 0.742)

#: Fig. 7: start pose [rad], gains at 100 Hz (N m/rad, N m s/rad, N m/rad per sample), masses of base and links [kg].
FIGURE_7_START = (0.0, -0.22, -0.79, 0.0, 3.13, 0.0, 0.0)
FIGURE_7_KP = (0.5, 0.8, 0.85, 3.7, 0.5, 0.02, 0.006)
FIGURE_7_KV = (1.95, 0.95, 1.75, 0.2, 0.1, 0.8, 0.08)
FIGURE_7_KI = (1e-5, 5e-5, 1e-4, 4e-4, 1e-6, 1e-7, 1e-8)
FIGURE_7_MASSES = (0.9, 1.0, 0.9, 0.8, 0.4, 0.2, 0.2, 0.1)
#: Indices of the joints whose damping term used positions instead of velocities in the team's controller.
FIGURE_7_FAULTY = (4, 5, 6)
#: Values digitised from Fig. 7: period of J2 [s]; |J2| after 59 s, amplitudes of J6 and of J7 (early, late) [rad].
FIGURE_7_VALUES = {"J2 period": 22.0, "J2 at 59 s": 0.075, "J6": 0.022, "J7 early": 0.0115, "J7 late": 0.0155}


#: Number of poses for the conversion to our base parameters. It must exceed the number of parameters.
_POSES = 40


def paper_torque(arm: Arm, q: ArrayLike, parameters: Sequence[float] = PARAMETERS) -> NDArray[np.float64]:
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
        for value, (link, axis) in zip(parameters, PARAMETER_COMPONENTS, strict=True):
            frame = plant.GetFrameByName(f"paper_{link}")
            h_W = value * frame.CalcPoseInWorld(context).rotation().matrix()[:, "xyz".index(axis)]
            J = plant.CalcJacobianAngularVelocity(context, JacobianWrtVariable.kV, frame, world, world)
            # The links form a serial chain. Joints of the other bars of the linkage do not rotate them.
            torque[k] += CONTROL_GRAVITY * np.cross(J[:, tree].T, h_W)[:, 2]
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
#: Recorded arm. The first moment of its wrist brackets shows that it is an MTMR (docs/public_recordings.md).
PAPER_ARM = "mtmr"
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
