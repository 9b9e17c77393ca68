"""Schemas of `arms/*.yaml`, `mechanisms/*.yaml` and `instruments/*.yaml`, for yaml_load_typed: a typo is an error."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

from pydrake.common.yaml import yaml_dump

from dvrk_drake.errors import ControllerError
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.schema_fault import Range, within
from dvrk_drake.models.typed_yaml import load_typed_yaml

#: Position limits of a joint; an MTM's roll turns to -8.4 rad, that of a UR10e to 6.3 rad.
ANGLES, TRAVELS = Range(-12.6, 12.6, "rad"), Range(-2.0, 2.0, "m")
#: How far apart the two limits are.
ANGLE_WIDTHS, TRAVEL_WIDTHS = Range(0.01, 25.2, "rad"), Range(0.001, 2.0, "m")
#: Efforts of a joint: 0.023 N m at an MTM's roll, 330 N m at the shoulder of a UR10e.
EFFORTS = Range(0.001, 2000.0, "N m or N")
#: Positions of which the joint's kind is not known yet: the arm checks them with `ANGLES` or `TRAVELS`.
_POSITIONS = within(-1e4, 1e4, "rad or m")
#: Of one joint or actuator in the position of another: 0.6..1.6 on a dVRK, 32..48 with the gears of a TX40.
COUPLINGS = within(0.001, 1000.0, also=(0.0,), either_sign=True)
#: No position, speed or effort of an arm has this size, in whatever unit it may be by mistake [rad, m, rad/s, m/s, N m,
#: N]; and products of smaller numbers with gains stay finite. Inputs and recordings beyond it are refused.
IMPLAUSIBLE = 1e6
#: 9.81 m/s^2 in any direction; `Arm` checks the length of the vector.
GRAVITIES = within(-30.0, 30.0, "m/s^2")
_CUT_OFFS = within(0.1, 1000.0, "Hz")


@dataclass
class CoupledLimit:
    """lower <= sum of coefficient * joint position <= upper; `name` is what messages call it."""

    name: str = ""
    coefficients: dict[str, float] = field(default_factory=dict, metadata=COUPLINGS)
    lower: float = field(default=0.0, metadata=_POSITIONS)
    upper: float = field(default=0.0, metadata=_POSITIONS)


@dataclass
class LoopClosure:
    """Two frames of the SDF whose origins coincide at every pose that the linkage allows."""

    frame_a: str = ""
    frame_b: str = ""


@dataclass
class Gains:
    """Diagonal PID gains per joint: kp [N m/rad], kd [N m s/rad], ki [N m/(rad s)]; N and m on a prismatic joint.

    The ranges here are of any arm; `Arm.gains_fault` has those of one arm.
    """

    kp: list[float] = field(default_factory=list, metadata=within(1e-5, 1e7, "N m/rad or N/m"))
    kd: list[float] = field(default_factory=list, metadata=within(1e-8, 1e6, "N m s/rad or N s/m", also=(0.0,)))
    ki: list[float] = field(default_factory=list, metadata=within(1e-8, 1e8, "N m/(rad s) or N/(m s)", also=(0.0,)))


@dataclass
class MotionSettings:
    """How the signals of a recorded motion are treated; per joint, in the order of the joints that the file has.

    `acceleration_cut_off` [Hz] of the low-pass for accelerations, `effort_delay` [s] by which the recorded effort is
    later than the positions (negative: earlier). `known_effects` are what drives have beside friction: name of a
    coordinate of the drive (`Arm.effect_coordinates`) -> "spring", "cable 1" (sine and cosine of one period a turn),
    "cable 2" (of two), "asymmetric friction". Of a mechanism also `base_may_tilt`, whether the direction of gravity is
    estimated from a motion, and `presliding_travels`, over which elasto-plastic elements give way, as shares of a
    coordinate's standard deviation of position.
    """

    acceleration_cut_off: list[float] = field(default_factory=list, metadata=_CUT_OFFS)
    effort_delay: list[float] = field(default_factory=list, metadata=within(-0.2, 0.2, "s"))
    base_may_tilt: bool = False
    known_effects: dict[str, list[str]] = field(default_factory=dict)
    presliding_travels: list[float] = field(
        default_factory=lambda: [0.003, 0.01, 0.08, 0.3, 1.0], metadata=within(1e-6, 100.0)
    )


@dataclass
class BoxCorners:
    """A box along the axes of a link's frame: its lower and upper corner [m]."""

    lower: list[float] = field(default_factory=list, metadata=within(-5.0, 5.0, "m"))
    upper: list[float] = field(default_factory=list, metadata=within(-5.0, 5.0, "m"))


