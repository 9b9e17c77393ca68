"""Defines `Arm`: joints, limits, linkage and transmission of an arm. `arm_files` loads arms from files."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvrk_drake.errors import ArmError
from dvrk_drake.models.arm_schema import (
    ANGLE_WIDTHS,
    ANGLES,
    COUPLINGS,
    EFFORTS,
    GRAVITIES,
    POSITIONS,
    TRAVEL_WIDTHS,
    TRAVELS,
    CoupledLimit,
    Frames,
    Gains,
    IdentificationSettings,
    LinearMap,
    LoopClosure,
    ViewSettings,
)
from dvrk_drake.models.effects_schema import EFFECT_KINDS, ArmEffects, per_actuator
from dvrk_drake.models.immutable import cached, immutable
from dvrk_drake.models.ranges import RANGE, Range, number_fault

#: Maximum norm of the gravity vector [m/s^2].
MAX_GRAVITY = 30.0
#: Position errors [rad, m] that define the maximum gains. A gain is too large if this error causes the maximum effort
#: of the joint. For kd, the error arises within 0.1 s. For ki, the error lasts for 0.1 s.
_MIN_ERROR = (1e-4, 1e-5)
#: Shares of the effort limit that define the minimum gains. A gain is too small if a position error as large as the
#: range of the joint causes less than this share. For kd, the error arises within 1 s. For ki, the error lasts for 1 s.
_MIN_SHARE = {"kp": 1e-2, "kd": 1e-4, "ki": 1e-4}


@dataclass(frozen=True, eq=False)
class Arm:
    """One robot arm. Arms and all their parts are immutable; `dataclasses.replace` returns a modified arm.

    Vectors have n elements, one per independent joint, in the dVRK's order. Units are rad and N m for revolute joints,
    m and N for prismatic joints.

    Attributes:
        name: Name of the arm in the dVRK, e.g. "MTML".
        source: Argument of `load_arm` for this arm: a name such as "mtml", or the absolute path of its file.
        joint_names: Names of the n independent joints.
        tree_joint_names: Names of all joints of the SDF tree, including the linkage.
        sdf: Package URLs or paths of the SDF files: first the arm, then its instrument if there is one.
        position_lower, position_upper: Position limits (n,) of this arm.
        effort_limits: Limits (n,) of the joint efforts, from the SDF.
        prismatic: Array (n,), True for prismatic joints [m, N], False for revolute joints [rad, N m].
        coupled_limits: Limits on weighted sums of joint positions.
        linkage: Map q_tree = G q + c from the independent joint positions q to the positions of `tree_joint_names`. It
            is read from the `drake:mimic` tags of the SDF.
        transmission: Map a = J q from joint positions q to actuator positions a.
        loop_closures: Pairs of frames whose origins coincide at every pose of the linkage.
        gravity: Gravity vector (3,) in the base frame [m/s^2].
        gains: Default gains of the controller. Without numbers while an arm without stated gains is loaded.
        friction_coordinates: Additional coordinates along which friction acts, besides joints and actuators: mapping
            from the name of a coordinate to a vector (n,), whose dot product with q is the coordinate.
        identification: Settings for recordings of the arm, and bounds of the mass distribution of the links.
        effects: Friction, cable and sensor effects of the real arm. A simulation includes only those that are named in
            `simulated_effects`.
        separate_joint: Name of the joint that the dVRK publishes on separate ROS topics, e.g. "jaw", or "".
        console_gravity_compensation: Whether the dVRK's controller can compensate the gravity of this arm.
        locked_joints: Positions of the joints that are locked [rad, m], which are not among the independent joints; see
            `dvrk_drake.models.locked_joints.lock_joints`.
        frames: Frames of the SDF that have a purpose, e.g. the frame at which a hand holds the arm.
        view: Close-ups for 3D views.
        published_gains: Gains of a publication, for comparisons. Without numbers if there are none.
        position_offsets: Mapping from a joint to the position in the model at the recorded position 0 [rad, m]. Offsets
            are a part of `linkage` and of all limits; see `with_position_offsets`. Joints without an entry have none.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> arm = dvrk.load_arm("mtmr")
        >>> arm.num_joints, arm.joint_names[:3]
        (7, ('outer_yaw', 'shoulder_pitch', 'elbow_pitch'))
        >>> arm.limit_violations([0, 0.5, 0.3, 0, 0, 0, 0])
        ['parallelogram = 0.8 is outside -0.33..0.68']
        >>> arm.sample_poses(2, np.random.default_rng(0)).shape
        (2, 7)
    """

    name: str
    source: str
    joint_names: tuple[str, ...]
    tree_joint_names: tuple[str, ...]
    sdf: tuple[str, ...]
    position_lower: NDArray[np.float64] = field(metadata=POSITIONS)
    position_upper: NDArray[np.float64] = field(metadata=POSITIONS)
    effort_limits: NDArray[np.float64] = field(metadata={RANGE: EFFORTS})
    prismatic: NDArray[np.bool_]
    coupled_limits: tuple[CoupledLimit, ...]
    linkage: LinearMap
    transmission: LinearMap
    loop_closures: tuple[LoopClosure, ...]
    gravity: NDArray[np.float64] = field(metadata=GRAVITIES)
    gains: Gains
    friction_coordinates: dict[str, NDArray[np.float64]] = field(metadata=COUPLINGS)
    identification: IdentificationSettings
    effects: ArmEffects
    separate_joint: str = ""
    console_gravity_compensation: bool = False
    locked_joints: dict[str, float] = field(default_factory=dict, metadata=POSITIONS)
    frames: Frames = field(default_factory=Frames)
    view: ViewSettings = field(default_factory=ViewSettings)
    published_gains: Gains = field(default_factory=Gains)
    position_offsets: dict[str, float] = field(default_factory=dict, metadata=POSITIONS)

    def __post_init__(self) -> None:
        for part in dataclasses.fields(self):
            object.__setattr__(self, part.name, immutable(getattr(self, part.name)))
        if fault := next(filter(None, self._faults()), ""):
            raise ArmError(fault)

    def __repr__(self) -> str:
        locked = f", locked {self.locked_text}" if self.locked_joints else ""
        return f"<Arm {self.name}: {self.source}{locked}>"

    def gains_fault(self, gains: Gains) -> str:
        """Returns a message that names the first invalid gain and its accepted values, or "" if all gains are accepted.

        A gain must be large enough to move its joint. It must be small enough that a position error of the size of
        the sensor resolution does not cause the maximum effort. `_MIN_SHARE` and `_MIN_ERROR` define both limits.
        """
        if fault := _count_fault("gains.", vars(gains), self.joint_names):
            return fault
        if fault := number_fault(gains):
            return f"gains.{fault}"
        for name in ("kp", "kd", "ki"):
            lowest, highest = self.gain_range(name)
            for i, gain in enumerate(getattr(gains, name)):
                allowed = Range(float(lowest[i]), float(highest[i]), also=() if name == "kp" else (0.0,))
                if fault := allowed.fault(f"gains.{name}[{i}]", float(gain)):
                    return f"{fault} for the position range and effort limit of {self.joint_names[i]}"
        return ""

    def gain_range(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the smallest and the largest accepted gains (n,) of one kind: "kp", "kd" or "ki"."""
        rate = {"kp": 1.0, "kd": 10.0, "ki": 0.1}[name]
        lowest = _MIN_SHARE[name] * self.effort_limits / (self.position_upper - self.position_lower)
        return lowest, self.effort_limits / (rate * self.per_joint(*_MIN_ERROR))

    def _faults(self) -> Iterator[str]:
        arrays = ("position_lower", "position_upper", "effort_limits", "prismatic")
        yield _count_fault("", {name: getattr(self, name) for name in arrays}, self.joint_names)
        for i, name in enumerate(self.joint_names):
            limits = float(self.position_lower[i]), float(self.position_upper[i])
            yield _limits_fault(f"position_limits.{name}", *limits, slides=bool(self.prismatic[i]))
            yield EFFORTS.fault(f"effort limit of joint {name}", float(self.effort_limits[i]))
        if any(vars(self.gains).values()):
            yield self.gains_fault(self.gains)
        for limit in self.coupled_limits:
            yield _coupled_limit_fault(self, limit)
        for name, row in self.friction_coordinates.items():
            if not np.any(row):
                yield f"friction_coordinates.{name}: all coefficients are 0; at least one must be nonzero"
        yield number_fault(self)
        checked_gravity(self.gravity)
        if len(self.coupled_limits) > 1 and not _can_meet_limits(*self.limit_matrix()):
            yield "coupled_limits: no pose within position_limits meets all coupled limits; widen the limits"

    @property
    def num_joints(self) -> int:
        """Number of independent joints."""
        return len(self.joint_names)

    @property
    def instrument(self) -> str:
        """Name of the instrument, "" if the arm carries none."""
        return PurePath(self.sdf[1]).stem if len(self.sdf) > 1 else ""

    @property
    def full_name(self) -> str:
        """Name, with the instrument if it is not that of the arm file, e.g. "PSM+CADIERE_FORCEPS_400049"."""
        _, plus, exchanged = self.source.rpartition("+")
        is_exchanged = plus and PurePath(exchanged).stem == self.instrument
        return f"{self.name}+{self.instrument}" if is_exchanged else self.name

    def per_joint(self, revolute: float, prismatic: float) -> NDArray[np.float64]:
        """Returns an array (n,) with the value `revolute` for revolute joints and `prismatic` for prismatic joints."""
        return np.where(self.prismatic, prismatic, revolute)

    @cached_property
    def effect_coordinates(self) -> dict[str, NDArray[np.float64]]:
        """Coordinates along which effects can act: mapping from a name to a row h (n,).

        The coordinate is x = h a for actuator positions a. An effort f along x acts on the actuators as h' f. The names
        are "actuator.<name>", "joint.<name>" and the names in `friction_coordinates`.
        """
        J_inverse = self.transmission.inverse.matrix
        rows = {f"actuator.{name}": unit for name, unit in zip(self.joint_names, np.eye(self.num_joints), strict=True)}
        rows |= {f"joint.{name}": row for name, row in zip(self.joint_names, J_inverse, strict=True)}
        return rows | {name: row @ J_inverse for name, row in self.friction_coordinates.items()}

    def encoder_counts(self) -> NDArray[np.float64]:
        """Returns the size (n,) of one encoder count at each joint [rad, m].

        The size is 0 for an arm without `effects.encoder`.
        """
        resolution = self.effects.encoder.resolution if self.effects.encoder is not None else {}
        return np.abs(self.transmission.inverse.matrix) @ per_actuator(resolution, self.joint_names, 0.0)

    def dry_friction(self) -> NDArray[np.float64]:
        """Returns the maximum dry friction (n,) on each joint [N m, N], computed from the arm's effects."""
        dry = np.zeros(self.num_joints)
        for effect in self.effects.friction:
            if EFFECT_KINDS[effect.kind].role == "dry":
                row = self.effect_coordinates[effect.coordinate] @ self.transmission.matrix
                dry += np.abs(effect.coefficient * row)
        return dry

    def limit_matrix(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Returns A, lower and upper of the limits lower <= A q <= upper. The last rows are the coupled limits."""
        rows = [[limit.coefficients.get(j, 0.0) for j in self.joint_names] for limit in self.coupled_limits]
        A = np.vstack([np.eye(self.num_joints), np.array(rows).reshape(-1, self.num_joints)])
        lower = np.concatenate([self.position_lower, [limit.lower for limit in self.coupled_limits]])
        upper = np.concatenate([self.position_upper, [limit.upper for limit in self.coupled_limits]])
        return A, lower, upper

    def per_limit(self, revolute: float, prismatic: float) -> NDArray[np.float64]:
        """Returns an array with one value per row of `limit_matrix`. Coupled limits have the value `revolute`."""
        return np.append(self.per_joint(revolute, prismatic), np.full(len(self.coupled_limits), revolute))

    def limit_violations(self, q: ArrayLike, tolerance: ArrayLike = 0.0) -> list[str]:
        """Returns messages on the limits that a pose q (n,) violates by more than a tolerance.

        The list is empty if the pose is within all limits.

        Args:
            q: Pose (n,) [rad, m].
            tolerance: Tolerance of all limits, or of each limit as from `per_limit` [rad, m].
        """
        tolerance = np.asarray(tolerance, float)
        A, lower, upper = self.limit_matrix()
        names = [*self.joint_names, *(limit.name for limit in self.coupled_limits)]
        value = A @ np.asarray(q, float)
        bad = np.flatnonzero((value < lower - tolerance) | (value > upper + tolerance))
        return [f"{names[i]} = {value[i]:.4g} is outside {lower[i]:.4g}..{upper[i]:.4g}" for i in bad]

    def sample_poses(self, count: int, generator: np.random.Generator, margin: float = 0.0) -> NDArray[np.float64]:
        """Returns random poses (count, n), uniformly distributed within the joint limits and the coupled limits.

        Args:
            count: Number of poses.
            generator: Random number generator.
            margin: Fraction (0 to 0.5) of each position range that is excluded at each end of the range.

        Raises:
            ArmError: Almost no pose within the joint limits meets the coupled limits.
        """
        A, lower, upper = self.limit_matrix()
        inset = margin * (upper - lower)
        lower, upper = lower + inset, upper - inset
        n = self.num_joints
        poses = np.empty((0, n))
        tries = 0
        while len(poses) < count:
            tries += 1
            if tries > 100 and len(poses) < tries:
                raise ArmError(
                    f"{self.name}: almost no pose within the position limits meets the coupled limits. Check "
                    "coupled_limits in the arm file, or reduce the margin."
                )
            q = generator.uniform(lower[:n], upper[:n], (2 * count + 8, n))
            value = q @ A.T
            poses = np.vstack([poses, q[np.all((value >= lower) & (value <= upper), axis=1)]])
        return poses[:count]

    def with_gravity(self, gravity: Sequence[float]) -> Arm:
        """Returns the same arm with the gravity vector `gravity` (3,) in the base frame [m/s^2].

        Raises:
            ArmError: `gravity` does not have three elements, or its norm exceeds 30 m/s^2.
        """
        return _mounted(self, tuple(checked_gravity(gravity).tolist()))

    def with_mount(self, roll: float, pitch: float = 0.0, yaw: float = 0.0) -> Arm:
        """Returns the same arm with the gravity of a base with this orientation in the world [rad].

        `mounting_pitch` of the dVRK is the roll.

        Example:
            >>> import dvrk_drake as dvrk
            >>> dvrk.load_arm("ecm_si").with_mount(-1.22173).gravity.round(2).tolist()  # 70 degrees down
            [0.0, 9.22, -3.36]
        """
        return self.with_gravity(mount_gravity(roll, pitch, yaw))

    def with_position_offsets(self, offsets: Mapping[str, float]) -> Arm:
        """Returns the same arm with other joint zeros: model position = recorded position + offset.

        Args:
            offsets: Mapping from a joint to its offset [rad, m]. It replaces the present offsets.

        Raises:
            ArmError: A joint is unknown, or a limit is outside the accepted range after the change.
        """
        if unknown := sorted(set(offsets) - set(self.joint_names)):
            known = ", ".join(self.joint_names)
            raise ArmError(f'{self.name}: position_offsets: unknown joint "{unknown[0]}"; allowed: {known}')
        return _with_zeros(self, tuple((name, float(offsets[name])) for name in self.joint_names if offsets.get(name)))

    @property
    def locked_text(self) -> str:
        """Locked joints and their positions [rad, m], e.g. "roll = 0, jaw = 0.5", or "" if there are none."""
        return ", ".join(f"{name} = {x:g}" for name, x in self.locked_joints.items())

    def refuse_locked_joints(self, use: str) -> None:
        """Raises ArmError if the arm has locked joints.

        Args:
            use: User of the arm that requires all joints, for the message, e.g. "a controller".
        """
        if self.locked_joints:
            raise ArmError(
                f"{self.name} has locked joints ({self.locked_text}), but {use} requires all joints; use a model that "
                "was identified from a recording of all joints"
            )


@cached
def _mounted(arm: Arm, gravity: tuple[float, ...]) -> Arm:
    """Returns the arm with another gravity vector. Calls with equal arguments return the same Arm object."""
    if np.allclose(arm.gravity, gravity, rtol=0, atol=1e-12):
        return arm
    return dataclasses.replace(arm, gravity=np.array(gravity))


def _coupled_limit_fault(arm: Arm, limit: CoupledLimit) -> str:
    """Returns a message on the first fault of a coupled limit, with the accepted values, or "" if there is none."""
    key = f"coupled_limits.{limit.name}"
    row = np.array([limit.coefficients.get(name, 0.0) for name in arm.joint_names])
    if not np.any(row):
        return f"{key}: all coefficients are 0; allowed: at least one other value"
    if fault := number_fault(limit):
        return f"{key}.{fault}"
    if fault := _limits_fault(key, limit.lower, limit.upper, slides=bool(np.all(arm.prismatic[row != 0]))):
        return fault
    lowest, highest = np.sort(row * [arm.position_lower, arm.position_upper], axis=0).sum(axis=1)
    if highest < limit.lower or lowest > limit.upper:
        return (
            f"{key}: no pose within position_limits meets {limit.lower:g}..{limit.upper:g}; "
            f"allowed: limits that overlap {lowest:.4g}..{highest:.4g}"
        )
    return ""


def _limits_fault(key: str, lower: float, upper: float, slides: bool) -> str:
    """Returns a message on the first fault of a lower and an upper position limit, or "" if there is none."""
    positions, widths = (TRAVELS, TRAVEL_WIDTHS) if slides else (ANGLES, ANGLE_WIDTHS)
    if fault := positions.fault(f"{key}[0]", lower) or positions.fault(f"{key}[1]", upper):
        return fault
    if not lower < upper:
        return f"{key} is [{lower:g}, {upper:g}]; allowed: [lower, upper] with lower < upper"
    return widths.fault(f"{key}: upper - lower", upper - lower)


def _can_meet_limits(A: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]) -> bool:
    """Returns whether at least one pose q meets lower <= A q <= upper. The first rows of A are the unit matrix."""
    from scipy.optimize import linprog  # slow import; few arms have two coupled limits

    n = A.shape[1]
    bounds = np.column_stack([lower[:n], upper[:n]])
    inequalities = np.vstack([A[n:], -A[n:]]), np.concatenate([upper[n:], -lower[n:]])
    return bool(linprog(np.zeros(n), *inequalities, bounds=bounds).success)


def _count_fault(key: str, values: Mapping[str, Sequence[float] | NDArray], joints: Sequence[str]) -> str:
    for name, numbers in values.items():
        if np.shape(numbers) != (len(joints),):
            count = f"{np.size(numbers)} number{'s' * (np.size(numbers) != 1)}"
            return f"{key}{name} has {count}; allowed: {len(joints)}, one per joint: {', '.join(joints)}"
    return ""


@cached
def _with_zeros(arm: Arm, offsets: tuple[tuple[str, float], ...]) -> Arm:
    """Returns the arm with other joint zeros. Calls with equal arguments return the same Arm object."""
    stated = dict(offsets)
    change = np.array([stated.get(name, 0.0) - arm.position_offsets.get(name, 0.0) for name in arm.joint_names])
    if not np.any(change):
        return arm
    A, _, _ = arm.limit_matrix()
    of_limits = (A @ change)[arm.num_joints :]
    return dataclasses.replace(
        arm,
        position_lower=arm.position_lower - change,
        position_upper=arm.position_upper - change,
        coupled_limits=tuple(
            dataclasses.replace(limit, lower=limit.lower - x, upper=limit.upper - x)
            for limit, x in zip(arm.coupled_limits, of_limits, strict=True)
        ),
        linkage=LinearMap(arm.linkage.matrix, arm.linkage.offset + arm.linkage.matrix @ change),
        position_offsets=stated,
    )


def checked_gravity(gravity: ArrayLike) -> NDArray[np.float64]:
    """Returns a gravity vector (3,) [m/s^2]. Raises ArmError if it has another shape, or its norm is too large."""
    vector = np.asarray(gravity, float)
    if vector.shape != (3,) or not np.linalg.norm(vector) <= MAX_GRAVITY:
        numbers = ", ".join(f"{x:g}" for x in vector.ravel())
        raise ArmError(f"gravity ({numbers}) must be a vector of three numbers with a norm up to {MAX_GRAVITY:g} m/s^2")
    return vector


#: Acceleration of gravity [m/s^2], as in the controller of the dVRK.
GRAVITY = 9.81


def mount_gravity(roll: float, pitch: float = 0.0, yaw: float = 0.0) -> tuple[float, float, float]:
    """Returns the gravity vector (3,) in the frame of a base with an orientation in the world [m/s^2].

    Args:
        roll: Angle about the x axis [rad]. `mounting_pitch` in the configuration of an arm of the dVRK is this angle.
        pitch: Angle about the y axis [rad].
        yaw: Angle about the z axis of the world [rad], which has no effect.
    """
    # The negative third row of the rotation matrix Rz(yaw) Ry(pitch) Rx(roll).
    horizontal = math.cos(pitch)
    return (
        GRAVITY * math.sin(pitch),
        -GRAVITY * horizontal * math.sin(roll),
        -GRAVITY * horizontal * math.cos(roll),
    )


#: Largest gain of a soft wall, divided by the gain of the position controller. Larger gains cause chatter at a period
#: of 1 ms.
_WALL_GAIN = 4.0


class SoftWalls(NamedTuple):
    """Soft walls before the position limits lower <= A q <= upper, see `Arm.limit_matrix`.

    Attributes:
        effort: Effort (k,) along A q that cancels the full motor effort of each joint of the limit.
        look_ahead: Times T (k,) [s]. A wall acts on A q + T A v.
        width: Smallest widths (k,) of the walls in the unit of A q, limited by the gain of the wall.
    """

    effort: NDArray[np.float64]
    look_ahead: NDArray[np.float64]
    width: NDArray[np.float64]

    @classmethod
    def of(cls, arm: Arm) -> SoftWalls:
        """Returns the walls of an arm."""
        A, _, _ = arm.limit_matrix()
        kp, kd = np.array(arm.gains.kp), np.array(arm.gains.kd)
        look_ahead = np.array([max((kd / kp)[row != 0]) for row in A])
        return cls(_wall_effort(arm), look_ahead, (wall_stiffness(arm) / kp).max(axis=1))


def wall_stiffness(arm: Arm) -> NDArray[np.float64]:
    """Returns the widths of the walls (k, n) times the gain kp of each joint, which do not depend on the gains."""
    A, _, _ = arm.limit_matrix()
    return 2 * _wall_effort(arm)[:, None] * A**2 / _WALL_GAIN


def _wall_effort(arm: Arm) -> NDArray[np.float64]:
    A, _, _ = arm.limit_matrix()
    limits = np.array(arm.effort_limits)
    return np.array([max(limits[row != 0] / np.abs(row[row != 0])) for row in A])
