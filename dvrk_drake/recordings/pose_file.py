"""Files of a collection: the poses to visit, as YAML, and the poses that were measured, as CSV.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.schema_fault import within
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.recordings.csv_rows import GrowingFile, parse_finite, read_bytes, read_rows
from dvrk_drake.recordings.recording import SAME_POSE, Recording, column_names

#: A pose written with few digits may stand on a limit [rad, m].
_ROUNDING = 1e-9


@dataclass
class PoseFile:
    """Schema of a file of poses: of which arm, and one list of n joint positions [rad, m] a pose."""

    format: str = "dvrk_drake poses 1"
    arm: str = ""
    # `check_poses` has the limits of the arm.
    poses: list[list[float]] = field(default_factory=list, metadata=within(-1e4, 1e4, "rad or m"))


def load_poses(path: str | Path, arm: Arm) -> NDArray[np.float64]:
    """The poses (m, n) in a file, all of them good to visit.

    Raises:
        CollectionError: no such file, not a file of poses, of another arm, or a pose that `check_poses` refuses.
    """
    if not os.path.lexists(path):
        raise CollectionError(f"{path}: no such file of poses; --teach or --random makes one")
    content = load_typed_yaml(PoseFile, path, CollectionError, "a file of poses")
    if content.format != PoseFile.format:
        raise CollectionError(f'{path}: format is "{content.format}", this version reads "{PoseFile.format}"')
    if content.arm.lower() != arm.name.lower():
        raise CollectionError(f'{path}: arm is "{content.arm}", not {arm.name}')
    if not content.poses:
        raise CollectionError(f"{path}: has no poses")
    for k, pose in enumerate(content.poses):
        if len(pose) != arm.num_joints:
            raise CollectionError(
                f"{path}: pose {k + 1} has {len(pose)} numbers; {arm.name} has {arm.num_joints} joints: "
                f"{', '.join(arm.joint_names)}"
            )
    poses = np.array(content.poses, float)
    check_poses(poses, arm, str(path))
    return poses


def check_poses(poses: NDArray[np.float64], arm: Arm, source: str) -> None:
    """Refuses poses (m, n) that `arm` cannot take, or two that are one; `source` begins the message.

    Raises:
        CollectionError: numbers that are not finite, degrees or millimetres, outside the limits, or a pose twice.
    """
    for k, pose in enumerate(poses):
        if not np.all(np.isfinite(pose)):
            raise CollectionError(f"{source}: pose {k + 1} must be finite numbers; got {pose.tolist()}")
    try:
        Recording(q=poses, source=source).check_fits(arm)  # knows degrees and millimetres when it sees them
    except RecordingError as error:
        raise CollectionError(str(error).replace(": row ", ": pose ")) from error
    for k, pose in enumerate(poses):
        if violations := arm.limit_violations(pose, _ROUNDING):
            raise CollectionError(f"{source}: pose {k + 1}: {'; '.join(violations)} [rad, m] of {arm.name}")
        if (same := same_pose(poses[:k], pose, arm)) is not None:
            raise CollectionError(f"{source}: pose {k + 1} is pose {same + 1} again, within {SAME_POSE[0]} rad")


def same_pose(poses: NDArray[np.float64], pose: NDArray[np.float64], arm: Arm) -> int | None:
    """Which of `poses` (m, n) is the same as `pose` (n,), or None."""
    rows = np.flatnonzero(np.all(np.abs(poses - pose) < arm.per_joint(*SAME_POSE), axis=1))
    return int(rows[0]) if len(rows) else None


def save_poses(poses: NDArray[np.float64], arm: Arm, path: str | Path) -> None:
    """Writes poses (m, n) at once or not at all, with every digit.

    Raises:
        CollectionError: as `check_poses`.
        DvrkDrakeError: it cannot be written.
    """
    check_poses(poses, arm, str(path))
    with atomic_write(path) as stream:
        stream.write(f"format: {PoseFile.format}\narm: {arm.name}\n")
        stream.write(f"# {', '.join(arm.joint_names)} [rad, m]\nposes:\n")
        stream.writelines(f"- {pose.tolist()}\n" for pose in poses)


def load_poses_if_any(path: str | Path, arm: Arm) -> NDArray[np.float64]:
    """As `load_poses`, but no poses (0, n) where there is no file yet."""
    return load_poses(path, arm) if os.path.lexists(path) else np.empty((0, arm.num_joints))


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
