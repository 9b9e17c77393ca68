"""Section of a model file with an arm's full dynamics."""

# This file has no postponed annotations, because yaml_load_typed reads the types at run time.
from dataclasses import dataclass, field

from dvrk_drake.models.arm_schema import GRAVITIES, IdentificationSettings
from dvrk_drake.models.effects_schema import FREEDOMS, DriveEffect
from dvrk_drake.models.ranges import within

#: Allowed ranges of estimates, standard errors and efforts. They detect wrong units and misplaced decimal points (see
#: docs/files.md), and are wide because parameters that a recording does not identify can have any value.
ESTIMATES = within(-1e9, 1e9, "kg, kg m or kg m^2")
STANDARD_ERRORS = within(0.0, 1e9)
RMS_EFFORTS = within(0.0, 1e6, "N m or N")
#: Ranges from 0 to 1 and from -1 to 1, with a tolerance for rounding.
SHARES = within(-1e-6, 1.0 + 1e-6)
_CORRELATIONS = within(-1.0 - 1e-6, 1.0 + 1e-6)
_CUT_OFFS = within(0.01, 1e5, "Hz")


@dataclass
class LinkEstimate:
    """Ten inertial parameters of a link about its origin in its SDF frame, see `LinkInertia`.

    Attributes:
        link: Name of the link.
        parameters: Estimated inertial parameters (10,).
        standard_errors: Standard errors (10,) of the individual parameters. The standard errors of base parameters are
            smaller.
        mass_identifiability: Relative reduction of the prior variance of the mass by the motion, 0 to 1. Near 0, the
            estimate is close to the mass in the SDF.
        bounds: Descriptions of the bounds of `consistent_parameters` that the link has reached.
    """

    link: str = ""
    parameters: list[float] = field(default_factory=list, metadata=ESTIMATES)
    standard_errors: list[float] = field(default_factory=list, metadata=STANDARD_ERRORS)
    mass_identifiability: float = field(default=0.0, metadata=SHARES)
    bounds: list[str] = field(default_factory=list)


@dataclass
class MotionParameterEstimate:
    """Estimate of a base parameter of the full dynamics, see `derive_base_parameters`.

    `identifiability` is the relative reduction of the prior variance by the motion, 0 to 1.
    """

    name: str = ""
    unit: str = ""
    value: float = field(default=0.0, metadata=ESTIMATES)
    standard_error: float = field(default=0.0, metadata=STANDARD_ERRORS)
    identifiability: float = field(default=0.0, metadata=SHARES)


@dataclass
class CorrelatedEstimates:
    """Two base parameters, or a base parameter and an effect, that are not identifiable separately."""

    first: str = ""
    second: str = ""
    correlation: float = field(default=0.0, metadata=_CORRELATIONS)


@dataclass
class RotorEstimate:
    """Inertia of a motor's rotor in actuator coordinates [kg m^2; kg for a prismatic actuator]."""

    actuator: str = ""
    value: float = field(default=0.0, metadata=within(0.0, 1e9, "kg m^2 or kg"))
    standard_error: float = field(default=0.0, metadata=STANDARD_ERRORS)


@dataclass
class ActuatorStatistics:
    """RMS effort and RMS errors of one actuator after low-pass filtering [N m; N if prismatic].

    `rms_cross_validation` is the RMS prediction error on held-out phases of the motion, or on held-out segments if the
    motion is not periodic. Effects and gravity direction are estimated again without the held-out part.
    `rms_between_days` is the assumed RMS change of the effort between days (`MotionSettings.day_deviation`), 0 if it is
    unknown.
    `rms_repeatability` is the RMS difference of the effort between periods, divided by sqrt(2). This value is 0 if the
    motion does not repeat.
    """

    name: str = ""
    rms_effort: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_fit: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_cross_validation: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_repeatability: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_between_days: float = field(default=0.0, metadata=RMS_EFFORTS)


@dataclass
class SignalSettings:
    """Signal processing settings: cut-offs of the zero-phase low-pass filters [Hz] and delays of the efforts [s]."""

    position_cut_off: float = field(default=50.0, metadata=_CUT_OFFS)
    acceleration_cut_off: list[float] = field(default_factory=list, metadata=_CUT_OFFS)
    effort_cut_off: float = field(default=0.0, metadata=_CUT_OFFS)
    effort_delay: list[float] = field(default_factory=list, metadata=within(-1.0, 1.0, "s"))

    @classmethod
    def of(cls, motion: IdentificationSettings) -> "SignalSettings":
        """Returns the settings of an arm file."""
        return cls(
            acceleration_cut_off=list(motion.acceleration_cut_off),
            effort_cut_off=motion.effort_cut_off,
            effort_delay=list(motion.effort_delay),
        )


@dataclass
class DynamicSection:
    """Identified dynamics of an arm: tau_actuator = J'^-1 Y(q, v, vd) phi + effects.

    J is the matrix of `Arm.transmission`. Y and phi are the regressor and the parameters of `DynamicRegressor`.

    `gravity` is the gravity vector that was estimated from the motion, in the base frame [m/s^2]. `gravity_expected` is
    the vector that was assumed before identification. The two vectors differ if the base was tilted. `base_parameters`
    are the identifiable combinations of link and rotor parameters. `correlations` lists pairs of parameters that are
    not identifiable separately. `degrees_of_freedom` are those of the standard errors. `error_correlation` (n, n) is
    the correlation of the errors of `rms_cross_validation`. Both are None if they are unknown.
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
    degrees_of_freedom: float | None = field(default=None, metadata=FREEDOMS)
    error_correlation: list[list[float]] | None = field(default=None, metadata=_CORRELATIONS)
