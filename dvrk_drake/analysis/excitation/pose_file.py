"""Poses that the command `collect` measures (YAML), their approach, and the measured poses (CSV)."""

# This file has no postponed annotations, because yaml_load_typed reads the types at run time.
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.environment import Environment
from dvrk_drake.models.files import GrowingFile, atomic_write, csv_line, read_input
from dvrk_drake.models.ranges import within
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.recordings.csv_files import column_names, parse_finite, read_rows
from dvrk_drake.recordings.recording import SAME_POSE, Recording

#: Tolerance of the limits [rad, m], because the positions in a file may be rounded.
_ROUNDING = 1e-9


@dataclass
class PoseFile:
    """Schema of a pose file: `Arm.full_name`, and one list of n joint positions [rad, m] per pose.

    The paths between the poses avoid the objects of the environment.
    """

    format: str = "dvrk_drake poses 1"
    arm: str = ""
    environment: Environment = field(default_factory=Environment)
    # `check_poses` checks the limits of the arm.
    poses: list[list[float]] = field(default_factory=list, metadata=within(-1e4, 1e4, "rad or m"))


def load_poses(path: str | Path, arm: Arm) -> NDArray[np.float64]:
    """Reads and checks the poses (m, n) in a file.

    Raises:
        CollectionError: The file does not exist, is not a pose file, is of another arm, or has a pose that
            `check_poses` refuses.
    """
    if not os.path.lexists(path):
        raise CollectionError(f"{path}: the pose file does not exist. Create it with excite --static or collect teach.")
    content = load_typed_yaml(PoseFile, path, CollectionError, "a pose file")
    if content.arm.lower() != arm.full_name.lower():
        raise CollectionError(f'{path}: arm is "{content.arm}", but the selected arm is {arm.full_name}')
    if not content.poses:
        raise CollectionError(f"{path} has no poses")
    for k, pose in enumerate(content.poses):
        if len(pose) != arm.num_joints:
            raise CollectionError(
                f"{path}, pose {k + 1}: {len(pose)} numbers, but {arm.name} has {arm.num_joints} joints: "
                f"{', '.join(arm.joint_names)}"
            )
    poses = np.array(content.poses, float)
    check_poses(poses, arm, str(path))
    return poses


def check_poses(poses: NDArray[np.float64], arm: Arm, source: str) -> None:
    """Checks that `arm` can reach poses (m, n) and that no pose is repeated. Messages begin with `source`.

    Raises:
        CollectionError: A number is not finite or outside the limits, positions are in degrees or millimetres, or a
            pose is repeated.
    """
    for k, pose in enumerate(poses):
        if not np.all(np.isfinite(pose)):
            raise CollectionError(f"{source}, pose {k + 1}: {pose.tolist()} has a number that is not finite")
    try:
        Recording(q=poses, source=source).check_fits(arm)  # detects degrees and millimetres
    except RecordingError as error:
        raise CollectionError(str(error).replace(", row ", ", pose ")) from error
    for k, pose in enumerate(poses):
        if violations := arm.limit_violations(pose, _ROUNDING):
            raise CollectionError(f"{source}, pose {k + 1}: {'; '.join(violations)} [rad, m] of {arm.name}")
        if (same := same_pose(poses[:k], pose, arm)) is not None:
            raise CollectionError(
                f"{source}, pose {k + 1}: equal to pose {same + 1}; the difference of each joint is less than "
                f"{SAME_POSE[0]:g} rad or {SAME_POSE[1]:g} m"
            )


def same_pose(poses: NDArray[np.float64], pose: NDArray[np.float64], arm: Arm) -> int | None:
    """Returns the index of the first row of `poses` (m, n) that equals `pose` (n,) within `SAME_POSE`, or None."""
    rows = np.flatnonzero(np.all(np.abs(poses - pose) < arm.per_joint(*SAME_POSE), axis=1))
    return int(rows[0]) if len(rows) else None


def pose_environment(path: str | Path) -> Environment:
    """Returns the fixed objects around the arm in a pose file.

    Raises:
        CollectionError: The file is not a pose file.
    """
    return load_typed_yaml(PoseFile, path, CollectionError, "a pose file").environment


def save_poses(poses: NDArray[np.float64], arm: Arm, path: str | Path, environment: Environment | None = None) -> None:
    """Writes poses (m, n) atomically and with full precision.

    Args:
        poses: Poses (m, n) [rad, m].
        arm: Arm of the poses.
        path: Pose file, which is replaced if it exists.
        environment: Fixed objects around the arm. None: those of the existing file.

    Raises:
        CollectionError: See `check_poses`.
        DvrkDrakeError: The file cannot be written.
    """
    check_poses(poses, arm, str(path))
    if environment is None:
        environment = pose_environment(path) if os.path.lexists(path) else Environment()
    with atomic_write(path) as stream:
        stream.write(f"format: {PoseFile.format}\narm: {arm.full_name}\n")
        if environment != Environment():
            yaml.safe_dump({"environment": asdict(environment)}, stream, sort_keys=False)
        stream.write(f"# {', '.join(arm.joint_names)} [rad, m]\nposes:\n")
        stream.writelines(f"- {pose.tolist()}\n" for pose in poses)


def load_poses_if_any(path: str | Path, arm: Arm) -> NDArray[np.float64]:
    """Returns the poses as `load_poses` does, or an array (0, n) if the file does not exist."""
    return load_poses(path, arm) if os.path.lexists(path) else np.empty((0, arm.num_joints))


