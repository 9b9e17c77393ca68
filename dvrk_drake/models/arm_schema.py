"""Schemas of `arms/*.yaml`, `mechanisms/*.yaml` and `instruments/*.yaml`, and linear maps; unknown keys are errors."""

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.yaml import yaml_dump

from dvrk_drake.errors import ControllerError
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.immutable import Shared, immutable
from dvrk_drake.models.ranges import RANGE, Range, within
from dvrk_drake.models.typed_yaml import load_typed_yaml


@dataclass(frozen=True, eq=False)
class LinearMap:
    """Immutable affine map y = matrix x + offset of positions, with the corresponding maps of velocities and efforts.

    Attributes:
        matrix: Constant matrix (m, n).
        offset: Constant vector (m,), in the units of y.
    """

    matrix: NDArray[np.float64] = field(metadata=within(-1e4, 1e4))
    offset: NDArray[np.float64] = field(metadata=within(-100.0, 100.0, "rad or m"))

    def __post_init__(self) -> None:
        for name in ("matrix", "offset"):
            object.__setattr__(self, name, immutable(getattr(self, name)))

    def position(self, x: ArrayLike) -> NDArray[np.float64]:
        """Returns y = matrix x + offset for x of shape (n,) or (samples, n)."""
        return np.asarray(x, float) @ self.matrix.T + self.offset

    def velocity(self, x_dot: ArrayLike) -> NDArray[np.float64]:
        """Returns the velocity of y for a velocity `x_dot` of x, of shape (n,) or (samples, n)."""
        return np.asarray(x_dot, float) @ self.matrix.T

    def pull_back_effort(self, effort_y: ArrayLike) -> NDArray[np.float64]:
        """Returns the effort on x that does the same work as `effort_y` on y.

        The effort on x is matrix' effort_y, for `effort_y` of shape (m,) or (samples, m).
        """
        return np.asarray(effort_y, float) @ self.matrix

    @cached_property
    def inverse(self) -> "LinearMap":
        """Returns the map from y to x. Raises numpy.linalg.LinAlgError if the matrix is singular or not square."""
        matrix = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        inverse = LinearMap(matrix, -matrix @ self.offset)
        vars(inverse)["inverse"] = self
        return inverse


#: Accepted position limits of a joint. Two turns in each direction suffice for a joint with stops: the roll joint of an
#: MTM reaches -8.4 rad, and the joints of a UR10e reach 6.3 rad. Joints without stops get one turn in each
#: direction, see `CONTINUOUS`. The ranges do not depend on the arm, because they detect limits in degrees, and in mm:
#: no gantry is longer than 30 m.
ANGLES, TRAVELS = Range(-12.6, 12.6, "rad"), Range(-30.0, 30.0, "m")
#: Accepted differences between the upper and the lower position limit of a joint.
ANGLE_WIDTHS, TRAVEL_WIDTHS = Range(0.01, 25.2, "rad"), Range(0.001, 30.0, "m")
#: Accepted positions of a joint of unknown type. `Arm` checks the limits of a joint with the range of its type.
POSITIONS = within(TRAVELS.low, TRAVELS.high, "rad or m")
#: Largest accepted absolute value of positions, velocities and efforts in inputs and recordings [rad, m, rad/s, m/s, N
#: m, N]. No arm reaches this value in any of these units. Products of smaller numbers with gains remain finite.
IMPLAUSIBLE = 1e6
#: Accepted effort limits of a joint. Examples: 0.023 N m for the roll joint of an MTM, 330 N m for the shoulder of a
#: UR10e, 1e6 N for a cylinder of an excavator.
EFFORTS = Range(0.001, IMPLAUSIBLE, "N m or N")
#: Accepted position limits in files, for both joint types. `Arm` checks the narrower range `ANGLES` or `TRAVELS`.
_POSITIONS = within(-1e4, 1e4, "rad or m")
#: Accepted coefficients between joint and actuator positions. Examples: 0.6 to 1.6 for a dVRK, 32 to 48 for the gears
#: of a TX40.
COUPLINGS = within(0.001, 1000.0, also=(0.0,), either_sign=True)
#: Accepted components of the gravity vector. `Arm` additionally checks the norm of the vector.
GRAVITIES = within(-30.0, 30.0, "m/s^2")
_CUT_OFFS = within(0.1, 1000.0, "Hz")


@dataclass
class CoupledLimit(Shared):
    """Limit lower <= sum of coefficient * joint position <= upper; `name` is used in messages."""

    name: str = ""
    coefficients: dict[str, float] = field(default_factory=dict, metadata=COUPLINGS)
    lower: float = field(default=0.0, metadata=_POSITIONS)
    upper: float = field(default=0.0, metadata=_POSITIONS)


@dataclass
class LoopClosure(Shared):
    """Two SDF frames whose origins coincide at every pose that the linkage permits."""

    frame_a: str = ""
    frame_b: str = ""


