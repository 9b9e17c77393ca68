"""Defines `Recording`: positions and efforts of a motion or of static poses.

A recording is read from a CSV, a ROS bag or an LCM log, and written to a CSV.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import IMPLAUSIBLE
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.linear_map import LinearMap
from dvrk_drake.models.locked_joints import lock_hint
from dvrk_drake.progress import Progress, step_progress
from dvrk_drake.recordings.csv_rows import CsvReader, is_number, parse_finite, parse_or_nan, skipped_note
from dvrk_drake.recordings.lcm_log_reader import is_lcm_log, read_status_log
from dvrk_drake.recordings.ros_bag import is_ros_bag, read_joint_states

Coordinates = Literal["joint", "actuator"]

#: Tolerance of the position limits [rad], [m]. A pose that exceeds a limit by more is refused. Joint stops are
#: compliant, so real poses may exceed the limits slightly.
LIMIT_TOLERANCE = 0.2, 0.02
#: Maximum number of rows of a CSV, i.e. 15 min at 1 kHz. For so many rows, `check` needs 1.5 GB of memory.
MAX_COUNT = 900_000
#: Minimum number of rows of a motion, and maximum median sampling interval of a motion [s].
MIN_ROWS, MAX_PERIOD = 100, 0.05
#: RMS joint velocity above which a joint is not at rest [rad/s], [m/s].
REST_SPEED = 0.05, 0.005
#: Maximum difference of each joint position between samples of the same pose [rad], [m].
SAME_POSE = 0.01, 0.001


@dataclass(frozen=True, eq=False)
class Recording:
    """Positions and efforts of an arm, one row per sample or pose [rad, rad/s, N m, s; m, m/s, N if prismatic].

    Do not modify the arrays in place, because conversions are cached. Create a new object with `dataclasses.replace`.

    Attributes:
        q: Positions (m, n).
        tau: Efforts (m, n) applied by the motors, or None.
        qd: Velocities (m, n), or None.
        t: Times (m,) [s], or None for static poses.
        coordinates: Coordinates of q, qd and tau: "joint" or "actuator".
        source: Source of the data, for messages.
        lines: Line number (m,) of each row in the source, or None. They are event numbers for an LCM log, message
            numbers for a ROS bag, and pose numbers for a MATLAB array.
        sha256: SHA-256 of the source, or "".
        notes: Notes for the user on damaged and omitted parts of the source, one per line.
        line_label: Name of the numbers in `lines`, for messages: "line", "event", "message" or "pose".

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> poses = dvrk.Recording(q=np.zeros((8, 7)), tau=np.ones((8, 7)), coordinates="actuator")
        >>> joints = poses.in_joint_coordinates(dvrk.load_arm("mtmr"))
        >>> joints.tau[0].round(2).tolist()  # tau_joint = J' tau_actuator
        [1.0, 2.0, 1.67, 1.0, 1.0, 1.0, 1.0]
    """

    q: NDArray[np.float64]
    tau: NDArray[np.float64] | None = None
    qd: NDArray[np.float64] | None = None
    t: NDArray[np.float64] | None = None
    coordinates: Coordinates = "joint"
    source: str = ""
    lines: NDArray[np.int_] | None = None
    sha256: str = ""
    notes: tuple[str, ...] = ()
    line_label: str = "line"
    # Cache: mapping from a transmission to this recording in the other coordinates.
    _converted: dict[LinearMap, Recording] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        where = self.source or "recording"
        if self.coordinates not in get_args(Coordinates):
            raise RecordingError(f'{where}: coordinates is "{self.coordinates}"; allowed: joint, actuator')
        for name in ("q", "qd", "tau", "t"):
            if (values := getattr(self, name)) is not None:
                object.__setattr__(self, name, np.asarray(values, float))
        if self.q.ndim != 2:
            raise RecordingError(f"{where}: q has shape {self.q.shape}; allowed: (rows, joints)")
        for name, shape in (("qd", self.q.shape), ("tau", self.q.shape), ("t", self.q.shape[:1])):
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise RecordingError(f"{where}: {name} has shape {values.shape}, but q has {self.q.shape}")

    def __repr__(self) -> str:
        rows = f"{len(self)} rows, {self.q.shape[1]} joints, {self.coordinates} coordinates"
        return f"<Recording {self.source or 'without a file'}: {rows}>"

    def __len__(self) -> int:
        return len(self.q)

    def where(self, row: int) -> str:
        """Returns the source and the line of a row, e.g. "poses.csv, line 2", or the row number if `lines` is None."""
        source = self.source or "recording"
        return f"{source}, row {row + 1}" if self.lines is None else f"{source}, {self.line_label} {self.lines[row]}"

    @property
    def is_motion(self) -> bool:
        """Returns whether the rows are samples of a motion: at least `MIN_ROWS` rows at intervals below `MAX_PERIOD`.

        Times may decrease, see `has_increasing_times`. `motion` determines whether the arm moves.
        """
        t = self.t
        return t is not None and len(t) >= MIN_ROWS and float(np.median(np.abs(np.diff(t)))) < MAX_PERIOD

    @property
    def has_increasing_times(self) -> bool:
        """Returns whether the recording has times, and each time is later than the previous one."""
        return self.t is not None and bool(np.all(np.diff(self.t) > 0))

    def motion(self, arm: Arm) -> str:
        """Returns a text with the fastest joint and its speed, e.g. "joint 1 at 0.2 rad/s RMS".

        The text is empty if all joints are at rest, or if the speed is unknown. The speed is computed from qd, or from
        q and t if samples are less than 0.1 s apart. At longer intervals the speed between poses is unknown.
        """
        if self.qd is not None:
            qd = self.qd
        elif self.t is not None and len(self) > 1 and self.has_increasing_times and np.median(np.diff(self.t)) < 0.1:
            qd = np.diff(self.q, axis=0) / np.diff(self.t)[:, None]
        else:
            return ""
        speed = np.sqrt(np.mean(qd**2, axis=0))
        share = speed / arm.per_joint(*REST_SPEED)
        joint = int(np.argmax(share))
        unit = "m/s" if arm.prismatic[joint] else "rad/s"
        return f"joint {joint + 1} at {speed[joint]:.2g} {unit} RMS" if share[joint] > 1 else ""

    def measured_effort(self) -> NDArray[np.float64]:
        """Returns tau (m, n).

        Raises:
            RecordingError: The recording has no efforts.
        """
        if self.tau is None:
            raise RecordingError(
                f"{self.source or 'recording'} has no efforts; needs columns tau1..tau{self.q.shape[1]}"
            )
        return self.tau

    def in_joint_coordinates(self, arm: Arm) -> Recording:
        """Returns the same recording with q, qd and tau in joint coordinates of the arm.

        Raises:
            RecordingError: The number of joints is wrong.
        """
        return self._in_coordinates("joint", arm)

    def in_actuator_coordinates(self, arm: Arm) -> Recording:
        """Returns the same recording with q, qd and tau in actuator coordinates of the arm.

        Raises:
            RecordingError: The number of joints is wrong.
        """
        return self._in_coordinates("actuator", arm)

    def _in_coordinates(self, coordinates: Coordinates, arm: Arm) -> Recording:
        self._check_joint_count(arm)
        if self.coordinates == coordinates:
            return self
        # The same arm with another gravity vector has the same transmission.
        if arm.transmission not in self._converted:
            to_other = arm.transmission if coordinates == "actuator" else arm.transmission.inverse
            converted = self._converted[arm.transmission] = replace(
                self,
                q=to_other.position(self.q),
                qd=None if self.qd is None else to_other.velocity(self.qd),
                tau=None if self.tau is None else to_other.inverse.pull_back_effort(self.tau),
                coordinates=coordinates,
            )
            converted._converted[arm.transmission] = self
        return self._converted[arm.transmission]

    def check_fits(self, arm: Arm) -> None:
        """Checks that `arm` can reach the poses.

        Raises:
            RecordingError: The number of joints is wrong, a unit is probably wrong, or a pose is far outside the
                limits.
        """
        self._check_sizes()
        q = self.in_joint_coordinates(arm).q
        excess = np.maximum(arm.position_lower - q, q - arm.position_upper) / arm.per_joint(*LIMIT_TOLERANCE)
        row, joint = np.unravel_index(np.argmax(excess), excess.shape)
        if excess[row, joint] <= 1:
            return
        lower, upper = arm.position_lower[joint], arm.position_upper[joint]
        message = (
            f"{self.where(int(row))}: {arm.joint_names[joint]} (q{joint + 1}) = {q[row, joint]:.4g} "
            f"is outside {lower:.4g}..{upper:.4g} {'m' if arm.prismatic[joint] else 'rad'} of {arm.name}."
        )
        outside = np.mean(np.any(excess > 1, axis=1))
        shares = np.max(np.abs(q) / np.maximum(-arm.position_lower, arm.position_upper), axis=0)
        revolute = np.max(shares[~arm.prismatic])
        # With another arm or other coordinates, positions exceed the limits by a factor of 2 or 3. Positions in degrees
        # exceed them by a factor of up to 57.
        if outside > 0.3 and revolute > 4 and np.radians(revolute) <= 1.2:
            message += " Are the positions in degrees instead of rad, or of another arm?"
        elif arm.prismatic[joint] and shares[joint] > 4:
            message += " Are the positions in millimetres or centimetres instead of m?"
        else:
            message += " Is the arm or the choice of coordinates (joint or actuator) wrong?"
        if pairs := self._exchanges_within_limits(arm):
            message += f" All poses are within the limits if columns are exchanged: {', '.join(pairs)}."
        raise RecordingError(message)

    def _exchanges_within_limits(self, arm: Arm) -> list[str]:
        """Returns pairs of columns, such as "q1 and q4", whose exchange moves all poses within the limits."""
        pairs, tolerance = [], arm.per_joint(*LIMIT_TOLERANCE)
        for i, j in combinations(range(arm.num_joints), 2):
            order = np.arange(arm.num_joints)
            order[[i, j]] = j, i
            q = replace(self, q=self.q[:, order], qd=None, tau=None).in_joint_coordinates(arm).q
            if np.all((q >= arm.position_lower - tolerance) & (q <= arm.position_upper + tolerance)):
                pairs.append(f"q{i + 1} and q{j + 1}")
        return pairs

    def _check_sizes(self) -> None:
        for name, values in (("q", self.q), ("qd", self.qd), ("tau", self.tau)):
            if values is None or np.all(plausible := np.abs(values) <= IMPLAUSIBLE):
                continue
            row, joint = np.argwhere(~plausible)[0]
            raise RecordingError(
                f"{self.where(int(row))}: {name}{joint + 1} = {values[row, joint]:g} is not plausible; "
                f"allowed: absolute values up to {IMPLAUSIBLE:g}"
            )

    def _check_joint_count(self, arm: Arm) -> None:
        if self.q.shape[1] != arm.num_joints:
            source = self.source or "recording"
            raise RecordingError(
                f"{source} has {self.q.shape[1]} joints, but {arm.name} has {arm.num_joints}: "
                f"{', '.join(arm.joint_names)}"
            )


def read_recording(
    path: str | Path,
    arm: Arm | None = None,
    coordinates: Coordinates = "joint",
    *,
    topic: str | None = None,
    skip_invalid: bool = False,
    progress: Progress | None = None,
) -> Recording:
    """Reads a CSV, a ROS bag, or an LCM log with the DVRK_STATUS messages of an arm; the content selects the format.

    A CSV has a header with q1..qn and optionally t, qd1..qdn and tau1..taun, in any order. Other columns are ignored.
    For the content of a log, see `read_status_log`.

    Args:
        path: Path of the CSV, log or bag.
        arm: Arm that defines the number and the names of the joints. From a log or a bag, only the measurements of this
            arm are read. If None, a CSV must have 7 joints, and a log must have statuses of only one arm.
        coordinates: Coordinates of q, qd and tau in a CSV. Logs and bags contain joint coordinates.
        topic: JointState topic of a bag, or its namespace; see `read_joint_states`.
        skip_invalid: Whether to omit rows and messages that contain an empty cell, a NaN or an infinity, and to list
            them in `notes`. If False, a file with such rows is refused.
        progress: Callback that receives the name of the step ("reading") and the completed fraction (0 to 1).

    Returns:
        Recording with SHA-256 and line numbers. Its attribute `notes` lists the omitted rows of a CSV, or counts the
        omitted messages of a log.

    Raises:
        RecordingError: The file cannot be read as a recording. The message names the file, line and column.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("mtmr")
        >>> dvrk.write_recording(dvrk.Recording(q=np.zeros((8, 7)), tau=np.ones((8, 7))), "poses.csv")
        >>> recording = dvrk.read_recording("poses.csv", arm)
        >>> len(recording), recording.coordinates, recording.where(0)
        (8, 'joint', 'poses.csv, line 2')
    """
    if coordinates not in get_args(Coordinates):
        raise RecordingError(f'unknown coordinates "{coordinates}"; allowed: {", ".join(get_args(Coordinates))}')
    path = Path(path)
    if is_lcm_log(path):
        if coordinates != "joint":
            raise RecordingError(f"{path}: an LCM log is in joint coordinates, not in {coordinates} coordinates")
        _refuse_topic(path, topic)
        if arm is not None and arm.locked_joints:
            raise RecordingError(f"{path}: an LCM log contains all joints of {arm.name}, so --locked is not accepted")
        log = read_status_log(path, arm)
        return Recording(log.q, log.tau, log.qd, log.t, "joint", str(path), log.events, log.sha256, log.notes, "event")
    share = step_progress(progress, "reading")
    if is_ros_bag(path):
        if coordinates != "joint":
            raise RecordingError(f"{path}: a ROS bag is in joint coordinates, not in {coordinates} coordinates")
        if arm is None:
            raise RecordingError(f"{path}: a ROS bag needs the arm whose joint states are read (arm= in Python)")
        bag = read_joint_states(path, arm, topic, skip_invalid=skip_invalid, progress=share)
        return Recording(
            bag.q, bag.tau, bag.qd, bag.t, "joint", str(path), bag.messages, bag.sha256, bag.notes, "message"
        )
    _refuse_topic(path, topic)
    return _read_csv(path, arm, coordinates, share, skip_invalid)


def _refuse_topic(path: Path, topic: str | None) -> None:
    if topic is not None:
        raise RecordingError(f"{path}: --topic does not apply, because this file is not a ROS bag")


def _read_csv(
    path: Path,
    arm: Arm | None,
    coordinates: Coordinates,
    progress: Callable[[float], object],
    skip_invalid: bool,
) -> Recording:
    num_joints = arm.num_joints if arm else 7
    with CsvReader(path, progress) as reader:
        header_line, cells = next(iter(reader), (0, []))
        if not cells:
            raise RecordingError(f"{path} is empty; needs a header with {_expected_columns(num_joints)}")
        header = [cell.strip() for cell in cells]
        blocks = _columns_of_blocks(f"{path}, line {header_line}", header, arm, num_joints)
        values, lines, skipped = _read_numbers(path, reader, header, blocks, skip_invalid)
        sha256 = reader.sha256()
    if not lines:
        rows = "no row of finite numbers" if skipped else "a header but no rows"
        raise RecordingError(f"{path} has {rows}")
    q, qd, tau, t = (
        np.frombuffer(values[prefix]).reshape(len(lines), -1) if prefix in values else None
        for prefix in ("q", "qd", "tau", "t")
    )
    assert q is not None
    times = None if t is None else t[:, 0]
    notes = (skipped_note(np.array(skipped), len(lines) + len(skipped)),) if skipped else ()
    return Recording(q, tau, qd, times, coordinates, str(path), np.frombuffer(lines, np.int64), sha256, notes)


def _columns_of_blocks(where: str, header: list[str], arm: Arm | None, num_joints: int) -> dict[str, list[int]]:
    """Returns a mapping from a prefix (q, qd, tau, t) to its columns in the header."""
    if all(is_number(cell) for cell in header):
        raise RecordingError(
            f"{where}: the header is missing. The first line must contain the column names "
            f"{_expected_columns(num_joints)}. dvrk-drake convert reads public recordings without a header."
        )
    if duplicate := next((name for name, count in Counter(header).items() if name and count > 1), ""):
        raise RecordingError(f"{where}: column {duplicate[:30]} occurs twice")
    blocks = {}
    for prefix, needed in (("q", True), ("qd", False), ("tau", False)):
        names = column_names(prefix, num_joints)
        missing = [name for name in names if name not in header]
        if len(missing) == num_joints and not needed:
            continue
        if missing:
            recorded = num_joints - len(missing)
            hint = lock_hint(arm, recorded) if arm and prefix == "q" and missing == names[recorded:] else ""
            raise RecordingError(
                f"{where}: missing column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
                f"needs {_expected_columns(num_joints)}{_joint_list(arm)}{hint and f'. {hint}'}"
            )
        if f"{prefix}{num_joints + 1}" in header:
            raise RecordingError(
                f"{where}: unexpected column {prefix}{num_joints + 1}; "
                f"the arm has {num_joints} joints{_joint_list(arm)}"
            )
        blocks[prefix] = [header.index(name) for name in names]
    if "t" in header:
        blocks["t"] = [header.index("t")]
    return blocks


def _read_numbers(
    path: Path, reader: CsvReader, header: list[str], blocks: dict[str, list[int]], skip_invalid: bool
) -> tuple[dict[str, array], array, list[int]]:
    """Returns the numbers of each prefix row by row, the line of each row, and the lines of skipped rows."""
    skipped: list[int] = []
    values, lines = {prefix: array("d") for prefix in blocks}, array("q")
    parts = [(values[prefix], columns) for prefix, columns in blocks.items()]
    width = len(header)
    for line, cells in reader:
        if len(cells) != width:
            raise RecordingError(f"{path}, line {line}: the row has {len(cells)} cells, the header has {width}")
        if len(lines) == MAX_COUNT:
            raise RecordingError(f"{path}, line {line}: the file has more than {MAX_COUNT} rows. Split the recording.")
        if skip_invalid and not all(
            math.isfinite(parse_or_nan(cells[column].strip(), f"{path}, line {line}: {header[column]}"))
            for _, columns in parts
            for column in columns
        ):
            skipped.append(line)
            continue
        lines.append(line)
        for part, columns in parts:
            try:
                numbers = [float(cells[column]) for column in columns]
                valid = math.isfinite(sum(numbers)) and not reader.has_underscore
            except ValueError:
                valid = False
            if not valid:
                numbers = [
                    parse_finite(cells[column].strip(), f"{path}, line {line}: {header[column]}") for column in columns
                ]
            part.extend(numbers)
    return values, lines, skipped


def column_names(prefix: str, num_joints: int) -> list[str]:
    """Returns the column names of q, qd, tau, or t in a CSV."""
    return ["t"] if prefix == "t" else [f"{prefix}{i + 1}" for i in range(num_joints)]


def write_recording(recording: Recording, path: str | Path) -> None:
    """Writes a CSV for `read_recording`, atomically and with full precision.

    Args:
        recording: Recording in the coordinates to write. A CSV does not state the coordinates.
        path: Path of the file; an existing file is replaced.

    Raises:
        DvrkDrakeError: The folder does not exist or cannot be written.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> dvrk.write_recording(dvrk.Recording(q=np.zeros((8, 7)), t=np.arange(8.0)), "positions.csv")
        >>> open("positions.csv").readline().rstrip()
        't,q1,q2,q3,q4,q5,q6,q7'
    """
    columns, header = [], []
    for prefix, block in (
        ("t", recording.t),
        ("q", recording.q),
        ("qd", recording.qd),
        ("tau", recording.tau),
    ):
        if block is not None:
            columns.append(block.reshape(len(recording), -1))
            header += column_names(prefix, recording.q.shape[1])
    write_csv(path, header, np.hstack(columns))


def write_csv(path: str | Path, header: list[str], values: NDArray[np.float64]) -> None:
    """Writes a table of numbers atomically and with full precision.

    Raises:
        DvrkDrakeError: The folder does not exist or cannot be written.
    """
    with atomic_write(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([repr(float(x)) for x in row] for row in values)


def _joint_list(arm: Arm | None) -> str:
    return f"; joints of {arm.name}: {', '.join(arm.joint_names)}" if arm else ""


def _expected_columns(num_joints: int) -> str:
    return f"q1..q{num_joints} and tau1..tau{num_joints} (t and qd1..qd{num_joints} optional)"
