"""Identified model of an arm: model file, holding torque, and evaluation in a control loop."""

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.yaml import yaml_dump_typed

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.dynamics.dynamic_model import DynamicModel
from dvrk_drake.dynamics.dynamic_regressor import DynamicRegressor
from dvrk_drake.dynamics.dynamic_section import (
    ESTIMATES,
    RMS_EFFORTS,
    STANDARD_ERRORS,
    DynamicSection,
    LinkEstimate,
    RotorEstimate,
    SignalSettings,
)
from dvrk_drake.dynamics.gravity_parameters import gravity_parameters
from dvrk_drake.dynamics.holding_torque import StaticModel, holding_torque_into, static_model
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import known_arms, load_arm
from dvrk_drake.models.arm_schema import GRAVITIES
from dvrk_drake.models.effects_schema import FREEDOMS, POSITION_KINDS, DriveEffect, half_width
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.locked_joints import lock_joints
from dvrk_drake.models.model_file import MODEL_SUFFIXES
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.models.sdf_model import PACKAGE_URL
from dvrk_drake.models.typed_yaml import load_yaml, typed_content

# This file has no postponed annotations, because yaml_load_typed reads the types at run time.

#: Format of the files that `IdentifiedModel.save` writes.
FORMAT = "dvrk_drake identified model 1.0"
#: Text between the method of an identification and the recording of the last recalibration.
_RECALIBRATED = ", recalibrated on "
#: Allowed range of measured positions, which may be beyond the limits of a joint.
_POSITIONS = within(-50.0, 50.0, "rad or m")


@dataclass
class BaseParameterEstimate:
    """Estimate of a base parameter [kg m, or kg for a mass].

    `degrees_of_freedom` are those of the standard error, None if they are unknown.
    """

    name: str = ""
    value: float = field(default=0.0, metadata=ESTIMATES)
    standard_error: float = field(default=0.0, metadata=STANDARD_ERRORS)
    degrees_of_freedom: float | None = field(default=None, metadata=FREEDOMS)

    @property
    def distinguishable(self) -> bool:
        """True if the 95 % interval excludes 0."""
        return abs(self.value) > half_width(self.standard_error, self.degrees_of_freedom)


@dataclass
class JointStatistics:
    """Statistics of the fit of one joint. RMS torques are in N m (N for a prismatic joint), positions in rad (m).

    Attributes:
        name: Name of the joint.
        rms_zero_torque: RMS of the measured torque, which is the error without a model.
        rms_fit: RMS residual of the fit.
        rms_leave_one_out: RMS error of leave-one-out predictions of each pose.
        rms_zero_torque_included: `rms_zero_torque` without excluded measurements.
        rms_fit_included: `rms_fit` without excluded measurements.
        rms_leave_one_out_included: `rms_leave_one_out` without excluded measurements.
        rms_cross_validation_included: RMS error of 10-fold cross-validation without excluded measurements. The effects
            are selected again for each fold.
        num_excluded: Number of excluded measurements.
        feedforward_scale: Factor of the joint's torque, 0 to 1. It is less than 1 if the model does not predict the
            measured torque accurately, and 0 if the joint hardly moved.
        position_lower: Lower end of the position range that the recording covers.
        position_upper: Upper end of the position range that the recording covers.
        coverage: Ratio of this position range to the range of the joint limits.
    """

    name: str = ""
    rms_zero_torque: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_fit: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_leave_one_out: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_zero_torque_included: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_fit_included: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_leave_one_out_included: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_cross_validation_included: float = field(default=0.0, metadata=RMS_EFFORTS)
    num_excluded: int = field(default=0, metadata=within(0, 10**9))
    feedforward_scale: float = field(default=1.0, metadata=within(0.0, 1.0))
    position_lower: float = field(default=0.0, metadata=_POSITIONS)
    position_upper: float = field(default=0.0, metadata=_POSITIONS)
    coverage: float = field(default=0.0, metadata=within(0.0, 10.0))


