"""Station of several arms and other objects from a station file, simulated in one plant or real.

This file has no postponed annotations, because yaml_load_typed reads the types at run time.
"""

import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Optional, cast, get_args

import numpy as np
import yaml
from numpy.typing import ArrayLike
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcmInterface
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect, effect_fault
from dvrk_drake.errors import ArmError, DvrkDrakeError, StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.arm_schema import GRAVITIES
from dvrk_drake.models.effects_schema import POSITION_KINDS, ArmEffects, DriveEffect
from dvrk_drake.models.environment import add_directives
from dvrk_drake.models.files import read_text_input
from dvrk_drake.models.model_file import add_packages
from dvrk_drake.models.plant import Closure, add_arm, package_map
from dvrk_drake.models.ranges import number_fault, within
from dvrk_drake.models.typed_yaml import load_yaml, typed_content
from dvrk_drake.systems.arm_drive import GRAVITY_TOLERANCE, ArmDrive, add_arm_drive, gravity_at_base
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.arm_station import arm_plant_config, export_arm, export_scene
from dvrk_drake.systems.driver import CrtkDriver, DvrkDriver
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
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


class Station(Diagram):
    """Arms of a station file. As with Drake's MakeHardwareStation, simulated and real arms have the same ports.

    .. pydrake_system::

        name: Station
        input_ports:
        - left.effort_commanded (optional)
        - left.effort_disturbance (optional)
        output_ports:
        - left.position_measured
        - left.velocity_estimated
        - left.state_estimated
        - left.effort_measured
        - left.state_true
        - plant_state
        - body_poses
        - query_object

    `left` stands for the name of each arm in the file. The ports are those of `ArmStation`, or of `HardwareArmStation`
    with `hardware`. All simulated arms and the objects of the directives are in one plant, with contact.

    Attributes:
        arms: Arms by name, with their gravity vectors as mounted. Controllers of this station use these arms.
        plant: The plant of arms and objects. With `hardware`, it is a model that is not in the Diagram.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pathlib import Path
        >>> file = Path("two_psms.yaml")
        >>> _ = file.write_text("arms: {psm1: {arm: psm}, psm2: {arm: psm, X_PB: {translation: [0.5, 0, 0]}}}")
        >>> station = dvrk.Station(dvrk.load_station_config(file))
        >>> context = station.CreateDefaultContext()
        >>> station.SetPositions(context, "psm2", [0.1, 0.2, 0.1, 0, 0, 0, 0.5])
        >>> station.GetOutputPort("psm2.state_true").Eval(context)[:3].round(3).tolist()
        [0.1, 0.2, 0.1]
    """

    def __init__(
        self,
        config: StationConfig,
        *,
        hardware: bool = False,
        meshcat: Meshcat | None = None,
        lcm: DrakeLcmInterface | None = None,
    ) -> None:
        """Builds the station. The simulated arms start at zero, or at the nearest pose inside their limits.

        Args:
            config: Configuration of the station; `simulator` is not used here.
            hardware: True for the real arms, False for simulated arms.
            meshcat: Meshcat in which simulated arms and objects are drawn. None: they are not drawn.
            lcm: LCM interface for real arms; see `HardwareArmStation`.

        Raises:
            StationError, ArmError: The configuration is not allowed.
        """
        super().__init__()
        config.check()
        builder = DiagramBuilder()
        try:
            self.plant, scene_graph = AddMultibodyPlant(config.plant, DiagramBuilder() if hardware else builder)
        except RuntimeError as error:  # a word that Drake does not know
            raise StationError(f"plant: {error}") from error
        if config.directives:
            packages = package_map()
            add_packages(packages, Path(config.directives).absolute().parent)
            text = read_text_input(config.directives, StationError)
            add_directives(self.plant, text, packages, config.directives, StationError)
        in_plant = {name: self._add_arm(name, entry) for name, entry in config.arms.items()}
        self.plant.Finalize()
        self.arms: dict[str, Arm] = {}
        self._drives: dict[str, ArmDrive] = {}
        for name, (instance, effects) in in_plant.items():
            entry, gravity = config.arms[name], gravity_at_base(self.plant, instance)
            # A file without gravity is that of an upright arm.
            stated, upright = entry.mounted_arm.gravity, self.plant.gravity_field().gravity_vector()
            if min(np.linalg.norm(stated - g) for g in (gravity, upright)) > GRAVITY_TOLERANCE:
                raise StationError(
                    f"arms.{name}: X_PB gives the gravity {(gravity.round(3) + 0.0).tolist()} m/s^2, but "
                    f"the file states {stated.round(3).tolist()}; correct X_PB.rpy or the gravity"
                )
            arm = self.arms[name] = entry.mounted_arm.with_gravity(gravity.tolist())
            if hardware:
                _add_real_arm(builder, name, HardwareArmStation(arm, driver=entry.ros_driver or entry.driver, lcm=lcm))
            else:
                self._drives[name] = add_arm_drive(builder, self.plant, arm, instance, effects, seed=entry.seed)
                export_arm(builder, name, self._drives[name])
        if not hardware:
            export_scene(builder, self.plant, scene_graph, meshcat, "station")
        builder.BuildInto(self)

    def SetPositions(self, context: Context, name: str, q: ArrayLike) -> None:
        """Sets the pose of a simulated arm to q (n,) [rad, m], as `ArmStation.SetPositions` does.

        Raises:
            StationError: q does not have n finite numbers.
        """
        self._drives[name].set_positions(self, context, q)

    def _add_arm(self, name: str, entry: StationArm) -> tuple[ModelInstanceIndex, PlantEffects | None]:
        """Adds an arm with its effects to the plant, as a model instance with this name."""
        arm, parent, closure = entry.mounted_arm, entry.X_PB.parent_frame, cast(Closure, entry.closure)
        try:
            frame = GetScopedFrameByName(self.plant, parent) if parent else self.plant.world_frame()
        except RuntimeError as error:
            raise StationError(f'arms.{name}.X_PB.parent_frame is "{parent}"; not a frame of the directives') from error
        instance = add_arm(self.plant, arm, frame, entry.X_PB.transform(), closure=closure)
        if self.plant.GetModelInstanceName(instance) != name:
            if self.plant.HasModelInstanceNamed(name):
                raise StationError(f"arms.{name}: there is another model of this name in the directives")
            self.plant.RenameModelInstance(instance, name)
        effects = entry.all_effects
        return instance, None if effects is None else PlantEffects(self.plant, arm, instance, effects)


def _add_real_arm(builder: DiagramBuilder, name: str, station: HardwareArmStation) -> None:
    """Adds the station of a real arm and exports its ports with the prefix `name`."""
    station.set_name(name)
    builder.AddSystem(station)
    for port in map(station.get_input_port, range(station.num_input_ports())):
        builder.ExportInput(port, f"{name}{port.get_name()[len(station.arm.name) :]}")
    for port in map(station.get_output_port, range(station.num_output_ports())):
        builder.ExportOutput(port, f"{name}{port.get_name()[len(station.arm.name) :]}")