@dataclass
class Gains(Shared):
    """Diagonal PID gains per joint: kp [N m/rad], kd [N m s/rad], ki [N m/(rad s)]; N/m, N s/m, N/(m s) if prismatic.

    The ranges in this class apply to all arms. `Arm.gains_fault` checks the narrower ranges of one arm.
    """

    kp: list[float] = field(default_factory=list, metadata=within(1e-5, 1e9, "N m/rad or N/m"))
    kd: list[float] = field(default_factory=list, metadata=within(1e-8, 1e8, "N m s/rad or N s/m", also=(0.0,)))
    ki: list[float] = field(default_factory=list, metadata=within(1e-8, 1e9, "N m/(rad s) or N/(m s)", also=(0.0,)))


@dataclass
class MotionSettings(Shared):
    """Settings for processing a recorded motion. Lists have one element per joint of the mechanism or instrument.

    Attributes:
        acceleration_cut_off: Cut-off frequencies of the low-pass filter for accelerations [Hz].
        effort_delay: Delays of the recorded efforts relative to the positions [s]. A delay is negative if the effort is
            recorded earlier than the position.
        base_may_tilt: True to estimate the direction of gravity from a motion. Used only in a mechanism file.
        known_effects: Mapping from a coordinate of the drive (`Arm.effect_coordinates`) to its known effects besides
            friction: "spring", "cable 1" (sine and cosine with one period per revolution), "cable 2" (two periods),
            "asymmetric friction", "load friction" (in proportion to the effort that the drive transmits), "position
            friction" and "position^2 friction" (in proportion to |x| and x^2).
        presliding_travels: Travels before sliding of the presliding friction elements, as multiples of the standard
            deviation of the position along the coordinate. Gears slide after 0.1 mrad, cables after some mrad. Used
            only in a mechanism file.
        day_deviation: Standard deviations of the changes of the efforts between days, as shares of the RMS effort [1].
            They widen the prediction intervals on another day than that of the recording. 0 if unknown.
    """

    acceleration_cut_off: list[float] = field(default_factory=list, metadata=_CUT_OFFS)
    effort_delay: list[float] = field(default_factory=list, metadata=within(-0.2, 0.2, "s"))
    base_may_tilt: bool = False
    known_effects: dict[str, list[str]] = field(default_factory=dict)
    presliding_travels: list[float] = field(
        default_factory=lambda: [0.0001, 0.001, 0.01, 0.08, 0.3, 1.0], metadata=within(1e-6, 100.0)
    )
    day_deviation: list[float] = field(default_factory=list, metadata=within(0.0, 10.0))


@dataclass
class BoxCorners(Shared):
    """Axis-aligned box in a link frame, given by its lower and upper corners (3,) [m]."""

    lower: list[float] = field(default_factory=list, metadata=within(-50.0, 50.0, "m"))
    upper: list[float] = field(default_factory=list, metadata=within(-50.0, 50.0, "m"))


@dataclass
class BoundingShapes(Shared):
    """Bounds of the mass distribution of the links of one SDF file.

    The bound of a link is the box around its collision shapes, enlarged by `margin` [m] on all sides. The margin is for
    parts without a collision shape, such as covers, screws and cables. `boxes` defines the bounds of links that have no
    collision shapes, or whose collision shapes do not represent their mass distribution. No margin is added to `boxes`.
    """

    margin: float = field(default=0.04, metadata=within(0.0, 1.0, "m"))
    boxes: dict[str, BoxCorners] = field(default_factory=dict)


@dataclass(kw_only=True)
class IdentificationSettings(MotionSettings):
    """Settings for recordings of an arm, and bounds of the mass distribution of the links.

    Attributes:
        effort_cut_off: Cut-off frequency of the low-pass filter for measured and modelled efforts [Hz].
        bounding_shapes: Bounds of the mass distribution of the links, one object per SDF file of the arm; see
            `bounding_boxes`.
    """

    effort_cut_off: float = field(metadata=_CUT_OFFS)
    bounding_shapes: tuple[BoundingShapes, ...]


@dataclass
class ViewSettings(Shared):
    """Parts of an arm that a 3D view shows, besides its links.

    Attributes:
        close_ups: Mapping from the name of a camera position, e.g. "gimbal", to the links that fill its view.
    """

    close_ups: dict[str, list[str]] = field(default_factory=dict)


@dataclass
class Frames(Shared):
    """Frames of the SDF that have a purpose. The frame of a link has the name of the link.

    Attributes:
        hand: Frame at which a hand or a task holds the arm: the handle of a master, or the tool frame of an instrument.
            On ROS topics, poses of the arm are poses of this frame. Default: the link that the last joint moves.
        remote_center: Frame with its origin at the remote centre of motion, or "" if there is none.
        shaft: Frame whose z axis is the axis of a shaft through the remote centre, from there to the tip, and whose
            origin is at the end of the shaft. "" if there is none.
    """

    hand: str = ""
    remote_center: str = ""
    shaft: str = ""