@dataclass
class Provenance:
    """Origin of a model.

    `recording` is the name of the recording, or the names separated by commas. `sha256` is the hash of the recording's
    bytes, or the hashes separated by spaces. `poses` is the number of rows of all recordings. `condition_number` is inf
    if the regressor does not have full rank. `base_tilt` is a text on a tilt of the base that the recording shows but
    the model does not contain, or None.
    """

    recording: str = ""
    sha256: str = ""
    poses: int = field(default=0, metadata=within(0, 10**9))
    method: str = ""
    rank: int = field(default=0, metadata=within(0, 10**6))
    condition_number: float = field(default=0.0, metadata=within(0.0, 1e100, also=(math.inf,)))
    version: str = ""
    base_tilt: str | None = None

    def includes(self, sha256: str) -> bool:
        """Returns whether the model was identified from the recording with this hash, which is "" if unknown."""
        return bool(sha256) and sha256 in self.sha256.split()


#: Verdicts on a joint of a model, from most to least favourable. For `off`, the feedforward scale is 0.
Verdict = Literal["off", "good", "usable", "not judged", "do not use"]


@dataclass
class ValidationSummary:
    """Verdict of `validate` on each joint, for a recording that was not used for identification.

    `sha256` is the hash of the recording's bytes.
    """

    recording: str = ""
    sha256: str = ""
    verdicts: dict[str, str] = field(default_factory=dict)


@dataclass(kw_only=True)
class _Identified:
    """Common fields of a model file and an `IdentifiedModel`."""

    base_parameters: list[BaseParameterEstimate] = field(default_factory=list)
    effects: list[DriveEffect] = field(default_factory=list)
    joints: list[JointStatistics] = field(default_factory=list)
    provenance: Provenance = field(default_factory=Provenance)
    dynamics: DynamicSection | None = None
    validation: ValidationSummary | None = None


@dataclass(kw_only=True)
class _Header:
    """First fields of a model file.

    Attributes:
        format: Version of the file's keys.
        arm: URL or name of an arm of this package, or path of an arm file relative to the model file.
        gravity: Gravity vector (3,) in the arm's base frame [m/s^2].
        locked_joints: Positions of the joints that were not recorded [rad, m], see `lock_joints`.
        position_offsets: Positions in the model at the recorded positions 0 [rad, m], see `Arm.position_offsets`.
    """

    format: str = FORMAT
    arm: str = ""
    gravity: list[float] = field(default_factory=list, metadata=GRAVITIES)
    locked_joints: dict[str, float] = field(default_factory=dict, metadata=_POSITIONS)
    position_offsets: dict[str, float] = field(default_factory=dict, metadata=_POSITIONS)


@dataclass(kw_only=True)
class ModelFile(_Identified, _Header):
    """Schema of a model file."""


