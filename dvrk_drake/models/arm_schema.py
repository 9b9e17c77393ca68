"""Schemas of `arms/*.yaml`, `mechanisms/*.yaml` and `instruments/*.yaml`, for yaml_load_typed: a typo is an error.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field

from dvrk_drake.models.effects_schema import ArmEffects


@dataclass
class CoupledLimit:
    """lower <= sum of coefficient * joint position <= upper; `name` is what messages call it."""

    name: str = ""
    coefficients: dict[str, float] = field(default_factory=dict)
    lower: float = 0.0
    upper: float = 0.0


@dataclass
class LoopClosure:
    """Two frames of the SDF whose origins coincide at every pose that the linkage allows."""

    frame_a: str = ""
    frame_b: str = ""


@dataclass
class Gains:
    """Diagonal PID gains per joint: kp [N m/rad], kd [N m s/rad], ki [N m/(rad s)]; N and m on a prismatic joint."""

    kp: list[float] = field(default_factory=list)
    kd: list[float] = field(default_factory=list)
    ki: list[float] = field(default_factory=list)

    def fault(self) -> str:
        """The first gain with a sign that makes a controller unstable, or ""."""
        for name, least in (("kp", "more than 0"), ("kd", "0 or more"), ("ki", "0 or more")):
            for i, gain in enumerate(getattr(self, name)):
                if not (gain > 0 if name == "kp" else gain >= 0):
                    return f"{name}[{i}] is {gain:g}; allowed: {least}"
        return ""


@dataclass
class MotionSettings:
    """How the signals of a recorded motion are treated; per joint, in the order of the joints that the file has.

    `acceleration_cut_off` [Hz] of the low-pass for accelerations, `effort_delay` [s] by which the recorded effort is
    later than the positions (negative: earlier). `known_effects` are what drives have beside friction: name of a
    coordinate of the drive (`effect_coordinates`) -> "spring", "cable 1" (sine and cosine of one period a turn),
    "cable 2" (of two), "asymmetric friction". Of a mechanism also `base_may_tilt`, whether the direction of gravity is
    estimated from a motion, and `presliding_travels`, over which elasto-plastic elements give way, as shares of a
    coordinate's standard deviation of position.
    """

    acceleration_cut_off: list[float] = field(default_factory=list)
    effort_delay: list[float] = field(default_factory=list)
    base_may_tilt: bool = False
    known_effects: dict[str, list[str]] = field(default_factory=dict)
    presliding_travels: list[float] = field(default_factory=lambda: [0.003, 0.01, 0.08, 0.3, 1.0])


@dataclass
class BoxCorners:
    """A box along the axes of a link's frame: its lower and upper corner [m]."""

    lower: list[float] = field(default_factory=list)
    upper: list[float] = field(default_factory=list)


@dataclass
class BoundingShapes:
    """Where the mass of the links of one SDF file can be: in the box around a link's collision shapes, widened.

    `margin` [m] on all sides is for what is not drawn: covers, screws, cables. `boxes` are those of links whose shapes
    are not where their mass is, or that have none; no margin is added to them.
    """

    margin: float = 0.04
    boxes: dict[str, BoxCorners] = field(default_factory=dict)


@dataclass
class Mechanism:
    """Schema of `mechanisms/*.yaml`: what all arms of one kind have in common.

    `effort_cut_off` [Hz] is that of the low-pass behind which measured and modelled efforts are compared. `effects` are
    what a real arm has beside all that, for its simulation.
    """

    sdf: str = ""
    joints: list[str] = field(default_factory=list)
    gains: Gains = field(default_factory=Gains)
    transmission: dict[str, dict[str, float]] = field(default_factory=dict)
    coupled_limits: list[CoupledLimit] = field(default_factory=list)
    loop_closures: list[LoopClosure] = field(default_factory=list)
    motion: MotionSettings = field(default_factory=MotionSettings)
    effort_cut_off: float = 10.0
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
    joint_from_actuator: dict[str, dict[str, float]] = field(default_factory=dict)
    position_limits: dict[str, list[float]] = field(default_factory=dict)
    gains: Gains = field(default_factory=Gains)
    friction_coordinates: dict[str, dict[str, float]] = field(default_factory=dict)
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
    position_limits: dict[str, list[float]] = field(default_factory=dict)
    coupled_limits: dict[str, list[float]] = field(default_factory=dict)
    mirrored_links: dict[str, list[str]] = field(default_factory=dict)
    gravity: list[float] = field(default_factory=lambda: [0.0, 0.0, -9.81])
