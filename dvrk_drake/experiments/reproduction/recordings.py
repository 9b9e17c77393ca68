"""Where the recordings are that the paper's numbers were made from."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.recordings.recording import Recording, read_recording

#: The paper's identification set; the squared errors behind its Fig. 4, if somebody has them.
STATIC, FIGURE_4 = "mtm_2015_good72.csv", "paper_fig4_squared_errors.csv"
#: The arm that was recorded: a right one, by the moment of its wrist's brackets (docs/public_recordings.md).
PAPER_ARM = "mtmr"
#: Names the folder above data/mtm_static, as the tests have it.
VARIABLE = "DVRK_DRAKE_SHARED"


@dataclass(frozen=True)
class PaperRecordings:
    """The files in `folder`; `folder` is None where there is none."""

    folder: Path | None

    @classmethod
    def find(cls, folder: str | Path | None) -> PaperRecordings:
        """In `folder`, else below the folder that the environment variable DVRK_DRAKE_SHARED names.

        Raises:
            RecordingError: `folder` was given and has no such recording.
        """
        if folder is not None:
            if not (Path(folder) / STATIC).is_file():
                raise RecordingError(f"{folder}: no {STATIC} there; {_where_from()}")
            return cls(Path(folder))
        shared = os.environ.get(VARIABLE)
        below = Path(shared) / "data" / "mtm_static" if shared else None
        return cls(below if below is not None and (below / STATIC).is_file() else None)

    @property
    def poses(self) -> Recording:
        """The paper's 72 poses.

        Raises:
            RecordingError: there are none.
        """
        if self.folder is None:
            raise RecordingError(f"needs {STATIC}: name its folder with --data; {_where_from()}")
        return read_recording(self.folder / STATIC)

    @property
    def figure_4(self) -> NDArray[np.float64] | None:
        """(72, 6) squared errors [(N m)^2] of J2..J7 as published, or None.

        Raises:
            RecordingError: the file is not that.
        """
        if self.folder is None or not (path := self.folder / FIGURE_4).is_file():
            return None
        try:
            table = np.loadtxt(path, delimiter=",", skiprows=1)
        except ValueError as error:
            raise RecordingError(f"{path}: {error}") from error
        if table.shape != (72, 7):
            raise RecordingError(f"{path}: must be 72 rows of pose, J2..J7; it is {table.shape}")
        return np.asarray(table[:, 1:])


def _where_from() -> str:
    return "docs/public_recordings.md says how to make it from the team's repository"
