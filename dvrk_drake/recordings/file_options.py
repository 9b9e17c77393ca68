"""Options for facts that the file of a recording may not state: arm, coordinates, names and sampling rate."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.recording import Recording, wpi_transmission

#: Coordinates of q, qd and tau in a file. "wpi": actuator coordinates, except for the roll of a PSM, which is in joint
#: coordinates (motions of WPI; Wang et al. 2019, table of the PSM).
FileCoordinates = Literal["joint", "actuator", "wpi"]
#: Number of joints of a file that is read without an arm.
_DEFAULT_JOINTS = 7


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Options of a reader. For the attributes, see the arguments of `read_recording`."""

    arm: Arm | None = None
    coordinates: FileCoordinates | None = None
    topic: str | None = None
    arrays: Mapping[str, str] | None = None
    rate: float | None = None
    skip_invalid: bool = False
    #: Callback that receives the completed fraction (0 to 1).
    progress: Callable[[float], object] = lambda share: None

    @property
    def num_joints(self) -> int:
        """Number of joints in the file."""
        return self.arm.num_joints if self.arm else _DEFAULT_JOINTS

    def required_arm(self, path: Path) -> Arm:
        """Returns the arm.

        Raises:
            RecordingError: The arm is None.
        """
        if self.arm is None:
            raise RecordingError(
                f"{path}: this format needs the arm whose joint states are read: --arm (arm= in Python)"
            )
        return self.arm

    def with_coordinates(self, recording: Recording, default: FileCoordinates = "joint") -> Recording:
        """Returns a recording with the coordinates of these options.

        Data in "wpi" coordinates are converted to joint coordinates of the arm. Without an arm, they are not changed,
        and the result states actuator coordinates, which is wrong for the roll of a PSM.

        Args:
            recording: Data of the file. Its attribute `coordinates` is not used.
            default: Coordinates of the data if these options have none.
        """
        coordinates = self.coordinates or default
        if coordinates != "wpi":
            return dataclasses.replace(recording, coordinates=coordinates)
        recording = dataclasses.replace(recording, coordinates="actuator")
        if self.arm is None:
            note = "in the coordinates wpi; pass --coordinates wpi to every command that reads the converted file"
            return dataclasses.replace(recording, notes=(*recording.notes, note))
        return recording.in_joint_coordinates(dataclasses.replace(self.arm, transmission=wpi_transmission(self.arm)))

    def sampled_times(
        self, path: Path, t: NDArray[np.float64] | None, rows: NDArray[np.int_], default_rate: float | None = None
    ) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
        """Returns the times [s] of the rows of a file, and notes on them.

        Args:
            path: Path of the file, for messages.
            t: Times (m,) in the file, or None.
            rows: Index (m,) of each row among all rows of the file.
            default_rate: Sampling rate [Hz] of a file without times if these options have no rate. None: the rows are
                static poses, without times.

        Raises:
            RecordingError: The rate is not a positive number, or a rate is given for a file with times.
        """
        if self.rate is not None and not (np.isfinite(self.rate) and self.rate > 0):
            raise RecordingError(f"rate is {self.rate:g} Hz; allowed: a positive number")
        if t is not None:
            if self.rate is not None:
                raise RecordingError(f"{path}: --rate does not apply, because the file has times")
            return t, ()
        rate = default_rate if self.rate is None else self.rate
        if rate is None:
            return None, ()
        return rows / rate, (f"{len(rows)} samples; the file has no times, so t = row / {rate:g} Hz",)
