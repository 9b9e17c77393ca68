"""Schema, validation and reader of scenario files.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from dvrk_drake.dynamics.friction_compensation import MAX_HYSTERESIS_RATIO, MAX_RATIO
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import ArmFrame
from dvrk_drake.errors import ScenarioError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import known_arms
from dvrk_drake.models.arm_schema import Gains, load_gains
from dvrk_drake.models.model_file import MODEL_SUFFIXES
from dvrk_drake.models.ranges import within
from dvrk_drake.models.typed_yaml import load_yaml, parse_yaml, typed_content
from dvrk_drake.systems.gravity_pid_controller import Mode
from dvrk_drake.systems.hand import Grip
from dvrk_drake.systems.station import ArmConfig

#: Maximum duration of a simulation [s] and minimum sample period of its recording [s].
MAX_LENGTH, MIN_SAMPLE_PERIOD = 3600.0, 1e-3
#: Coarse bounds of positions; `check_pose` checks the limits of the arm.
_POSITIONS = within(-1e4, 1e4, "rad or m")


@dataclass
class ControllerScenario:
    """Controller of the arm in a scenario.

    Attributes:
        mode: Mode of the controller: "hold", "gravity", "damped" or "guide".
        release_time: Time at which the controller changes from mode "hold" to `mode` [s]. 0: `mode` from the start.
        model: Path of a model file. If empty, the controller uses the model of the SDF.
        compensated_effects: Effects of the arm ("cables", "springs") that are added to the model of the SDF. Not
            allowed together with `model`.
        gains: Gains kp, kd, ki, one number per joint, instead of those of the arm file. In a scenario file, this can be
            the path of a gains file.
        friction_ratio: Share of the arm's friction that is compensated, in the modes "gravity" and "guide"; see
            `check_ratios`.
        hysteresis_ratio: Share of the wide hysteresis that is compensated, in the modes "gravity" and "guide"; see
            `safe_ratios`.
        parameter_error: Relative error of the model. Each base parameter is multiplied by a random factor between
            1 - `parameter_error` and 1 + `parameter_error`, drawn with the seed of the scenario.
    """

    mode: str = "hold"
    release_time: float = field(default=0.0, metadata=within(0.0, MAX_LENGTH, "s"))
    model: str = ""
    compensated_effects: list[str] = field(default_factory=list)
    gains: Gains | None = None
    friction_ratio: float = field(default=0.0, metadata=within(0.0, MAX_RATIO))
    hysteresis_ratio: float = field(default=0.0, metadata=within(0.0, MAX_HYSTERESIS_RATIO))
    parameter_error: float = field(default=0.0, metadata=within(0.0, 1.0))


@dataclass
class Target:
    """Desired pose at a given time. The desired velocity at this time is zero.

    Attributes:
        time: Time [s].
        pose: Positions (n,) of the joints [rad, m].
    """

    time: float = field(default=0.0, metadata=within(0.0, MAX_LENGTH, "s"))
    pose: list[float] = field(default_factory=list, metadata=_POSITIONS)


@dataclass
class HandScenario:
    """Hand that grasps the arm at a frame and moves the arm along a path; see `systems.hand`.

    The desired poses of `frame` are computed from the joint positions of `path`. The hand holds the arm from the first
    to the last time of the path. With an empty path there is no hand.

    Attributes:
        path: Joint positions and times.
        frame: Frame of the arm's SDF that the hand holds. Default: the frame `frames.hand` of the arm.
        grip: Stiffness, damping and limits of the grip.
    """

    path: list[Target] = field(default_factory=list)
    frame: str = ""
    grip: Grip = field(default_factory=Grip)


@dataclass
class Scenario(ArmConfig):
    """Schema of a scenario file. Repeated simulations of a scenario give bitwise identical results.

    The fields of `ArmConfig` describe the arm. `seed` is also the seed of the controller's parameter error.

    Attributes:
        time_step: Time step of the plant and period of the controller [s].
        duration: Duration of the simulation [s].
        sample_period: Sample period of the recording [s].
        controller: Controller of the arm.
        start: Start pose (n,) [rad, m], at rest. Default: zero, or the nearest pose inside the limits.
        targets: Desired poses with their times. The desired velocities are zero at these times. In modes other than
            "hold", targets are allowed only up to `controller.release_time`.
        hand: Hand that moves the arm.
        effort_noise: Standard deviation of the noise of recorded efforts, as a share of the effort limits.

    Example:
        >>> import dvrk_drake as dvrk
        >>> scenario = dvrk.Scenario(arm="psm", duration=0.1, simulated_effects=["friction"])
        >>> scenario.controller.mode = "gravity"
        >>> dvrk.simulate(scenario).recording.measured_effort().shape
        (11, 7)
    """

    closure: str = "ball"
    time_step: float = field(default=1e-3, metadata=within(1e-5, 0.01, "s"))
    duration: float = field(default=5.0, metadata=within(MIN_SAMPLE_PERIOD, MAX_LENGTH, "s"))
    sample_period: float = field(default=0.01, metadata=within(MIN_SAMPLE_PERIOD, MAX_LENGTH, "s"))
    controller: ControllerScenario = field(default_factory=ControllerScenario)
    start: list[float] | None = field(default=None, metadata=_POSITIONS)
    targets: list[Target] = field(default_factory=list)
    hand: HandScenario = field(default_factory=HandScenario)
    effort_noise: float = field(default=0.0, metadata=within(0.0, 1.0))

    @cached_property
    def model(self) -> IdentifiedModel:
        """Model used by the controller."""
        file, error = self.controller.model, self.controller.parameter_error
        effects = [
            effect for part in self.controller.compensated_effects for effect in getattr(self.mounted_arm.effects, part)
        ]
        model = (
            IdentifiedModel.load(file, self.mounted_arm)
            if file
            else IdentifiedModel.from_arm(self.mounted_arm, effects)
        )
        if error == 0.0:
            return model
        # This random stream differs from that of the noise, which uses only the seed.
        generator = np.random.default_rng([self.seed, 1])
        return model.with_scaled_parameters(generator.uniform(1 - error, 1 + error, len(model.base_parameters)))

    @property
    def regulated_until(self) -> float:
        """Time until which the controller regulates the desired positions [s]."""
        return self.duration if self.controller.mode == "hold" else self.controller.release_time

    def knots(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the times (m,) [s] and poses (m, n) [rad, m] of the start and the targets."""
        arm = self.mounted_arm
        home = np.clip(0.0, arm.position_lower, arm.position_upper)
        poses = [home if self.start is None else self.start, *(target.pose for target in self.targets)]
        return np.array([0.0, *(target.time for target in self.targets)]), np.array(poses, float)

    def check(self) -> None:
        """Checks that the scenario can be simulated.

        Raises:
            ScenarioError: A field is invalid. The message gives the field, its value, and the accepted values.
            ArmError, ModelError: The arm or the controller's model cannot be loaded.
        """
        if fault := self.arm_fault():
            raise ScenarioError(fault)
        arm = self.mounted_arm
        _check_choice("controller.mode", self.controller.mode, get_args(Mode))
        if self.duration < self.sample_period:
            raise ScenarioError(f"duration is {self.duration:g}; allowed: {self.sample_period:g}..{MAX_LENGTH:g} s")
        if self.controller.release_time >= self.duration:
            raise ScenarioError(
                f"controller.release_time is {self.controller.release_time:g} s; allowed: before the end of the "
                f"simulation at {self.duration:g} s"
            )
        if self.start is not None:
            check_pose("start", self.start, arm)
        self._check_targets("targets", self.targets, 0.0)
        self._check_targets("hand.path", self.hand.path, -1.0)
        self._check_hand()
        for part in self.controller.compensated_effects:
            _check_choice("controller.compensated_effects", part, ("cables", "springs"))
        if self.controller.compensated_effects and self.controller.model:
            raise ScenarioError(
                "controller.compensated_effects and controller.model exclude each other. Remove one of them."
            )
        if (gains := self.controller.gains) and (fault := arm.gains_fault(gains)):
            raise ScenarioError(f"controller.{fault}")
        for name in ("friction_ratio", "hysteresis_ratio"):
            if getattr(self.controller, name) and self.controller.mode not in ("gravity", "guide"):
                raise ScenarioError(
                    f'controller.{name} requires controller.mode "gravity" or "guide"; the mode is '
                    f'"{self.controller.mode}"'
                )
        if self.targets and self.targets[-1].time > self.regulated_until:
            raise ScenarioError(
                f'targets require controller.mode "hold" or a later controller.release_time; the mode is '
                f'"{self.controller.mode}" from {self.regulated_until:g} s on'
            )
        _ = self.model  # raises an error for a model of another arm

    def _check_targets(self, name: str, targets: list[Target], after: float) -> None:
        for i, target in enumerate(targets):
            check_pose(f"{name}[{i}].pose", target.pose, self.mounted_arm)
            if not after < target.time <= self.duration:
                earliest = "0 s or later" if after < 0 else f"after {after:g} s"
                raise ScenarioError(
                    f"{name}[{i}].time is {target.time:g} s; allowed: {earliest}, up to the duration of "
                    f"{self.duration:g} s"
                )
            after = target.time

    def _check_hand(self) -> None:
        if not self.hand.path:
            return
        ArmFrame(self.mounted_arm, self.hand.frame)
        if len(self.hand.path) < 2:
            raise ScenarioError(
                "hand.path must have 2 or more poses. The hand grasps the arm at the first pose and releases the arm "
                "at the last pose."
            )


