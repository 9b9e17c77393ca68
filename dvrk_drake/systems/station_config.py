"""Which station there is, as a schema for Drake's yaml_load_typed, and the station that it describes.

No postponed annotations here: yaml_load_typed reads the types at run time.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import cast, get_args

import yaml
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcmInterface
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig

from dvrk_drake.dynamics.actuator_effects import POSITION_KINDS, ActuatorEffect, effect_fault
from dvrk_drake.errors import ArmError, StationError
from dvrk_drake.models.arm import Arm, load_arm
from dvrk_drake.models.arm_schema import GRAVITIES
from dvrk_drake.models.effects_schema import ArmEffects, Cable, DriveEffect
from dvrk_drake.models.loop_closure import Closure
from dvrk_drake.models.schema_fault import formerly, number_fault, with_current_keys, within
from dvrk_drake.models.typed_yaml import load_yaml
from dvrk_drake.systems.arm_station import ArmStation, arm_plant_config, plant_config_fault
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver


@dataclass
class ArmConfig:
    """The arm of a station or of a scenario, and how it is simulated.

    Attributes:
        arm: name, or path of an arm's YAML file; paths are relative to the folder that the command runs in.
        closure: how the linkage's loops are held: "ball" or "mimic".
        gravity: (3,) in the base frame [m/s^2]; the arm's own if left out.
        effects: more of them in the drive of the simulated arm, of position alone; controllers do not know them.
        stretch: actuator -> cable of the simulated arm that stretches, beside those of `simulated_effects`.
        simulated_effects: parts of the arm's own `effects` that the simulation has, by name; ["all"] for all of them.
        seed: of all noise.
    """

    arm: str = ""
    closure: str = "mimic"
    gravity: list[float] | None = field(default=None, metadata=GRAVITIES)
    effects: list[DriveEffect] = field(default_factory=list)
    stretch: dict[str, Cable] = field(default_factory=dict)
    simulated_effects: list[str] = field(default_factory=list, metadata=formerly("real_arm"))
    seed: int = field(default=0, metadata=within(0, 2**63 - 1))

    @cached_property
    def mounted_arm(self) -> Arm:
        """The arm, with gravity from where the file says."""
        arm = load_arm(self.arm)
        return arm if self.gravity is None else arm.with_gravity(self.gravity)

    @property
    def all_effects(self) -> ArmEffects | None:
        """What the simulated arm has beside its links: `simulated_effects`, `effects` and `stretch`; None if there is nothing.

        Raises:
            ArmError: a name that is no part.
        """
        if not (self.simulated_effects or self.effects or self.stretch):
            return None
        own = self.mounted_arm.effects.only(self.simulated_effects)
        return own.joined(ArmEffects(cables=self.effects, stretch=self.stretch))

    def arm_fault(self) -> str:
        """The first thing here that cannot be simulated: a number of any field, closure or effects; or "".

        Raises:
            ArmError: the arm cannot be loaded.
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
    """Schema of a station's file: one arm, simulated or the hardware.

    Attributes:
        plant: of the simulation; what a file leaves out is as in `arm_plant_config`.
        simulator: for `ApplySimulatorConfig`, by whoever simulates the station.
        driver: of the hardware; files that it names are relative to the station's file.
    """

    plant: MultibodyPlantConfig = field(default_factory=arm_plant_config)
    simulator: SimulatorConfig = field(default_factory=SimulatorConfig)
    driver: DvrkDriver = field(default_factory=DvrkDriver)

    def check(self) -> None:
        """Checks the values.

        Raises:
            StationError: names the field, its value, and what is allowed.
            ArmError: the arm cannot be loaded.
        """
        if fault := self.arm_fault():
            raise StationError(fault)
        if fault := plant_config_fault(self.plant):
            raise StationError(f"plant.{fault}")
        self.driver.check()


def load_station_config(path: str | Path) -> StationConfig:
    """Reads a station's file with Drake's loader.

    Raises:
        StationError: it cannot be read, has an unknown key, or a value that is not allowed.
        ArmError: the arm cannot be loaded.
    """
    content = with_current_keys(StationConfig, load_yaml(path, StationError), str(path))
    try:
        config: StationConfig = yaml_load_typed(schema=StationConfig, data=yaml.safe_dump(content))
        config.check()
    except ArmError as error:
        raise ArmError(f"{path}: {error}") from error
    except Exception as error:  # of many types: Drake's, YAML's, the system's
        raise StationError(f"{path}: {' '.join(str(error).split())}") from error
    config.driver.relative_to(Path(path).parent)
    return config


def make_arm_station(
    config: StationConfig,
    *,
    hardware: bool = False,
    meshcat: Meshcat | None = None,
    lcm: DrakeLcmInterface | None = None,
) -> ArmStation | HardwareArmStation:
    """Returns the station of `config`, as Drake's MakeHardwareStation: a controller uses the same ports of both.

    Args:
        config: what it is; `simulator` is not read here.
        hardware: the arm itself instead of its simulation.
        meshcat: draws the simulated arm.
        lcm: of the hardware, see `HardwareArmStation`.

    Raises:
        StationError, ArmError: the configuration is not allowed.
    """
    config.check()
    if hardware:
        return HardwareArmStation(config.mounted_arm, driver=config.driver, lcm=lcm)
    return ArmStation(
        config.mounted_arm,
        plant_config=config.plant,
        meshcat=meshcat,
        closure=cast(Closure, config.closure),
        effects=config.all_effects,
        seed=config.seed,
    )