@dataclass
class BoundingShapes:
    """Where the mass of the links of one SDF file can be: in the box around a link's collision shapes, widened.

    `margin` [m] on all sides is for what is not drawn: covers, screws, cables. `boxes` are those of links whose shapes
    are not where their mass is, or that have none; no margin is added to them.
    """

    margin: float = field(default=0.04, metadata=within(0.0, 1.0, "m"))
    boxes: dict[str, BoxCorners] = field(default_factory=dict)


@dataclass(kw_only=True)
class IdentificationSettings(MotionSettings):
    """Settings for recordings of an arm, and bounds of its links.

    Attributes:
        effort_cut_off: of the low-pass behind which measured and modelled efforts are compared [Hz].
        bounding_shapes: where the mass of the links of each of the arm's SDF files can be, see `bounding_boxes`.
    """

    effort_cut_off: float = field(metadata=_CUT_OFFS)
    bounding_shapes: tuple[BoundingShapes, ...]


@dataclass
class Mechanism:
    """Schema of `mechanisms/*.yaml`: what all arms of one kind have in common.

    `effort_cut_off` [Hz] is that of the low-pass behind which measured and modelled efforts are compared. `effects` are
    what a real arm has beside all that, for its simulation.
    """

    sdf: str = ""
    joints: list[str] = field(default_factory=list)
    gains: Gains = field(default_factory=Gains)
    transmission: dict[str, dict[str, float]] = field(default_factory=dict, metadata=COUPLINGS)
    coupled_limits: list[CoupledLimit] = field(default_factory=list)
    loop_closures: list[LoopClosure] = field(default_factory=list)
    motion: MotionSettings = field(default_factory=MotionSettings)
    effort_cut_off: float = field(default=10.0, metadata=_CUT_OFFS)
    bounding_shapes: BoundingShapes = field(default_factory=BoundingShapes)
    effects: ArmEffects = field(default_factory=ArmEffects)


@dataclass
class Instrument:
    """Schema of `instruments/*.yaml`: what hangs on an arm and can be swapped; its joints follow the arm's.

    `joint_from_actuator` is the disc coupling as the dVRK states it: joint = sum of coefficient * actuator.
    `friction_coordinates` are where parts rub on each other beside the joints and the actuators: name -> sum of
    coefficient * joint.
    """

    sdf: str = ""
    joints: list[str] = field(default_factory=list)
    joint_from_actuator: dict[str, dict[str, float]] = field(default_factory=dict, metadata=COUPLINGS)
    position_limits: dict[str, list[float]] = field(default_factory=dict, metadata=_POSITIONS)
    gains: Gains = field(default_factory=Gains)
    friction_coordinates: dict[str, dict[str, float]] = field(default_factory=dict, metadata=COUPLINGS)
    motion: MotionSettings = field(default_factory=MotionSettings)
    bounding_shapes: BoundingShapes = field(default_factory=BoundingShapes)
    effects: ArmEffects = field(default_factory=ArmEffects)


@dataclass
class ArmDescription:
    """Schema of `arms/*.yaml`.

    `mechanism` and `instrument` are names of files in their folders, or paths of YAML files from the arm's own folder;
    the `sdf` of such a file is a path from the folder that it is in. `gravity` is the gravity vector [m/s^2] in the
    arm's base frame. `mirrored_links` names, by SDF file, links of which this arm has the mirror image (x to -x in the
    link's frame); another SDF, such as one that was exported of this arm, is taken as it is. `coupled_limits` replaces
    [lower, upper] of the mechanism's coupled limits by name, for an arm whose stops were calibrated.
    """

    name: str = ""
    mechanism: str = ""
    instrument: str = ""
    position_limits: dict[str, list[float]] = field(default_factory=dict, metadata=_POSITIONS)
    coupled_limits: dict[str, list[float]] = field(default_factory=dict, metadata=_POSITIONS)
    mirrored_links: dict[str, list[str]] = field(default_factory=dict)
    gravity: list[float] = field(default_factory=lambda: [0.0, 0.0, -9.81], metadata=GRAVITIES)


def load_gains(path: str | Path) -> Gains:
    """Reads kp, kd and ki, one number a joint each; whether they fit an arm is the controller's to say.

    Raises:
        ControllerError: no such file, not one of gains, or a gain outside the range of `Gains`.
    """
    gains = load_typed_yaml(Gains, path, ControllerError, "a file of gains")
    for name, values in dataclasses.asdict(gains).items():
        if not values:
            raise ControllerError(f"{path}: {name} is missing; a file of gains has kp, kd and ki, one number a joint")
    return gains


def save_gains(gains: Gains, path: str | Path, remark: str) -> None:
    """Writes a file of gains with a remark of one line at its top.

    Raises:
        DvrkDrakeError: it cannot be written.
    """
    with atomic_write(path) as stream:
        stream.write(f"# {remark}\n# N m/rad, N m s/rad, N m/(rad s); N and m on a joint that slides.\n")
        stream.write(yaml_dump(dataclasses.asdict(gains)))
