"""Configuration of a station, as a schema for Drake's yaml_load_typed.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Optional, get_args

import yaml
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.errors import ArmError, DvrkDrakeError, StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import GRAVITIES
from dvrk_drake.models.effects_schema import POSITION_KINDS, ArmEffects, DriveEffect
from dvrk_drake.models.plant import Closure
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.models.typed_yaml import load_yaml, typed_content
from dvrk_drake.systems.arm_station import arm_plant_config
from dvrk_drake.systems.driver import CrtkDriver, DvrkDriver
from dvrk_drake.systems.ideal_drive import plant_config_fault


@dataclass
class ArmConfig:
    """Arm of a station or of a scenario, and the options of its simulation.

    Attributes:
        arm: Name of an arm, or path of the arm's YAML file relative to the working directory.
        closure: Method that closes the loops of the linkage: "ball" or "mimic"; see `add_arm`.
        gravity: Gravity vector (3,) in the base frame [m/s^2]. None: the gravity vector of the arm.
        effects: Additional position-dependent effects in the drive of the simulated arm. Controllers do not model them.
        simulated_effects: Names of the arm's `effects` that are simulated; ["all"] for all of them.
        seed: Seed of all noise.
    """

    arm: str = ""
    closure: str = "mimic"
    gravity: list[float] | None = field(default=None, metadata=GRAVITIES)
    effects: list[DriveEffect] = field(default_factory=list)
    simulated_effects: list[str] = field(default_factory=list)
    seed: int = field(default=0, metadata=within(0, 2**63 - 1))

    @cached_property
    def mounted_arm(self) -> Arm:
        """Arm with the gravity vector of the configuration."""
        arm = load_arm(self.arm)
        return arm if self.gravity is None else arm.with_gravity(self.gravity)

    @property
    def all_effects(self) -> ArmEffects | None:
        """Effects of the simulated arm: `simulated_effects` and `effects`. None if there are none.

        Raises:
            ArmError: A name in `simulated_effects` is unknown.
        """
        if not (self.simulated_effects or self.effects):
            return None
        own = self.mounted_arm.effects.only(self.simulated_effects)
        return own.joined(ArmEffects(cables=self.effects))

    def arm_fault(self) -> str:
        """Describes the first field that is not valid for a simulation, or returns "" if all fields are valid.

        Raises:
            ArmError: The arm cannot be loaded.
        """
        if not self.arm:
            return "arm is missing; give an arm's name, or the path of its YAML file"
        arm = self.mounted_arm
        if self.closure not in get_args(Closure):
            return f'closure is "{self.closure}"; allowed: {", ".join(get_args(Closure))}'
        if fault := number_fault(self):
            return fault
        try:
            arm.effects.only(self.simulated_effects)
        except ArmError as error:
            return f"simulated arm: {error}"
        for i, effect in enumerate(self.effects):
            if fault := effect_fault(arm, ActuatorEffect.of(effect), POSITION_KINDS):
                return f"effects[{i}].{fault}"
        return ""


@dataclass
class BasePose:
    """Pose X_PB of an arm's base frame in a frame P.

    Attributes:
        parent_frame: Name of the frame P in the directives of the station, e.g. "table::top". If it is empty, P is the
            world frame.
        translation: Position of the base (3,) [m].
        rpy: Roll, pitch and yaw angle (3,) [rad], as in Drake's `RollPitchYaw`.
    """

    parent_frame: str = ""
    # Distances within a room, and angles of up to a full turn of either sign.
    translation: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0], metadata=within(-100.0, 100.0, "m"))
    rpy: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0], metadata=within(-6.3, 6.3, "rad"))

    def transform(self) -> RigidTransform:
        """Returns the pose.

        Raises:
            StationError: A field does not have three numbers.
        """
        if (lengths := (len(self.translation), len(self.rpy))) != (3, 3):
            raise StationError(f"X_PB: translation and rpy must have 3 numbers; got {lengths[0]} and {lengths[1]}")
        return RigidTransform(RollPitchYaw(self.rpy), self.translation)


@dataclass
class StationArm(ArmConfig):
    """One arm of a station. Real arms of the same kind need arm files with different names, or ROS namespaces.

    Attributes:
        X_PB: Pose of the base. The gravity vector in the base frame follows from it. `gravity` and the arm's file must
            not state another one.
        driver: Configuration of the hardware driver over LCM. Its paths are relative to the station file.
        ros_driver: Configuration of the hardware driver over ROS 2, which then replaces `driver`. None: LCM is used.
    """

    X_PB: BasePose = field(default_factory=BasePose)
    driver: DvrkDriver = field(default_factory=DvrkDriver)
    ros_driver: Optional[CrtkDriver] = None  # noqa: UP045, yaml_load_typed does not support "|"

    def check(self) -> None:
        """Checks the values, as `StationConfig.check` does."""
        if fault := self.arm_fault():
            raise StationError(fault)
        self.X_PB.transform()
        self.driver.check()
        if self.ros_driver is not None:
            self.ros_driver.check()


@dataclass
class StationConfig:
    """Schema of a station file: arms, simulated or real, and other objects; see `Station`.

    Attributes:
        arms: The arms. Their names are the prefixes of the station's ports.
        directives: File with Drake model directives of other objects, e.g. "table.dmd.yaml", relative to the station
            file. `package://` is searched beside this file and in ROS_PACKAGE_PATH. Empty: there are no other objects.
        plant: Configuration of the simulated plant. The default is `arm_plant_config()`.
        simulator: Configuration of the simulator. The caller applies it with `ApplySimulatorConfig`.
    """

    arms: dict[str, StationArm] = field(default_factory=dict)
    directives: str = ""
    plant: MultibodyPlantConfig = field(default_factory=arm_plant_config)
    simulator: SimulatorConfig = field(default_factory=SimulatorConfig)

    def check(self) -> None:
        """Checks the values.

        Raises:
            StationError: A value is not allowed. The message states the field, the value and the allowed range.
            ArmError: An arm cannot be loaded.
        """
        if not self.arms:
            raise StationError("arms is empty; give the arms by name, e.g. arms: {left: {arm: mtml}}")
        if fault := plant_config_fault(self.plant):
            raise StationError(f"plant.{fault}")
        for name, arm in self.arms.items():
            if not re.fullmatch(r"\w+", name):
                raise StationError(f'arms: the name "{name}" is not valid; allowed: letters, digits and _')
            try:
                arm.check()
            except DvrkDrakeError as error:
                raise type(error)(f"arms.{name}: {error}") from error


def load_station_config(path: str | Path) -> StationConfig:
    """Reads a station file with Drake's loader.

    Raises:
        StationError: The file cannot be read, or has an unknown key or a value that is not allowed.
        ArmError: An arm cannot be loaded.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pathlib import Path
        >>> file = Path("station.yaml")
        >>> _ = file.write_text("arms: {left: {arm: mtml, simulated_effects: [friction]}, right: {arm: mtmr}}")
        >>> list(dvrk.load_station_config(file).arms)
        ['left', 'right']
    """
    content = load_yaml(path, StationError)
    # Drake's messages name neither the section nor the accepted values.
    typed_content(StationConfig, content, str(path), StationError, "a station file")
    try:
        config: StationConfig = yaml_load_typed(schema=StationConfig, data=yaml.safe_dump(content, sort_keys=False))
        config.check()
    except ArmError as error:
        raise ArmError(f"{path}: {error}") from error
    except Exception as error:  # exceptions of Drake, YAML and the operating system
        raise StationError(f"{path}: {' '.join(str(error).split())}") from error
    folder = Path(path).parent
    if config.directives:
        config.directives = str(folder / config.directives)
    for arm in config.arms.values():
        arm.driver.relative_to(folder)
        if arm.ros_driver is not None:
            arm.ros_driver.relative_to(folder)
    return config