def _check_choice(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ScenarioError(f'{name} is "{value}"; allowed: {", ".join(allowed)}')


def check_pose(name: str, pose: list[float], arm: Arm) -> None:
    """Checks that a pose is inside the limits of `arm`. Error messages start with `name`.

    Raises:
        ScenarioError: The pose does not have n finite numbers, or it is outside the limits.
    """
    n, q = arm.num_joints, np.array(pose, float)
    if len(q) != n:
        raise ScenarioError(
            f"{name} has {len(q)} number{'s' * (len(q) != 1)}; {arm.name} has {n} joints: {', '.join(arm.joint_names)}"
        )
    if not np.all(np.isfinite(q)):
        raise ScenarioError(f"{name} must be finite numbers; got {q.tolist()}")
    if violations := arm.limit_violations(q, 1e-9):
        message = f"{name}: {'; '.join(violations)} [rad, m] of {arm.name}"
        far = arm.prismatic & (np.abs(q) > 2 * arm.position_upper)
        if np.any(far) and np.all(np.abs(q[far]) / 1000 <= arm.position_upper[far]):
            message += f". Give {arm.joint_names[int(np.argmax(far))]} in m, not in mm."
        raise ScenarioError(message)


def load_scenario(arm_or_file: str, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario, applies settings to it, and checks it.

    If an arm is given instead of a scenario file, the controller regulates the default start pose of `Scenario`.

    Args:
        arm_or_file: Path of a scenario file, name of an arm, or path of an arm file or a model file.
        settings: Settings "key=value", with the value in YAML. A dot separates a group from a key, e.g.
            "controller.mode=gravity".

    Raises:
        ScenarioError: The file cannot be read, has an unknown key, or has an invalid value.

    Example:
        >>> import dvrk_drake as dvrk
        >>> scenario = dvrk.load_scenario("mtml", ["duration=2", "controller.mode=damped"])
        >>> scenario.duration, scenario.controller.mode
        (2.0, 'damped')
    """
    path = Path(arm_or_file)
    if path.name.lower().endswith(MODEL_SUFFIXES):
        content = {"arm": arm_or_file}
    elif path.suffix.lower() in (".yaml", ".yml"):
        content = load_yaml(path, ScenarioError)
        if isinstance(content, dict) and content.keys() & {"mechanism", "sdf"}:
            content = {"arm": arm_or_file}
    elif path.suffix:
        raise ScenarioError(
            f"{arm_or_file} is not a scenario: its name does not end in .yaml. Give a scenario file, or an arm: "
            f"{', '.join(known_arms())}, or a model file"
        )
    else:
        content = {"arm": arm_or_file}
    if isinstance(content, dict):
        for setting in settings:
            _apply_setting(content, setting)
        _load_gains_of(content)
    scenario = typed_content(Scenario, content, arm_or_file, ScenarioError, "a scenario")
    try:
        scenario.check()
    except ScenarioError as error:
        raise ScenarioError(f"{arm_or_file}: {error}") from error
    return scenario


def _load_gains_of(content: dict[str, Any]) -> None:
    """Replaces the path of a gains file by the contents of the file."""
    controller = content.get("controller")
    if isinstance(controller, dict) and isinstance(controller.get("gains"), str):
        controller["gains"] = dataclasses.asdict(load_gains(controller["gains"]))


def _apply_setting(content: dict[str, Any], setting: str) -> None:
    key, equals, value = setting.partition("=")
    if not equals or not key:
        raise ScenarioError(
            f'--set {setting}: a setting must be key=value, e.g. "duration=2" or "controller.mode=gravity"'
        )
    *groups, last = key.strip().split(".")
    group: Any = content
    for name in groups:
        group = group.setdefault(name, {})
        if not isinstance(group, dict):
            raise ScenarioError(f"--set {setting}: {name} is not a group and has no keys")
    group[last] = parse_yaml(value, f"--set {setting}", ScenarioError)
