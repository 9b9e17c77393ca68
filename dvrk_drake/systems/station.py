"""Station of several arms and other objects from a station file, simulated in one plant or real."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcmInterface
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import AddMultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.environment import add_directives
from dvrk_drake.models.files import read_text_input
from dvrk_drake.models.model_file import add_packages
from dvrk_drake.models.plant import Closure, add_arm, package_map
from dvrk_drake.systems.arm_drive import GRAVITY_TOLERANCE, ArmDrive, add_arm_drive, gravity_at_base
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.arm_station import export_arm, export_scene
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.station_config import StationArm, StationConfig


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
