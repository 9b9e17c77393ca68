"""The identified model of an arm: its files, its torques, and its evaluation in a control loop."""

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.yaml import yaml_dump_typed

from dvrk_drake.dynamics.actuator_effects import POSITION_KINDS, ActuatorEffect, effect_fault
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
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.arm_schema import GRAVITIES
from dvrk_drake.models.effects_schema import DriveEffect
from dvrk_drake.models.files import atomic_write
from dvrk_drake.models.schema_fault import formerly, missing_key, schema_fault, with_current_keys, within
from dvrk_drake.models.sdf_model import PACKAGE_URL
from dvrk_drake.models.typed_yaml import load_yaml, typed_content

if TYPE_CHECKING:
    from dvrk_drake.dynamics.static_model import StaticModel

# No postponed annotations here: yaml_load_typed reads the types at run time.

#: Format of the files that `IdentifiedModel.save` writes.
FORMAT = "dvrk_drake identified model 4"
#: Formats of earlier versions that can be read. In format 2, `arm` is a name or an absolute path.
_EARLIER_FORMATS = ("dvrk_drake identified model 3", "dvrk_drake identified model 2")
#: Measured positions, which may be beyond the limits of a joint.
_POSITIONS = within(-50.0, 50.0, "rad or m")


@dataclass
class BaseParameterEstimate:
    """A base parameter [kg m, or kg of a mass]; `distinguishable`: its size exceeds two standard errors."""

    name: str = ""
    value: float = field(default=0.0, metadata=ESTIMATES)
    standard_error: float = field(default=0.0, metadata=STANDARD_ERRORS)
    distinguishable: bool = False


def _earlier(name: str) -> dict[str, object]:
    """Returns the metadata of an RMS effort without excluded measurements, whose key ended in `_undoubted`."""
    return RMS_EFFORTS | formerly(f"{name}_undoubted")


@dataclass
class JointStatistics:
    """How one joint was fitted. Torques are RMS in N m (N if prismatic), angles in rad (m).

    `rms_zero_torque` is the error of commanding nothing: the RMS of the measured torque. `rms_leave_one_out` predicts
    each pose from all others; `rms_cross_validation` chooses the effects anew as well (ten folds). `_included` leaves
    out the measurements that were excluded (`num_excluded` of them). `feedforward_scale` scales the joint's torque: 1, or less where
    the data do not support the model. `position_lower`, `position_upper`: the range that the poses covered;
    `coverage`: its share of the arm's range.
    """

    name: str = ""
    rms_zero_torque: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_fit: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_leave_one_out: float = field(default=0.0, metadata=RMS_EFFORTS)
    rms_zero_torque_included: float = field(default=0.0, metadata=_earlier("rms_zero_torque"))
    rms_fit_included: float = field(default=0.0, metadata=_earlier("rms_fit"))
    rms_leave_one_out_included: float = field(
        default=0.0, metadata=RMS_EFFORTS | formerly("rms_leave_one_out_undoubted")
    )
    rms_cross_validation_included: float = field(
        default=0.0, metadata=RMS_EFFORTS | formerly("rms_cross_validation_undoubted")
    )
    num_excluded: int = field(default=0, metadata=within(0, 10**9) | formerly("num_doubted"))
    feedforward_scale: float = field(default=1.0, metadata=within(0.0, 1.0) | formerly("trust"))
    position_lower: float = field(default=0.0, metadata=_POSITIONS)
    position_upper: float = field(default=0.0, metadata=_POSITIONS)
    coverage: float = field(default=0.0, metadata=within(0.0, 10.0))


@dataclass
class Provenance:
    """Where a model came from; `sha256` is of the recording's bytes, `condition_number` inf without full rank."""

    recording: str = ""
    sha256: str = ""
    poses: int = field(default=0, metadata=within(0, 10**9))
    method: str = ""
    rank: int = field(default=0, metadata=within(0, 10**6))
    condition_number: float = field(default=0.0, metadata=within(0.0, 1e100, also=(math.inf,)))
    version: str = ""