@dataclass(kw_only=True)
class IdentifiedModel(_Identified):
    """Identified parameters of an arm.

    The holding torque is tau = feedforward_scale * (Y(q) beta + effects(q)) [N m; N for a prismatic joint]. The factor
    is applied to each joint.

    Attributes:
        arm: Arm with the gravity vector for which the base parameters were identified. If the recording did not
            contain all joints, the arm has locked joints, and the model is valid only for their positions.
        base_parameters: Base parameters in the order of `gravity_parameters(arm).base`. For a model identified from a
            motion, the base parameters are computed from the links in `dynamics`.
        effects: Position-dependent effects of a model identified from poses. If the model has `dynamics`, the list
            contains the offsets and springs that only act at rest, from static poses. `dynamics` contains all other
            effects.
        joints: Statistics of the fit of each joint.
        provenance: Origin of the model.
        dynamics: Full dynamics of a model identified from a motion, or None if the model contains only holding torques.
        validation: Result that `validate --save` stored, or None.

    Example:
        >>> import dvrk_drake as dvrk, numpy as np
        >>> model = dvrk.IdentifiedModel.from_arm(dvrk.load_arm("psm"))
        >>> model.save("psm.yaml")
        >>> tau = dvrk.IdentifiedModel.load("psm.yaml").holding_torque(np.zeros((5, 7)))
        >>> tau.shape, [joint.name for joint in model.joints][1]
        ((5, 7), 'pitch')
    """

    arm: Arm

    @classmethod
    def from_arm(cls, arm: Arm, effects: Sequence[DriveEffect] = (), *, dynamics: bool = False) -> "IdentifiedModel":
        """Returns the nominal model, with the parameters of the arm's files and without identification.

        Args:
            arm: Arm whose SDF specifies the inertias.
            effects: Position-dependent effects, e.g. `arm.effects.position_dependent`. Not allowed together
                with `dynamics`.
            dynamics: True to include the full dynamics, with the rotors and with the friction, cables and springs of
                `arm.effects`.

        Raises:
            ModelError: Both `effects` and `dynamics` are given.
        """
        if dynamics and effects:
            raise ModelError("dynamics already includes all effects of the arm; give either effects or dynamics")
        gravity = gravity_parameters(arm)
        return cls(
            arm=arm,
            base_parameters=[
                BaseParameterEstimate(name, float(value))
                for name, value in zip(gravity.base.names, gravity.base_values, strict=True)
            ],
            effects=[replace(effect) for effect in effects],
            joints=[JointStatistics(name=name) for name in arm.joint_names],
            provenance=Provenance(recording=" ".join(arm.sdf), method="nominal"),
            dynamics=_nominal_dynamics(arm) if dynamics else None,
        )

    @classmethod
    def load(cls, path: str | Path, arm: Arm | None = None) -> "IdentifiedModel":
        """Reads a model file.

        Args:
            path: Path of the model file.
            arm: Expected arm. A model of an arm with another name or other joints is rejected, and one with another
                instrument causes a warning. The returned model has the arm that the model file names, not this object.

        Raises:
            ModelError: The file does not exist, is not a model file, does not match the arm that it names, or is not a
                model of `arm`.
        """
        content = load_yaml(path, ModelError)
        file = typed_content(ModelFile, content, str(path), ModelError, "a model file", complete=True)
        try:
            own_arm = load_arm(_arm_argument(path, file.arm)).with_gravity(file.gravity)
            own_arm = lock_joints(own_arm.with_position_offsets(file.position_offsets), file.locked_joints)
            if arm is not None and own_arm.name != arm.name:
                raise ModelError(f"the model is for {own_arm.name}, not for {arm.name}")
            if arm is not None and own_arm.joint_names != arm.joint_names:
                raise ModelError(_other_joints(own_arm, arm))
            if arm is not None and own_arm.instrument != arm.instrument:
                warnings.warn(
                    f"{path}: the model has the instrument {own_arm.instrument or 'none'}, but the arm has "
                    f"{arm.instrument or 'none'}; friction and couplings of the instrument differ",
                    stacklevel=2,
                )
            model = cls(arm=own_arm, **{part.name: getattr(file, part.name) for part in fields(_Identified)})
            model.check()
        except ArmError as error:
            raise ModelError(f'{path}: the arm "{file.arm}" cannot be loaded: {error}') from error
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
        return model

    def save(self, path: str | Path) -> None:
        """Writes the model file atomically and replaces an existing file.

        Raises:
            ModelError: The model does not match its arm or contains values that are not finite.
        """
        self.check()
        with atomic_write(path) as stream:
            stream.write(yaml_dump_typed(self._file(_arm_reference(path, self.arm))))

    def to_yaml(self) -> str:
        """Returns the text of a model file that refers to the arm by `Arm.source`."""
        return yaml_dump_typed(self._file(self.arm.source))

    def _file(self, arm: str) -> ModelFile:
        parts = {part.name: getattr(self, part.name) for part in fields(_Identified)}
        header = {
            "gravity": self.arm.gravity.tolist(),
            "locked_joints": dict(self.arm.locked_joints),
            "position_offsets": dict(self.arm.position_offsets),
        }
        return ModelFile(arm=arm, **header, **parts)

    def check(self) -> None:
        """Raises ModelError unless the parameters match the arm."""
        if fault := number_fault(self._file(self.arm.source)):
            raise ModelError(fault)
        names = gravity_parameters(self.arm).base.names
        if tuple(p.name for p in self.base_parameters) != names:
            raise ModelError(f"base_parameters must have these names in this order: {'; '.join(names)}")
        if tuple(joint.name for joint in self.joints) != self.arm.joint_names:
            raise ModelError(f"joints must have these names in this order: {', '.join(self.arm.joint_names)}")
        for i, effect in enumerate(self.effects):
            if fault := effect_fault(self.arm, ActuatorEffect.of(effect), POSITION_KINDS):
                raise ModelError(f"effects[{i}]: {fault}")
        if self.validation is not None and set(self.validation.verdicts) != set(self.arm.joint_names):
            raise ModelError(
                f"validation.verdicts has entries for {', '.join(self.validation.verdicts) or 'no joint'}; it needs "
                f"one entry for each joint: {', '.join(self.arm.joint_names)}"
            )
        for name, verdict in self.validation.verdicts.items() if self.validation else ():
            if verdict not in get_args(Verdict):
                raise ModelError(f'validation.verdicts.{name} is "{verdict}"; allowed: {", ".join(get_args(Verdict))}')
        if self.dynamics is not None:
            DynamicModel(self.arm, self.dynamics)
            for i, effect in enumerate(self.effects):
                if effect.kind not in ("offset", "spring"):
                    raise ModelError(
                        f"effects[{i}] is {ActuatorEffect.of(effect)}; allowed in a model with dynamics: offset and "
                        "spring. All other effects are in dynamics.effects"
                    )
                same = [e for e in self.effects[:i] if (e.coordinate, e.kind) == (effect.coordinate, effect.kind)]
                if same:
                    raise ModelError(f"effects[{i}]: {effect.coordinate} has two effects of the kind {effect.kind}")
            if not np.allclose(self.dynamics.gravity, self.arm.gravity, rtol=0, atol=1e-9):
                raise ModelError("gravity must equal dynamics.gravity in a model with dynamics")

    @property
    def holding_effects(self) -> list[DriveEffect]:
        """Effects of the holding torque: those of the dynamics (`DynamicModel.holding_effects`), then `effects`.

        An offset in `effects` replaces that of the dynamics, and a spring is added.
        """
        if self.dynamics is None:
            return self.effects
        replaced = {e.coordinate for e in self.effects if e.kind == "offset"}
        of_motion = (self.dynamics.effects[i] for i in self.dynamic_model.holding_effects)
        return [*(e for e in of_motion if e.kind != "offset" or e.coordinate not in replaced), *self.effects]

    @property
    def interval_scope(self) -> str:
        """Sentences on the recordings, and therefore the days, whose errors the 95 % prediction intervals contain."""
        recordings = self.provenance.method.partition(_RECALIBRATED)[2] or self.provenance.recording or "one recording"
        text = (
            f"The 95 % prediction intervals contain only the errors within and between the recordings of the model "
            f"({recordings}). They are valid for similar motions on the same days. On another day, recalibrate"
        )
        actuators = [] if self.dynamics is None else self.dynamics.actuators
        if not any(a.rms_between_days for a in actuators):
            return f"{text}."
        shares = [f"{100 * a.rms_between_days / a.rms_effort if a.rms_effort else 0.0:.0f}" for a in actuators]
        # Many arms have one share for all actuators.
        stated = shares[0] if len(set(shares)) == 1 else ", ".join(shares)
        return (
            f"{text}, or use the wider intervals for another day. Their assumption: the efforts change between days by "
            f"{stated} % of the RMS efforts (standard deviations in the arm's files)."
        )

    def recalibrated(self, dynamics: DynamicSection, recording: str) -> "IdentifiedModel":
        """Returns the model with a section of dynamics that was refitted to a recording, without its validation."""
        method = f"{self.provenance.method.partition(_RECALIBRATED)[0]}{_RECALIBRATED}{recording or 'a recording'}"
        return replace(self, dynamics=dynamics, provenance=replace(self.provenance, method=method), validation=None)

    @property
    def theta(self) -> NDArray[np.float64]:
        """Parameters (b + e,) of `static_model`: base parameters, then coefficients of `holding_effects`."""
        return np.array([p.value for p in self.base_parameters] + [e.coefficient for e in self.holding_effects])

    @property
    def feedforward_scale(self) -> NDArray[np.float64]:
        """Factors (n,) of the joint torques."""
        return np.array([joint.feedforward_scale for joint in self.joints])

    @cached_property
    def static_model(self) -> StaticModel:
        """Static model with the parameters `theta`."""
        return static_model(self.arm, tuple(map(ActuatorEffect.of, self.holding_effects)))

    @cached_property
    def dynamic_model(self) -> DynamicModel:
        """Model of the arm's full dynamics.

        Raises:
            ModelError: The model was identified from poses and has no `dynamics`.
        """
        if self.dynamics is None:
            raise ModelError("the model has no dynamics; use a model that was identified from a motion")
        return DynamicModel(self.arm, self.dynamics)

    def with_scaled_parameters(self, factors: ArrayLike) -> "IdentifiedModel":
        """Returns a copy with base parameters multiplied by `factors` (b,), to simulate identification errors.

        `dynamics` is not changed.
        """
        scaled = zip(self.base_parameters, np.asarray(factors, float), strict=True)
        return replace(self, base_parameters=[replace(p, value=float(p.value * factor)) for p, factor in scaled])

    def holding_torque(self, q: ArrayLike) -> NDArray[np.float64]:
        """Returns the joint torque [N m, N] that holds the arm: (n,) for q (n,), (m, n) for q (m, n)."""
        return self.feedforward_scale * self.static_model.torque(q, self.theta)


