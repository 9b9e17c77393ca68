"""Poses to visit, as a YAML file that people may write by hand.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import CollectionError, RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.schema_fault import within
from dvrk_drake.models.typed_yaml import load_typed_yaml
from dvrk_drake.recordings.recording import SAME_POSE, Recording

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