#: On a joint of a model, from the most to the least favourable; `off`: the model commands no torque.
Verdict = Literal["off", "good", "usable", "not judged", "do not use"]


@dataclass
class ValidationSummary:
    """Verdict on each joint by `validate` on a recording that the model was not identified from.

    `sha256` is of the recording's bytes.
    """

    recording: str = ""
    sha256: str = ""
    verdicts: dict[str, str] = field(default_factory=dict)


@dataclass(kw_only=True)
class _Identified:
    """Fields that a model file and an `IdentifiedModel` have in common."""

    base_parameters: list[BaseParameterEstimate] = field(default_factory=list)
    effects: list[DriveEffect] = field(default_factory=list)
    joints: list[JointStatistics] = field(default_factory=list)
    provenance: Provenance = field(default_factory=Provenance)
    dynamics: DynamicSection | None = None
    validation: ValidationSummary | None = None


@dataclass(kw_only=True)
class _Head:
    """The first lines of a model file.

    Attributes:
        format: version of the file's keys.
        arm: URL or name of an arm of this package, or the path of an arm's file, relative to the model file.
        gravity: (3,) gravity vector in the arm's base frame [m/s^2].
    """

    format: str = ""
    arm: str = ""
    gravity: list[float] = field(default_factory=list, metadata=GRAVITIES)


@dataclass(kw_only=True)
class ModelFile(_Identified, _Head):
    """Schema of a model file."""


