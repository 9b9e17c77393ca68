"""What a model file holds of an arm's full dynamics."""

# No postponed annotations here: yaml_load_typed reads the types at run time.
from dataclasses import dataclass, field

from dvrk_drake.models.arm_schema import GRAVITIES
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.schema_fault import formerly, within

#: What a fit finds: beyond the largest arm by orders of magnitude, as parameters that a recording does not tell are
#: found anywhere, and their standard errors are larger still.
ESTIMATES = within(-1e5, 1e5, "kg, kg m or kg m^2")
STANDARD_ERRORS = within(0.0, 1e9)
RMS_EFFORTS = within(0.0, 1e6, "N m or N")
#: Of numbers that rounding may put beyond 0 or 1.
SHARES = within(-1e-6, 1.0 + 1e-6)
_CUT_OFFS = within(0.01, 1e5, "Hz")


@dataclass
class LinkEstimate:
    """The ten inertial parameters of a link about its origin in its frame of the SDF, see `LinkInertia`.

    `least_eigenvalue` is that of its pseudo-inertia: positive for every body that can exist. `standard_errors` are of
    the parameters, of one by one: base parameters are known far better. `mass_identifiability` is the share of the prior's
    variance of the mass that the motion took away, 0..1: near 0 the mass is the SDF's. `bounds` says which bounds of
    `consistent_parameters` it lies at.
    """

    link: str = ""
    parameters: list[float] = field(default_factory=list, metadata=ESTIMATES)
    least_eigenvalue: float = field(default=0.0, metadata=ESTIMATES)
    standard_errors: list[float] = field(default_factory=list, metadata=STANDARD_ERRORS)
    mass_identifiability: float = field(default=0.0, metadata=SHARES | formerly("mass_told"))
    bounds: list[str] = field(default_factory=list)


@dataclass
class MotionParameterEstimate:
    """A base parameter of the full dynamics, see `derive_base_parameters`.

    `identifiability` is the share of the prior's variance that the motion took away, 0..1.
    """

    name: str = ""
    unit: str = ""
    value: float = field(default=0.0, metadata=ESTIMATES)
    standard_error: float = field(default=0.0, metadata=STANDARD_ERRORS)
    identifiability: float = field(default=0.0, metadata=SHARES | formerly("told"))


@dataclass
class CorrelatedEstimates:
    """Two base parameters, or a base parameter and an effect, that the motion hardly tells apart."""

    first: str = ""
    second: str = ""
    correlation: float = field(default=0.0, metadata=within(-1.0 - 1e-6, 1.0 + 1e-6))


@dataclass
class RotorEstimate:
    """Inertia of a motor's rotor at its actuator [kg m^2; kg of a prismatic one]."""

    actuator: str = ""
    value: float = field(default=0.0, metadata=within(0.0, 1e4, "kg m^2 or kg"))
    standard_error: float = field(default=0.0, metadata=STANDARD_ERRORS)


@dataclass
class ActuatorStatistics:
    """How the effort of one actuator was fitted, behind the low-pass: RMS in N m (N of one that slides).

    `rms_cross_validation`: of phases of the motion (or stretches, if it does not repeat) predicted by what the others
    alone give, the choice of effects and the direction of gravity included.
    `rms_repeatability`: by which the arm does not repeat its efforts from period to period; 0 where it is unknown.
    """

    name: str = ""
    rms_effort: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_fit: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_cross_validation: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_repeatability: float = field(default=0.0, metadata=RMS_EFFORTS)


@dataclass
class SignalSettings:
    """How signals were treated: cut-offs of zero-phase low-passes [Hz], delays of the efforts [s], per actuator."""

    position_cut_off: float = field(default=50.0, metadata=_CUT_OFFS)
    acceleration_cut_off: list[float] = field(default_factory=list, metadata=_CUT_OFFS)
    effort_cut_off: float = field(default=0.0, metadata=_CUT_OFFS)
    effort_delay: list[float] = field(default_factory=list, metadata=within(-1.0, 1.0, "s"))


@dataclass
class DynamicSection:
    """tau_actuator = J'^-1 Y(q, v, vd) phi + effects: an arm's identified dynamics.

    `gravity` [m/s^2] is gravity in the base frame as the motion shows it, the model's; `gravity_expected` is what it
    was taken for before, from which it differs where the base was not quite level. `base_parameters` are what a motion
    can tell of links and rotors, `correlations` which of them this one did not tell apart.
    """

    gravity: list[float] = field(default_factory=list, metadata=GRAVITIES)
    links: list[LinkEstimate] = field(default_factory=list)
    rotors: list[RotorEstimate] = field(default_factory=list)
    effects: list[DriveEffect] = field(default_factory=list)
    actuators: list[ActuatorStatistics] = field(default_factory=list)
    signals: SignalSettings = field(default_factory=SignalSettings)
    gravity_expected: list[float] = field(default_factory=list, metadata=GRAVITIES)
    base_parameters: list[MotionParameterEstimate] = field(default_factory=list)
    correlations: list[CorrelatedEstimates] = field(default_factory=list)