@dataclass
class _Part:
    """Keys of mechanisms and instruments. `joints` are the independent joints, in the order of recordings."""

    format: str = ""
    sdf: str = ""
    joints: list[str] = field(default_factory=list)
    gains: Gains = field(default_factory=Gains)
    motion: MotionSettings = field(default_factory=MotionSettings)
    bounding_shapes: BoundingShapes = field(default_factory=BoundingShapes)
    effects: ArmEffects = field(default_factory=ArmEffects)
    frames: Frames = field(default_factory=Frames)
    view: ViewSettings = field(default_factory=ViewSettings)


@dataclass
class Mechanism(_Part):
    """Schema of `mechanisms/*.yaml`: properties that all arms of one type share.

    `transmission` maps an actuator to the coefficients of its position: actuator position = sum of coefficient * joint
    position. An actuator without an entry has the position of its joint. `effort_cut_off` is the cut-off
    frequency of the low-pass filter for measured and modelled efforts [Hz]. `effects` are the friction, cable and
    sensor effects of the real arm. A simulation includes only those that are named in `simulated_effects`.
    `console_gravity_compensation` states whether the dVRK's controller can compensate the gravity of this arm. It then
    publishes the efforts on the ROS topic gravity_compensation/setpoint_js. `view` are the parts that a 3D view shows.
    `published_gains` are gains of a publication, with which `dvrk-drake simulate tune` compares its gains.
    """

    format: str = "dvrk_drake mechanism 1.0"
    published_gains: Gains = field(default_factory=Gains)
    transmission: dict[str, dict[str, float]] = field(default_factory=dict, metadata=COUPLINGS)
    coupled_limits: list[CoupledLimit] = field(default_factory=list)
    loop_closures: list[LoopClosure] = field(default_factory=list)
    effort_cut_off: float = field(default=10.0, metadata=_CUT_OFFS)
    console_gravity_compensation: bool = False


@dataclass
class Instrument(_Part):
    """Schema of `instruments/*.yaml`: an exchangeable instrument. Its joints follow the joints of the mechanism.

    `joint_from_actuator` is the disc coupling as defined by the dVRK: joint position = sum of coefficient * actuator
    position. `friction_coordinates` are additional coordinates along which friction acts, besides joints and actuators.
    Each name is mapped to the joint coefficients of its coordinate: coordinate = sum of coefficient * joint position.
    `separate_joint` is the joint that the dVRK publishes on separate topics `/<ARM>/<joint>/...`, or "". `frames`
    replaces entries of the mechanism, and `view` adds to those of the mechanism.
    """

    format: str = "dvrk_drake instrument 1.0"
    separate_joint: str = ""
    joint_from_actuator: dict[str, dict[str, float]] = field(default_factory=dict, metadata=COUPLINGS)
    position_limits: dict[str, list[float]] = field(default_factory=dict, metadata=_POSITIONS)
    friction_coordinates: dict[str, dict[str, float]] = field(default_factory=dict, metadata=COUPLINGS)


@dataclass
class ArmDescription(Mechanism):
    """Schema of `arms/*.yaml`.

    `format` is the version of the file and may be omitted.
    `mechanism` and `instrument` are names of files in the folders `mechanisms` and `instruments`, or paths of YAML
    files relative to the folder of the arm file. Keys of a mechanism in this file replace those of the mechanism file.
    Without `mechanism`, only `sdf` is required. `sdf` is the path of a model file relative to the folder of the file
    that states it. `gravity` is the gravity vector in the arm's base frame [m/s^2]. `position_limits` and
    `effort_limits` replace those of the model. `position_offsets` are the positions in the model at the recorded
    positions 0; limits refer to recorded positions.
    """

    format: str = "dvrk_drake arm 1.0"
    name: str = ""
    mechanism: str = ""
    instrument: str = ""
    position_limits: dict[str, list[float]] = field(default_factory=dict, metadata=_POSITIONS)
    effort_limits: dict[str, float] = field(default_factory=dict, metadata={RANGE: EFFORTS})
    position_offsets: dict[str, float] = field(default_factory=dict, metadata=_POSITIONS)
    gravity: list[float] = field(default_factory=lambda: [0.0, 0.0, -9.81], metadata=GRAVITIES)


def load_gains(path: str | Path) -> Gains:
    """Reads a gains file with kp, kd and ki, one number per joint.

    The controller checks whether its arm accepts the gains.

    Raises:
        ControllerError: The file does not exist, is not a gains file, or has a gain outside the range of `Gains`.
    """
    gains = load_typed_yaml(Gains, path, ControllerError, "a gains file")
    for name, values in dataclasses.asdict(gains).items():
        if not values:
            raise ControllerError(
                f"{path}: {name} is missing; a gains file has kp, kd and ki with one number per joint"
            )
    return gains


def save_gains(gains: Gains, path: str | Path, remark: str) -> None:
    """Writes a gains file. Its first line is the comment `remark`, a text of one line.

    Raises:
        DvrkDrakeError: The file cannot be written.
    """
    with atomic_write(path) as stream:
        stream.write(f"# {remark}\n# N m/rad, N m s/rad, N m/(rad s); N and m for a prismatic joint.\n")
        stream.write(yaml_dump({name: list(values) for name, values in vars(gains).items()}))
