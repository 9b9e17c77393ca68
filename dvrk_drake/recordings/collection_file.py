"""The CSV that a collection writes: a Recording of poses that grows by one row a pose, and can be gone on with."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.recordings.csv_rows import parse_finite, read_bytes, read_rows
from dvrk_drake.recordings.growing_file import GrowingFile
from dvrk_drake.recordings.recording import column_names


class CollectionFile:
    """One row a finished pose, which is on the disk when `append` returns.

    Columns: q1..qn and tau1..taun as measured, as in every Recording; friction1..n, half of the difference between
    the efforts from either side, where there are two; pose1..n, the pose that was asked for; arm; utime when the row
    was written [us since 1970]. Joints in the arm's order [rad, N m; m, N on a prismatic joint].
    """

    def __init__(self, path: str | Path, arm: Arm, both_sides: bool) -> None:
        """At `path`; what is there already must be rows of this kind.

        Args:
            path: of a CSV that is new or goes on.
            arm: whose poses.
            both_sides: whether each pose is measured from either side.

        Raises:
            CollectionError: it is no collection of this arm in this manner.
            RecordingError: it cannot be read.
        """
        self._path, self._arm, self._both_sides = Path(path), arm, both_sides
        self._header = [*self._names("q"), *self._names("tau"), *self._names("pose"), "arm", "utime"]
        if both_sides:
            self._header += self._names("friction")
        self._file: GrowingFile | None = None
        self._is_there, self._has_header = os.path.lexists(path), False
        self._rows = self._read() if self._is_there else []

    def finished(self, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(m,) which of `poses` (m, n) the file has already.

        Raises:
            CollectionError: it has one that is none of them.
        """
        done = np.zeros(len(poses), bool)
        for line, pose in self._rows:
            which = np.all(poses == pose, axis=1)
            if not which.any():
                raise CollectionError(
                    f"{self._path}:{line}: was collected for a pose that is none of these; name another output, or "
                    "the poses that it was begun with (more may be added to them)"
                )
            done |= which
        return done

    def append(
        self,
        pose: NDArray[np.float64],
        q: NDArray[np.float64],
        tau: NDArray[np.float64],
        friction: NDArray[np.float64] | None = None,
    ) -> None:
        """Adds the measured q, tau (n,) of a pose (n,), and the friction (n,) that the two sides tell.

        Raises:
            RecordingError: it cannot be written; the rows before are whole.
        """
        if self._file is None:
            self._file = GrowingFile(self._path, resume=self._is_there, sync=True)
            if not self._has_header:
                self._file.append((",".join(self._header) + "\n").encode())
        numbers = [*map(repr, [*q.tolist(), *tau.tolist(), *pose.tolist()])]
        cells = [*numbers, self._arm.name, str(time.time_ns() // 1000)]
        if friction is not None:
            cells += map(repr, friction.tolist())
        self._file.append((",".join(cells) + "\n").encode())

    def close(self) -> None:
        """Ends the file."""
        if self._file is not None:
            self._file.close()

    def _names(self, prefix: str) -> list[str]:
        return column_names(prefix, self._arm.num_joints)

    def _read(self) -> list[tuple[int, NDArray[np.float64]]]:
        """(line, pose that was asked for) of each whole row."""
        rows, _ = read_rows(self._path)
        if not read_bytes(self._path).endswith(b"\n"):
            rows = rows[:-1]  # a power failure cut it
        if not rows:
            return []
        (_, header), *rows = rows
        self._check_header(header)
        self._has_header = True
        columns = [header.index(name) for name in self._names("pose")]
        found = []
        for line, cells in rows:
            where = f"{self._path}:{line}"
            if len(cells) != len(header):
                raise RecordingError(f"{where}: has {len(cells)} cells, the header names {len(header)} columns")
            if (name := cells[header.index("arm")]) != self._arm.name:
                raise CollectionError(f"{where}: is of {name}, not of {self._arm.name}; name another output")
            found.append((line, np.array([parse_finite(cells[j], f"{where}: {header[j]}") for j in columns])))
        return found

    def _check_header(self, header: list[str]) -> None:
        if header == self._header:
            return
        if "pose1" in header and ("friction1" in header) != self._both_sides:
            sides = "one side (--no-both-sides)" if self._both_sides else "both sides (--both-sides)"
            raise CollectionError(f"{self._path}: was collected from {sides}; go on in the same way")
        raise CollectionError(
            f"{self._path}: is there and was not collected from {self._arm.name}; name another output"
        )
