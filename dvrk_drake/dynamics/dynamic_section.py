"""What a model file holds of an arm's full dynamics."""

# No postponed annotations here: yaml_load_typed reads the types at run time.
from dataclasses import dataclass, field

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect


@dataclass
class LinkEstimate:
    """The ten inertial parameters of a link about its origin in its frame of the SDF, see `LinkInertia`.

    `least_eigenvalue` is that of its pseudo-inertia: positive for every body that can exist.
    """

    link: str = ""
    parameters: list[float] = field(default_factory=list)
    least_eigenvalue: float = 0.0


@dataclass
class RotorEstimate:
    """Inertia of a motor's rotor at its actuator [kg m^2; kg of a prismatic one]."""

    actuator: str = ""
    value: float = 0.0
    standard_error: float = 0.0


@dataclass
class ActuatorEffectEstimate:
    """An effect in the drive, see `ActuatorEffect`, with its coefficient in the unit of its kind."""

    coordinate: str = ""
    kind: str = ""
    scale: float = 0.0
    value: float = 0.0
    standard_error: float = 0.0

    @property
    def effect(self) -> ActuatorEffect:
        """What it is the coefficient of."""
        return ActuatorEffect(self.coordinate, self.kind, self.scale)

    @property
    def distinguishable(self) -> bool:
        """Whether its size exceeds two standard errors."""
        return abs(self.value) > 2 * self.standard_error


@dataclass
class ActuatorStatistics:
    """How the effort of one actuator was fitted, behind the low-pass: RMS in N m (N of one that slides).

    `rms_cross_validation`: of phases of the motion (or stretches, if it does not repeat) predicted by what the others
    alone give, the choice of effects and the direction of gravity included.
    `rms_repeatability`: by which the arm does not repeat its efforts from period to period; 0 where it is unknown.
    """

    name: str = ""
    rms_effort: float = 0.0
    rms_fit: float = 0.0
    rms_cross_validation: float = 0.0
    rms_repeatability: float = 0.0


@dataclass
class SignalSettings:
    """How signals were treated: cut-offs of zero-phase low-passes [Hz], delays of the efforts [s], per actuator."""

    position_cut_off: float = 50.0
    acceleration_cut_off: list[float] = field(default_factory=list)
    effort_cut_off: float = 0.0
    effort_delay: list[float] = field(default_factory=list)


@dataclass
class DynamicSection:
    """tau_actuator = J'^-1 Y(q, v, vd) phi + effects: an arm's identified dynamics.

    `gravity` [m/s^2] is gravity in the base frame as the motion shows it, the model's; `gravity_expected` is what it
    was taken for before, from which it differs where the base was not quite level.
    """

    gravity: list[float] = field(default_factory=list)
    links: list[LinkEstimate] = field(default_factory=list)
    rotors: list[RotorEstimate] = field(default_factory=list)
    effects: list[ActuatorEffectEstimate] = field(default_factory=list)
    actuators: list[ActuatorStatistics] = field(default_factory=list)
    signals: SignalSettings = field(default_factory=SignalSettings)
    gravity_expected: list[float] = field(default_factory=list)