@dataclass(kw_only=True)
class IdentifiedModel(_Identified):
    """Identified parameters of an arm.

    They give its holding torque tau = feedforward_scale o (Y(q) beta + effects(q)) [N m; N on a prismatic joint].

    Attributes:
        arm: the arm, mounted as it was when its base parameters were identified.
        base_parameters: in the order of `gravity_parameters(arm).base`. Of a model identified from a motion, those of
            the links in `dynamics`.
        effects: of position alone, of a model identified from poses; a model with `dynamics` has all effects there.
        joints: how each joint was fitted.
        provenance: where the model came from.
        dynamics: of a model identified from a motion.
        validation: what `validate --save` stored.

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
        """Returns the model that the arm's own files state, without identification.

        Args:
            arm: whose SDF states the inertias.
            effects: of position, e.g. `arm.effects.cables + arm.effects.springs`; not with `dynamics`.
            dynamics: state the dynamics in motion too: rotors, and the friction, cables and springs of `arm.effects`.

        Raises:
            ModelError: `effects` beside `dynamics`.
        """
        if dynamics and effects:
            raise ModelError("a model with dynamics has all effects of the arm; give either effects or dynamics")
        gravity = gravity_parameters(arm)
        return cls(
            arm=arm,
            base_parameters=[
                BaseParameterEstimate(name, float(value), 0.0, True)
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
            path: the model file.
            arm: refuse a model of an arm with another name; the model keeps the arm that its file names.

        Raises:
            ModelError: no such file, not a model, or one that does not fit its arm or is not of `arm`.
        """
        content = load_yaml(path, ModelError)
        # Another version has other keys, which are not worth naming.
        version = content.get("format") if isinstance(content, dict) else None
        if version and version not in (FORMAT, *_EARLIER_FORMATS):
            raise ModelError(f'{path}: format is "{version}", this version reads "{FORMAT}", 3 and 2; identify anew')
        content = with_current_keys(ModelFile, content, str(path))
        file = typed_content(ModelFile, content, str(path), ModelError, "a model file")
        # A number that is missing would be 0 without a word.
        if key := missing_key(ModelFile, content):
            raise ModelError(f"{path}: {key} is missing")
        try:
            own_arm = load_arm(_named_from(path, file.arm)).with_gravity(file.gravity)
            if arm is not None and own_arm.name != arm.name:
                raise ModelError(f"is of {own_arm.name}, not of {arm.name}")
            model = cls(arm=own_arm, **{part.name: getattr(file, part.name) for part in fields(_Identified)})
            model.check()
        except ArmError as error:
            raise ModelError(f'{path}: its arm "{file.arm}" cannot be loaded: {error}') from error
        except ModelError as error:
            raise ModelError(f"{path}: {error}") from error
        return model

    def save(self, path: str | Path) -> None:
        """Writes the model file at once or not at all; an existing file is replaced.

        Raises:
            ModelError: the model does not fit its arm, or holds numbers that are none.
        """
        self.check()
        with atomic_write(path) as stream:
            stream.write(yaml_dump_typed(self._file(_name_for(path, self.arm))))

    def to_yaml(self) -> str:
        """Returns the text of a model file that names the arm by `Arm.source`."""
        return yaml_dump_typed(self._file(self.arm.source))

    def _file(self, arm: str) -> ModelFile:
        parts = {part.name: getattr(self, part.name) for part in fields(_Identified)}
        return ModelFile(format=FORMAT, arm=arm, gravity=self.arm.gravity.tolist(), **parts)

    def check(self) -> None:
        """Raises ModelError unless the parameters fit the arm."""
        if fault := schema_fault(ModelFile, asdict(self._file(self.arm.source)), "a model"):
            raise ModelError(fault)
        names = gravity_parameters(self.arm).base.names
        if tuple(p.name for p in self.base_parameters) != names:
            raise ModelError(f"base parameters must be, in this order: {'; '.join(names)}")
        if tuple(joint.name for joint in self.joints) != self.arm.joint_names:
            raise ModelError(f"joints must be, in this order: {', '.join(self.arm.joint_names)}")
        for i, effect in enumerate(self.effects):
            if fault := effect_fault(self.arm, ActuatorEffect.of(effect), POSITION_KINDS):
                raise ModelError(f"effects[{i}]: {fault}")
        if self.validation is not None and set(self.validation.verdicts) != set(self.arm.joint_names):
            raise ModelError(f"validation.verdicts must name these joints: {', '.join(self.arm.joint_names)}")
        for name, verdict in self.validation.verdicts.items() if self.validation else ():
            if verdict not in get_args(Verdict):
                raise ModelError(f'validation.verdicts.{name} is "{verdict}"; allowed: {", ".join(get_args(Verdict))}')
        if self.dynamics is not None:
            DynamicModel(self.arm, self.dynamics)
            if self.effects or not np.allclose(self.dynamics.gravity, self.arm.gravity, rtol=0, atol=1e-9):
                raise ModelError("a model with dynamics has effects only there, and the gravity that stands there")

    @property
    def holding_effects(self) -> list[DriveEffect]:
        """The effects that act at rest as they do in motion (`DynamicModel.holding_effects`)."""
        if self.dynamics is None:
            return self.effects
        return [self.dynamics.effects[i] for i in self.dynamic_model.holding_effects]

    @property
    def theta(self) -> NDArray[np.float64]:
        """(b + e,) base parameters, then coefficients of `holding_effects`, as `StaticModel` wants them."""
        return np.array([p.value for p in self.base_parameters] + [e.coefficient for e in self.holding_effects])

    @property
    def feedforward_scale(self) -> NDArray[np.float64]:
        """(n,) factor of each joint's torque."""
        return np.array([joint.feedforward_scale for joint in self.joints])

    @cached_property
    def static_model(self) -> "StaticModel":
        """The compiled structure that `theta` belongs to."""
        from dvrk_drake.dynamics.static_model import compile_static_model  # sympy takes 0.3 s, and motions need none

        return compile_static_model(self.arm, tuple(map(ActuatorEffect.of, self.holding_effects)))

    @cached_property
    def dynamic_model(self) -> DynamicModel:
        """The arm in motion.

        Raises:
            ModelError: the model was identified from poses and has no `dynamics`.
        """
        if self.dynamics is None:
            raise ModelError("the model has no dynamics: it was identified from poses; identify a motion")
        return DynamicModel(self.arm, self.dynamics)

    def with_scaled_parameters(self, factors: ArrayLike) -> "IdentifiedModel":
        """What a wrong identification might have left: base parameters times `factors` (b,). Its `dynamics` stay."""
        scaled = zip(self.base_parameters, np.asarray(factors, float), strict=True)
        return replace(self, base_parameters=[replace(p, value=float(p.value * factor)) for p, factor in scaled])

    def holding_torque(self, q: ArrayLike) -> NDArray[np.float64]:
        """Torque [N m, N] on the joints that holds the arm: (n,) for q (n,), (m, n) for q (m, n)."""
        return self.feedforward_scale * self.static_model.torque(q, self.theta)


