"""Defines `Recording`: positions and efforts of a motion or of static poses.

`read_recording` (module `reading`) reads recordings of all formats.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Literal, get_args
from weakref import ref

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.errors import RecordingError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_schema import IMPLAUSIBLE, LinearMap

#: Coordinates of q, qd and tau.
Coordinates = Literal["joint", "actuator"]
#: Coordinates of a file. "wpi": actuator coordinates, except for the roll of a PSM, which is in joint coordinates
#: (motions of WPI; Wang et al. 2019, table of the PSM).
FileCoordinates = Literal["joint", "actuator", "wpi"]

#: Tolerance of the position limits [rad], [m]. A pose that exceeds a limit by more is refused. Joint stops are
#: compliant, so real poses may exceed the limits slightly.
LIMIT_TOLERANCE = 0.2, 0.02
#: Minimum number of rows of a motion, and maximum median sampling interval of a motion [s].
MIN_ROWS, MAX_PERIOD = 100, 0.05
#: Smallest nominal rate of a motion for a dynamic model [Hz], and largest share by which its mean rate may be lower.
#: Real rates deviate from nominal rates, and recorders lose rows.
MIN_RATE, MAX_LOST = 50.0, 0.05
#: RMS joint velocity above which a joint is not at rest [rad/s], [m/s].
REST_SPEED = 0.05, 0.005
#: Interval below which consecutive rows at different positions belong to a motion [s]. An arm needs more time to move
#: to a pose and to rest there for a measurement.
MAX_INTERVAL = 0.5
#: Largest step between two rows of a motion, as a share of the range of a joint, and smallest range of a joint that
#: moves [rad], [m]. Static poses are further apart.
MAX_MOTION_STEP, MIN_RANGE = 0.05, (0.02, 0.002)
#: An interval between two rows of a motion is a gap if it exceeds both values: the first in median intervals, the
#: second in s.
GAP, MIN_GAP = 5.0, MAX_PERIOD
#: Maximum difference of each joint position between samples of the same pose [rad], [m].
SAME_POSE = 0.01, 0.001
#: Values of `--coordinates` with their meaning, for messages.
COORDINATES_HELP = "joint, actuator, or wpi (recordings of WPI: actuator, but joint for the roll of a PSM)"
#: Joints in joint coordinates in a file with "wpi" coordinates.
_WPI_DIRECT_JOINTS = ("roll",)


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
            numbers for a ROS bag, and row or pose numbers for arrays.
        sha256: SHA-256 of the source, or "".
        notes: Notes for the user on damaged and omitted parts of the source, one per line.
        line_label: Name of the numbers in `lines`, for messages: "line", "event", "message", "row" or "pose".
        file_coordinates: Coordinates that the source or the user states: "joint", "actuator" or "wpi". "" if they are
            not stated. The data of a file in the coordinates "wpi" are converted to joint coordinates.
        arm_name: Name of the arm that the source states, or "".
        times_from: Source of t: "column" of a table, "array", "messages" of an arm, or "rate" of the user.

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
    file_coordinates: FileCoordinates | Literal[""] = ""
    arm_name: str = ""
    times_from: Literal["column", "array", "messages", "rate"] = "array"
    # Caches: mapping from a transmission to this recording in the other coordinates, as long as that one is in use, and
    # to the recording from which this one was converted. Strong references in both directions would keep both.
    _converted: dict[LinearMap, ref[Recording]] = field(default_factory=dict, init=False, repr=False)
    _originals: dict[LinearMap, Recording] = field(default_factory=dict, init=False, repr=False)

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
        """Returns whether the rows are samples of a motion.

        These are at least `MIN_ROWS` rows at intervals below `MAX_PERIOD`. Times may decrease, see
        `has_increasing_times`. `motion` determines whether the arm moves.
        """
        t = self.t
        return t is not None and len(t) >= MIN_ROWS and float(np.median(np.abs(np.diff(t)))) < MAX_PERIOD

    @property
    def rest_advice(self) -> str:
        """Advice on how to read the rows as static poses: without times and velocities."""
        names = " t" if self.qd is None else "s t and qd"
        how = {
            "column": f"remove the column{names}",
            "array": f"omit the array{names}",
            "messages": f"write a table with dvrk-drake convert, and remove its column{names}",
            "rate": "omit --rate (rate= in Python)",
        }
        return f"If the arm was at rest in each row, {how[self.times_from]}."

    @property
    def has_increasing_times(self) -> bool:
        """Returns whether the recording has times, and each time is later than the previous one."""
        return self.t is not None and bool(np.all(np.diff(self.t) > 0))

    def motion(self, arm: Arm) -> str:
        """Returns a text with the fastest joint and its speed, e.g. "joint 1 at 0.2 rad/s RMS".

        The text is empty if all joints are at rest, or if the speed is unknown. The speed is computed from qd, or from
        q and t if the rows are less than `MAX_INTERVAL` apart or form a path (`is_path`). Otherwise, the speed between
        poses is unknown.
        """
        if not len(self):
            return ""
        if self.qd is not None:
            qd = self.qd
        elif self.t is None or len(self) < 2 or not self.has_increasing_times:
            return ""
        elif float(np.median(np.diff(self.t))) < MAX_INTERVAL or self.is_path(arm):
            qd = np.diff(self.q, axis=0) / np.diff(self.t)[:, None]
        else:
            return ""
        speed = np.sqrt(np.mean(qd**2, axis=0))
        share = speed / arm.per_joint(*REST_SPEED)
        joint = int(np.argmax(share))
        unit = "m/s" if arm.prismatic[joint] else "rad/s"
        return f"joint {joint + 1} at {speed[joint]:.2g} {unit} RMS" if share[joint] > 1 else ""

    def is_path(self, arm: Arm) -> bool:
        """Returns whether the positions are at least `MIN_ROWS` rows in small steps, as in a motion.

        The steps are at most `MAX_MOTION_STEP` of the range of each joint that moves. Steps over a gap are not used.
        """
        spans = np.ptp(self.q, axis=0)
        moves = spans > arm.per_joint(*MIN_RANGE)
        if len(self) < MIN_ROWS or not np.any(moves):
            return False
        steps = np.abs(np.diff(self.q[:, moves], axis=0))
        if self.t is not None and self.has_increasing_times:
            intervals = np.diff(self.t)
            steps = steps[intervals <= GAP * np.median(intervals)]
        return bool(np.all(steps <= MAX_MOTION_STEP * spans[moves]))

    def select(self, rows: NDArray[np.int_] | NDArray[np.bool_] | slice) -> Recording:
        """Returns the recording with some of its rows: indices, a mask or a slice."""
        return replace(
            self,
            q=self.q[rows],
            tau=None if self.tau is None else self.tau[rows],
            qd=None if self.qd is None else self.qd[rows],
            t=None if self.t is None else self.t[rows],
            lines=None if self.lines is None else self.lines[rows],
        )

    def segments(self) -> list[slice]:
        """Returns the rows of each segment of a motion between gaps of its times, see `GAP`. Poses are one segment."""
        if self.t is None:
            return [slice(0, len(self))]
        intervals = np.diff(self.t)
        typical = float(np.median(intervals)) if len(intervals) else 0.0
        edges = [0, *(np.flatnonzero(intervals > max(GAP * typical, MIN_GAP)) + 1).tolist(), len(self)]
        return [slice(first, last) for first, last in pairwise(edges)]

    @property
    def unmeasured(self) -> NDArray[np.bool_]:
        """Mask (n,) of the channels whose effort is 0 in all rows, so that it was not measured."""
        return ~np.any(self.measured_effort(), axis=0)

    def measured_channels(self, arm: Arm) -> NDArray[np.float64]:
        """Returns the matrix (n, n) that maps the efforts of the actuators to the measured efforts.

        It is the identity if all efforts are measured. Row i is 0 if the effort of actuator i is not known. In a
        recording in joint coordinates, the effort of an actuator depends on the efforts of several joints. If one of
        them was not measured, row i can instead be the effort of joint i, which is a combination of the efforts of the
        actuators.
        """
        unmeasured = self.unmeasured
        if self.coordinates == "actuator" or not np.any(unmeasured):
            return np.diag((~unmeasured).astype(float))
        J = arm.transmission.matrix
        is_unknown = np.any(arm.transmission.inverse.matrix.T[:, unmeasured] != 0, axis=1)
        is_joint = is_unknown & ~unmeasured
        return np.asarray(np.where(is_joint[:, None], J.T, np.diag((~is_unknown).astype(float))))

    def measured_actuators(self, arm: Arm) -> Recording:
        """Returns the recording in actuator coordinates, with efforts of 0 where the effort is not known."""
        channels = self.measured_channels(arm)
        actuators = self.in_actuator_coordinates(arm)
        known = np.all(channels == np.eye(len(channels)), axis=1)
        return actuators if np.all(known) else replace(actuators, tau=actuators.measured_effort() * known)

    def measured_joints(self, arm: Arm) -> NDArray[np.bool_]:
        """Returns the mask (n,) of the joints whose effort is known."""
        if self.coordinates == "joint":
            return ~self.unmeasured
        return ~np.any(arm.transmission.matrix[self.unmeasured] != 0, axis=0)

    def measured_effort(self) -> NDArray[np.float64]:
        """Returns tau (m, n).

        Raises:
            RecordingError: The recording has no efforts.
        """
        if self.tau is None:
            raise RecordingError(
                f"{self.source and f'{self.source}: '}the recording has no efforts; needs columns "
                f"tau1..tau{self.q.shape[1]}, an array tau, or efforts in the messages"
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
        if arm.transmission in self._originals:
            return self._originals[arm.transmission]
        # The same arm with another gravity vector has the same transmission.
        known = self._converted.get(arm.transmission)
        converted = known() if known is not None else None
        if converted is None:
            to_other = arm.transmission if coordinates == "actuator" else arm.transmission.inverse
            converted = self.mapped(to_other, coordinates)
            self._converted[arm.transmission] = ref(converted)
            converted._originals[arm.transmission] = self
        return converted

    def mapped(self, to_other: LinearMap, coordinates: Coordinates) -> Recording:
        """Returns the recording in other coordinates. `to_other` is the map of the positions."""
        return replace(
            self,
            q=to_other.position(self.q),
            qd=None if self.qd is None else to_other.velocity(self.qd),
            tau=None if self.tau is None else to_other.inverse.pull_back_effort(self.tau),
            coordinates=coordinates,
        )

    def __getstate__(self) -> dict[str, object]:
        # Another process converts again, because weak references cannot be sent to it.
        return {**self.__dict__, "_converted": {}}

    def check_fits(self, arm: Arm) -> None:
        """Checks that `arm` can reach the poses.

        Raises:
            RecordingError: The number of joints is wrong, a unit is probably wrong, or a pose is far outside the
                limits.
        """
        self._check_sizes()
        if not len(self):
            raise RecordingError(f"{self.source or 'recording'} has no rows")
        q = self.in_joint_coordinates(arm).q
        excess = np.maximum(arm.position_lower - q, q - arm.position_upper) / arm.per_joint(*LIMIT_TOLERANCE)
        largest, joint = np.unravel_index(np.argmax(excess), excess.shape)
        if excess[largest, joint] <= 1:
            return
        lower, upper = arm.position_lower[joint], arm.position_upper[joint]
        rows = np.flatnonzero(excess[:, joint] > 1)
        message = (
            f"{self.where(int(rows[0]))}: {arm.joint_names[joint]} (q{joint + 1}) = {q[rows[0], joint]:.4g} "
            f"is outside {lower:.4g}..{upper:.4g} {'m' if arm.prismatic[joint] else 'rad'} of {arm.name}"
        )
        message += "." if len(rows) == 1 else f" (first of {len(rows)} rows, furthest {q[largest, joint]:.4g})."
        outside = np.mean(np.any(excess > 1, axis=1))
        shares = np.max(np.abs(q) / np.maximum(-arm.position_lower, arm.position_upper), axis=0)
        revolute = np.max(shares[~arm.prismatic], initial=0.0)
        # With another arm or other coordinates, positions exceed the limits by a factor of 2 or 3. Positions in degrees
        # exceed them by a factor of up to 57.
        if outside > 0.3 and revolute > 4 and np.radians(revolute) <= 1.2:
            message += " Are the positions in degrees instead of rad, or of another arm?"
        elif arm.prismatic[joint] and shares[joint] > 4:
            message += " Are the positions in millimetres or centimetres instead of m?"
        else:
            message += f" Is the arm or the choice of coordinates wrong? Coordinates: {COORDINATES_HELP}."
        if others := self._coordinates_within_limits(arm):
            message += f" All poses are within the limits with --coordinates {' or '.join(others)}."
        elif pairs := self._exchanges_within_limits(arm):
            message += f" All poses are within the limits if columns are exchanged: {', '.join(pairs)}."
        elif self.tau is not None and _is_within(self.tau, arm) and np.all(np.abs(self.q) < arm.effort_limits):
            message += " All rows are within the limits if the positions and the efforts are exchanged."
        raise RecordingError(message)

    def _coordinates_within_limits(self, arm: Arm) -> list[str]:
        """Returns other values of `--coordinates` that move all poses of the file within the limits."""
        if self.coordinates != "joint" or self._originals or self.file_coordinates:
            return []
        transmissions = {"wpi": file_transmission(arm, "wpi"), "actuator": arm.transmission}
        if np.array_equal(transmissions["wpi"].matrix, arm.transmission.matrix):
            del transmissions["wpi"]
        return [
            name
            for name, transmission in transmissions.items()
            if _is_within(transmission.inverse.position(self.q), arm)
        ]

    def _exchanges_within_limits(self, arm: Arm) -> list[str]:
        """Returns pairs of columns, such as "q1 and q4", whose exchange moves all poses within the limits."""
        pairs = []
        for i, j in combinations(range(arm.num_joints), 2):
            order = np.arange(arm.num_joints)
            order[[i, j]] = j, i
            q = replace(self, q=self.q[:, order], qd=None, tau=None).in_joint_coordinates(arm).q
            if _is_within(q, arm):
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


@dataclass(frozen=True, eq=False)
class Setpoints:
    """Commands to an arm in joint coordinates, one row per row of a recording [rad, m, N m, N].

    Attributes:
        q: Commanded positions (m, n), or None.
        tau: Commanded efforts (m, n), or None.
    """

    q: NDArray[np.float64] | None = None
    tau: NDArray[np.float64] | None = None


def file_transmission(arm: Arm, coordinates: FileCoordinates) -> LinearMap:
    """Returns the map from joint coordinates to the coordinates of a file."""
    if coordinates == "actuator":
        return arm.transmission
    if coordinates == "joint":
        return LinearMap(np.eye(arm.num_joints), np.zeros(arm.num_joints))
    J = arm.transmission.matrix.copy()
    for joint in set(_WPI_DIRECT_JOINTS) & set(arm.joint_names):
        row = arm.joint_names.index(joint)
        J[row] = np.eye(arm.num_joints)[row]
    return LinearMap(J, np.zeros(len(J)))


def _is_within(q: NDArray[np.float64], arm: Arm) -> bool:
    """Returns whether all positions (m, n) in joint coordinates are within the limits and their tolerance."""
    tolerance = arm.per_joint(*LIMIT_TOLERANCE)
    return bool(np.all((q >= arm.position_lower - tolerance) & (q <= arm.position_upper + tolerance)))