class CollectionFile:
    """CSV file with one row per finished pose. A row is on the disk when `append` returns.

    Units are rad and N m, or m and N for a prismatic joint. The columns are:

    - q1..qn and tau1..taun: measured positions and efforts, as in every Recording.
    - pose1..posen: requested pose.
    - coordinates, arm: "joint", and `Arm.full_name`.
    - utime: time when the row was written [us since 1970].
    - friction1..frictionn: half of the difference between the efforts of the two approach directions, if each pose is
      approached from both directions.
    """

    def __init__(self, path: str | Path, arm: Arm, both_sides: bool) -> None:
        """Opens the file at `path`, or prepares a new one.

        Args:
            path: Path of a CSV that is created or continued.
            arm: Measured arm.
            both_sides: Whether each pose is measured from both approach directions.

        Raises:
            CollectionError: The file name does not end in .csv, or the file is not a collection of this arm with this
                setting of `both_sides`.
            RecordingError: The file cannot be read.
        """
        self._path, self._arm, self._both_sides = Path(path), arm, both_sides
        if self._path.suffix.lower() != ".csv":
            raise CollectionError(f"{path}: a collection is a table; the file name must end in .csv")
        self._header = [*self._names("q"), *self._names("tau"), *self._names("pose"), "coordinates", "arm", "utime"]
        if both_sides:
            self._header += self._names("friction")
        self._file: GrowingFile | None = None
        self._exists, self._has_header = os.path.lexists(path), False
        self._rows = self._read() if self._exists else []

    def finished(self, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Returns a mask (m,) of the `poses` (m, n) that are already in the file.

        Raises:
            CollectionError: The file contains a pose that is not in `poses`.
        """
        done = np.zeros(len(poses), bool)
        for line, pose in self._rows:
            which = np.all(poses == pose, axis=1)
            if not which.any():
                raise CollectionError(
                    f"{self._path}, line {line}: the requested pose of this row is not in the pose file. Choose "
                    "another output file, or the pose file from which this output was created. New poses can be added "
                    "to that pose file."
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
        """Appends one row to the file, which is created for the first row.

        Args:
            pose: Requested pose (n,).
            q, tau: Measured positions and efforts (n,).
            friction: Half of the difference (n,) between the efforts of the two approach directions, or None if the
                pose is approached from one direction.

        Raises:
            RecordingError: The row cannot be written; the previous rows are complete.
        """
        if self._file is None:
            self._file = GrowingFile(self._path, resume=self._exists, sync=True)
            if not self._has_header:
                self._file.append(csv_line(self._header))
        end = [] if friction is None else friction.tolist()
        stated = "joint", self._arm.full_name, time.time_ns() // 1000
        self._file.append(csv_line([*q.tolist(), *tau.tolist(), *pose.tolist(), *stated, *end]))

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()

    def _names(self, prefix: str) -> list[str]:
        return column_names(prefix, self._arm.num_joints, self._arm)

    def _read(self) -> list[tuple[int, NDArray[np.float64]]]:
        """Returns (line, requested pose) of each complete row."""
        rows = read_rows(self._path)
        if not read_input(self._path, RecordingError).endswith(b"\n"):
            rows = rows[:-1]  # incomplete after a power failure
        if not rows:
            return []
        (_, header), *rows = rows
        self._check_header(header)
        self._has_header = True
        columns = [header.index(name) for name in self._names("pose")]
        found = []
        for line, cells in rows:
            where = f"{self._path}, line {line}"
            if len(cells) != len(header):
                raise RecordingError(f"{where}: the row has {len(cells)} cells, the header has {len(header)}")
            if (name := cells[header.index("arm")]) != self._arm.full_name:
                raise CollectionError(
                    f"{where}: the row is of {name}, not of {self._arm.full_name}. Choose another output file."
                )
            found.append((line, np.array([parse_finite(cells[j], f"{where}: {header[j]}") for j in columns])))
        return found

    def _check_header(self, header: list[str]) -> None:
        if header == self._header:
            return
        if self._names("pose")[0] in header and (self._names("friction")[0] in header) != self._both_sides:
            sides = "one side (--no-both-sides)" if self._both_sides else "both sides (--both-sides)"
            raise CollectionError(f"{self._path} was collected from {sides}. Continue with the same option.")
        raise CollectionError(
            f"{self._path} already exists and is not a collection of {self._arm.name}. Choose another output file."
        )


#: Length of an approach, as a fraction of the range of the joint. Dry friction is elastic at first, so a short approach
#: does not reverse it completely. Random poses have at least a tenth of the range on both sides.
APPROACH = 0.08


def approach_offset(arm: Arm) -> NDArray[np.float64]:
    """Returns the offset (n,) of the pose at which the approach of a static pose begins [rad, m].

    The offset is subtracted for the approach from below and added for the approach from above, see `offset_pose`. The
    offsets of all joints have the same sign, because this reverses the dry friction of actuators that are coupled to
    several joints most completely.
    """
    return np.asarray(APPROACH * (arm.position_upper - arm.position_lower))


def offset_pose(arm: Arm, pose: NDArray[np.float64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns pose + offset (n,), with the offset of each joint reduced so that no limit of `arm` is violated.

    If the reduced offsets still violate a coupled limit, `pose` is returned unchanged.
    """
    A, lower, upper = arm.limit_matrix()
    change = A @ offset
    room = np.where(change > 0, upper - A @ pose, A @ pose - lower)
    share = np.clip(np.divide(room, np.abs(change), out=np.ones_like(room), where=change != 0), 0.0, 1.0)
    joint_share = np.array([share[A[:, j] != 0].min() for j in range(arm.num_joints)])
    point = pose + joint_share * offset
    # If coefficients have both signs, reducing the offset of one joint may violate a coupled limit.
    return pose if arm.limit_violations(point, 1e-9) else point
