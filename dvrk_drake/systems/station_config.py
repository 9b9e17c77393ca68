"""Configuration of a station, as a schema for Drake's yaml_load_typed, and creation of the station.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Optional, cast, get_args

import yaml
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcmInterface
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.errors import ArmError, StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import GRAVITIES
from dvrk_drake.models.effect_kinds import POSITION_KINDS
from dvrk_drake.models.effects_schema import ArmEffects, Cable, DriveEffect
from dvrk_drake.models.loop_closure import Closure
from dvrk_drake.models.schema_fault import number_fault, schema_fault, within
from dvrk_drake.models.typed_yaml import load_yaml
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config, plant_config_fault
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.ros.crtk_driver import CrtkDriver


@dataclass
class ArmConfig:
    """Arm of a station or of a scenario, and the options of its simulation.

    Attributes:
        arm: Name of an arm, or path of the arm's YAML file relative to the working directory.
        closure: Method that closes the loops of the linkage: "ball" or "mimic"; see `add_arm`.
        gravity: Gravity vector (3,) in the base frame [m/s^2]. None: the gravity vector of the arm.
        effects: Additional position-dependent effects in the drive of the simulated arm. Controllers do not model them.
        stretch: Additional elastic cables of the simulated arm, by name of the actuator.
        simulated_effects: Names of the arm's `effects` that are simulated; ["all"] for all of them.
        seed: Seed of all noise.
    """

    arm: str = ""
    closure: str = "mimic"
    gravity: list[float] | None = field(default=None, metadata=GRAVITIES)
    effects: list[DriveEffect] = field(default_factory=list)
    stretch: dict[str, Cable] = field(default_factory=dict)
    simulated_effects: list[str] = field(default_factory=list)
    seed: int = field(default=0, metadata=within(0, 2**63 - 1))

    @cached_property
    def mounted_arm(self) -> Arm:
        """Arm with the gravity vector of the configuration."""
        arm = load_arm(self.arm)
        return arm if self.gravity is None else arm.with_gravity(self.gravity)

    @property
    def all_effects(self) -> ArmEffects | None:
        """Effects of the simulated arm: `simulated_effects`, `effects` and `stretch`. None if there are none.

        Raises:
            ArmError: A name in `simulated_effects` is unknown.
        """
        if not (self.simulated_effects or self.effects or self.stretch):
            return None
        own = self.mounted_arm.effects.only(self.simulated_effects)
        return own.joined(ArmEffects(cables=self.effects, stretch=self.stretch))

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
            ArmEffects(stretch=self.stretch).check(arm.joint_names)
        except ArmError as error:
            return f"simulated arm: {error}"
        for i, effect in enumerate(self.effects):
            if fault := effect_fault(arm, ActuatorEffect.of(effect), POSITION_KINDS):
                return f"effects[{i}].{fault}"
        return ""


@dataclass
class StationConfig(ArmConfig):
    """Schema of a station file: one arm, simulated or real.

    Attributes:
        plant: Configuration of the simulated plant. The default is `arm_plant_config()`.
        simulator: Configuration of the simulator. The caller applies it with `ApplySimulatorConfig`.
        driver: Configuration of the hardware driver over LCM. Its paths are relative to the station file.
        ros_driver: Configuration of the hardware driver over ROS 2, which then replaces `driver`. None: LCM is used.
    """

    plant: MultibodyPlantConfig = field(default_factory=arm_plant_config)
    simulator: SimulatorConfig = field(default_factory=SimulatorConfig)
    driver: DvrkDriver = field(default_factory=DvrkDriver)
    ros_driver: Optional[CrtkDriver] = None  # noqa: UP045, yaml_load_typed does not support "|"

    def check(self) -> None:
        """Checks the values.

        Raises:
            StationError: A value is not allowed. The message states the field, the value and the allowed range.
            ArmError: The arm cannot be loaded.
        """
        if fault := self.arm_fault():
            raise StationError(fault)
        if fault := plant_config_fault(self.plant):
            raise StationError(f"plant.{fault}")
        self.driver.check()
        if self.ros_driver is not None:
            self.ros_driver.check()


def load_station_config(path: str | Path) -> StationConfig:
    """Reads a station file with Drake's loader.

    Raises:
        StationError: The file cannot be read, or has an unknown key or a value that is not allowed.
        ArmError: The arm cannot be loaded.
    """
    content = load_yaml(path, StationError)
    for key, schema in (("driver", DvrkDriver), ("ros_driver", CrtkDriver)):
        section = content.get(key) if isinstance(content, dict) else None
        # Drake's messages name neither the section nor the accepted values.
        if section is not None and (fault := schema_fault(schema, section, key)):
            raise StationError(f"{path}: {key}: {fault}")
    try:
        config: StationConfig = yaml_load_typed(schema=StationConfig, data=yaml.safe_dump(content))
        config.check()
    except ArmError as error:
        raise ArmError(f"{path}: {error}") from error
    except Exception as error:  # exceptions of Drake, YAML and the operating system
        raise StationError(f"{path}: {' '.join(str(error).split())}") from error
    for driver in (config.driver, config.ros_driver):
        if driver is not None:
            driver.relative_to(Path(path).parent)
    return config


def make_arm_station(
    config: StationConfig,
    *,
    hardware: bool = False,
    meshcat: Meshcat | None = None,
    lcm: DrakeLcmInterface | None = None,
) -> ArmStation | HardwareArmStation:
    """Creates a station. As with Drake's MakeHardwareStation, the simulated and the real arm have the same ports.

    Args:
        config: Configuration of the station; `simulator` is not used here.
        hardware: True for the real arm, False for a simulated arm.
        meshcat: Meshcat in which the simulated arm is drawn. None: the arm is not drawn.
        lcm: LCM interface for the real arm; see `HardwareArmStation`.

    Raises:
        StationError, ArmError: The configuration is not allowed.
    """
    config.check()
    if hardware:
        return HardwareArmStation(config.mounted_arm, driver=config.ros_driver or config.driver, lcm=lcm)
    return ArmStation(
        config.mounted_arm,
        plant_config=config.plant,
        meshcat=meshcat,
        closure=cast(Closure, config.closure),
        effects=config.all_effects,
        seed=config.seed,
    )