class ControlModel:
    """Gravity effort and mass matrix of an arm, evaluated fast enough for a control loop."""

    def __init__(self, model: IdentifiedModel, *, with_gravity: bool = True) -> None:
        """Reads the parameters of `model`.

        Args:
            model: Model of the arm with the actual orientation of its base. A model identified from poses has no
                inertias, so the inertias of the arm's SDF are used.
            with_gravity: False for an arm whose own controller adds gravity compensation to all efforts.
                `gravity_effort` then returns 0.

        Raises:
            ModelError: The model does not match its arm.
        """
        model.check()
        self._holding = model.static_model.with_parameters(model.theta)
        self._scale = model.feedforward_scale * with_gravity
        if model.dynamics is None:
            self._regressor = DynamicRegressor(model.arm)
            self._parameters = self._regressor.values
        else:
            self._regressor, self._parameters = model.dynamic_model.regressor, model.dynamic_model.parameters

    def gravity_effort(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the effort (n,) [N m, N] that holds the arm at q (n,) [rad, m].

        `q` must be C-contiguous.
        """
        effort = np.empty(len(q))
        holding_torque_into(q, self._holding, effort)
        return effort * self._scale

    def mass_matrix(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the mass matrix (n, n) of the independent joints at q (n,) [rad, m], including the rotors."""
        return self._regressor.mass_matrix(q[None], self._parameters)[0]


def _arm_reference(path: str | Path, arm: Arm) -> str:
    """Returns the reference to the arm in the model file at `path`: a URL, or a path relative to this file.

    For an arm of this package with another instrument, it is the source of the arm.
    """
    if _has_exchanged_instrument(arm.source):
        return arm.source
    if not os.path.isabs(arm.source):
        return f"{PACKAGE_URL}arms/{arm.source}.yaml"
    return os.path.relpath(arm.source, os.path.dirname(os.path.realpath(path)))


def _has_exchanged_instrument(source: str) -> bool:
    arm, plus, _ = source.partition("+")
    return bool(plus) and arm in known_arms()


def _other_joints(own: Arm, arm: Arm) -> str:
    """Returns a message on a model whose joints are not those of the expected arm."""
    if not own.locked_joints:
        return f"the model is for the joints {', '.join(own.joint_names)}; allowed: {', '.join(arm.joint_names)}"
    return (
        f"the model is valid only with locked joints ({own.locked_text}), because the recording did not contain them; "
        f"allowed: a model of the joints {', '.join(arm.joint_names)}. Identify a recording of these joints"
    )


def _arm_argument(path: str | Path, name: str) -> str:
    """Returns the argument of `load_arm` for the arm that has the reference `name` in the model file at `path`."""
    if not name.lower().endswith((".yaml", ".yml", *MODEL_SUFFIXES)) or name.startswith(PACKAGE_URL):
        return name
    if _has_exchanged_instrument(name):
        return name
    return os.path.join(os.path.dirname(os.path.realpath(path)), name)


def _nominal_dynamics(arm: Arm) -> DynamicSection:
    """Returns the dynamics specified by the arm's files."""
    regressor = DynamicRegressor(arm)
    rotors = regressor.rotors[: arm.num_joints]
    drive = [*arm.effects.friction, *arm.effects.cables, *arm.effects.springs]
    gravity = [float(x) for x in arm.gravity]
    return DynamicSection(
        gravity=gravity,
        links=[LinkEstimate(link.link, link.parameters.tolist()) for link in regressor.links],
        rotors=[RotorEstimate(name, rotor.value) for name, rotor in zip(arm.joint_names, rotors, strict=True)],
        effects=[DriveEffect(e.coordinate, e.kind, e.scale, e.coefficient) for e in drive],
        signals=SignalSettings.of(arm.identification),
        gravity_expected=gravity,
    )