class ControlModel:
    """Gravity effort and mass matrix of one arm, evaluated fast enough for each tick of a control loop."""

    def __init__(self, model: IdentifiedModel, *, with_gravity: bool = True) -> None:
        """Compiles the gravity effort of `model` and reads its inertial parameters.

        Args:
            model: of the arm, mounted as it is. A model that was identified from poses has no inertias: those of the
                arm's SDF are used then.
            with_gravity: False for an arm that adds its own gravity compensation to all efforts: it needs none.

        Raises:
            ModelError: the model does not fit its arm.
        """
        model.check()
        self._torque_into = model.static_model.torque_into
        self._theta = np.ascontiguousarray(model.theta)
        self._scale = model.feedforward_scale * with_gravity
        if model.dynamics is None:
            self._regressor = DynamicRegressor(model.arm)
            self._parameters = self._regressor.values
        else:
            self._regressor, self._parameters = model.dynamic_model.regressor, model.dynamic_model.parameters

    def gravity_effort(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the effort (n,) [N m, N] that holds the arm at q (n,) [rad, m], a C-contiguous array."""
        effort = np.empty(len(q))
        self._torque_into(q, self._theta, effort)
        return effort * self._scale

    def mass_matrix(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the mass matrix (n, n) of the independent joints at q (n,) [rad, m], rotors included."""
        return self._regressor.mass_matrix(q[None], self._parameters)[0]


def _name_for(path: str | Path, arm: Arm) -> str:
    """Returns the name of the arm in the model file at `path`: a URL, or a path relative to that file."""
    if not os.path.isabs(arm.source):
        return f"{PACKAGE_URL}arms/{arm.source}.yaml"
    return os.path.relpath(arm.source, os.path.dirname(os.path.realpath(path)))


def _named_from(path: str | Path, name: str) -> str:
    """Returns the argument of `load_arm` for the arm that the model file at `path` calls `name`."""
    if not name.endswith((".yaml", ".yml")) or name.startswith(PACKAGE_URL):
        return name
    return os.path.join(os.path.dirname(os.path.realpath(path)), name)


def _nominal_dynamics(arm: Arm) -> DynamicSection:
    """What the arm's files state of its dynamics."""
    regressor = DynamicRegressor(arm)
    rotors = regressor.rotors[: arm.num_joints]
    drive = [*arm.effects.friction, *arm.effects.cables, *arm.effects.springs]
    gravity = [float(x) for x in arm.gravity]
    return DynamicSection(
        gravity=gravity,
        links=[LinkEstimate(link.link, link.parameters.tolist()) for link in regressor.links],
        rotors=[RotorEstimate(name, rotor.value) for name, rotor in zip(arm.joint_names, rotors, strict=True)],
        effects=[DriveEffect(e.coordinate, e.kind, e.scale, e.coefficient) for e in drive],
        signals=SignalSettings(
            acceleration_cut_off=list(arm.identification.acceleration_cut_off),
            effort_cut_off=arm.identification.effort_cut_off,
            effort_delay=list(arm.identification.effort_delay),
        ),
        gravity_expected=gravity,
    )
