"""Simulation of one arm with the same ports as the station of the real arm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Role, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.plant import Closure, add_arm
from dvrk_drake.systems.arm_drive import ArmDrive, add_arm_drive
from dvrk_drake.systems.arm_effects.dry_friction import PlantEffects
from dvrk_drake.systems.ideal_drive import plant_config_fault


@dataclass(frozen=True)
class StationPorts:
    """Ports of a station with one arm, in simulation and on hardware.

    Attributes:
        inputs: Sizes of the input ports by name.
        outputs: Sizes of the output ports by name.
    """

    inputs: dict[str, int]
    outputs: dict[str, int]


def station_ports(arm: Arm) -> StationPorts:
    """Returns the ports of a station. Their names are those of Drake's iiwa driver with the arm's name as a prefix.

    Each port has n numbers, or 2n for a state, in the arm's order of joints [rad, rad/s, N m; m, m/s, N].

    Raises:
        ArmError: The arm has locked joints.
    """
    arm.refuse_locked_joints("a station")
    n, name = arm.num_joints, arm.name.lower()
    return StationPorts(
        inputs={f"{name}.effort_commanded": n},
        outputs={
            f"{name}.position_measured": n,
            f"{name}.velocity_estimated": n,
            f"{name}.state_estimated": 2 * n,
            f"{name}.effort_measured": n,
        },
    )


def arm_plant_config(time_step: float = 1e-3) -> MultibodyPlantConfig:
    """Returns the default configuration of a station's plant, with the given time step [s].

    The contact solver is SAP. Sampled output ports are disabled, so the plant outputs the state at the start of a step.
    """
    return MultibodyPlantConfig(
        time_step=time_step, discrete_contact_approximation="sap", use_sampled_output_ports=False
    )


class ArmStation(Diagram):
    """Simulated arm. `HardwareArmStation` has the same ports for a real arm over LCM.

    .. pydrake_system::

        name: ArmStation
        input_ports:
        - mtml.effort_commanded (optional)
        - mtml.effort_disturbance (optional)
        output_ports:
        - mtml.position_measured
        - mtml.velocity_estimated
        - mtml.state_estimated
        - mtml.effort_measured
        - mtml.state_true
        - plant_state
        - body_poses
        - query_object

    `mtml` stands for the arm's lower-case name. The arm's ports have n numbers for the independent joints, in the arm's
    order [rad, rad/s, N m; m, m/s, N on a prismatic joint]. `state_estimated` has 2n numbers: q, then v.

    - `effort_commanded`: commanded effort, clamped to the plant's effort limits. Unconnected: zero effort.
    - `effort_disturbance`: additional joint effort, e.g. of a hand. The effort limits do not apply to it. Unconnected:
      zero effort.
    - `effort_measured`: measured motor effort. Without `effects`, it is the clamped command.
    - `state_true` (2n): true q, then true v, i.e. without sensor effects.
    - `plant_state`, `body_poses`, `query_object`: ports of the plant.

    The ports `effort_disturbance`, `state_true` and those of the plant exist only in simulation. All other ports are
    those of `station_ports`.

    **Effects.** Without `effects`, measured values are exact and without delay. The station then consists of C++
    systems, and only the plant has state. `effects` adds friction, cables, stops, encoders, motors and delays of a real
    arm; see `ArmEffects`.

    **Timing.** A discrete controller receives the state at the start of a period. Its command acts from the next period
    on, i.e. with a delay of one period as on hardware.

    **Constraints.** For both values of `closure`, Drake's solver closes the linkage with an error of about 1e-8 m at a
    time step of 1 ms. It also enforces the position limits of the joints. The effect `stops` adds the coupled limits.
    The links of an arm do not collide with each other. The links have collision shapes only if `modify_plant` adds a
    shape that they can touch.

    Example:
        >>> import dvrk_drake as dvrk
        >>> arm = dvrk.load_arm("psm")
        >>> station = dvrk.ArmStation(arm, effects=arm.effects.only(["friction"]))
        >>> context = station.CreateDefaultContext()
        >>> station.SetPositions(context, [0.1, 0.2, 0.1, 0, 0, 0, 0.5])
        >>> station.GetOutputPort("psm.position_measured").Eval(context).round(3).tolist()
        [0.1, 0.2, 0.1, 0.0, 0.0, 0.0, 0.5]
    """

    def __init__(
        self,
        arm: Arm,
        *,
        plant_config: MultibodyPlantConfig | None = None,
        meshcat: Meshcat | None = None,
        closure: Closure = "mimic",
        plant_arm: Arm | None = None,
        modify_plant: Callable[[MultibodyPlant], None] | None = None,
        effects: ArmEffects | None = None,
        seed: int = 0,
    ) -> None:
        """Builds the station. The arm starts at zero, or at the nearest pose inside its limits.

        Args:
            arm: Arm that defines the names of the ports. Controllers of this station use the same arm.
            plant_config: Configuration of the plant. None: `arm_plant_config()`.
            meshcat: Meshcat in which the arm is drawn. The path in Meshcat begins with the arm's lower-case name.
                `SetTransform("mtml", X_WB)` places the arm. None: the arm is not drawn.
            closure: Method that closes the loops of the linkage; see `add_arm`.
            plant_arm: Arm to simulate. Its gravity direction or SDF may differ from that of `arm`, but its joints must
                be the same. None: `arm`.
            modify_plant: Function that receives the plant before `Finalize`, e.g. to add a payload or damping. Drake
                can change the inertia of existing links only in a Context; see `SetLinkInertias`.
            effects: Simulated effects of the real arm, e.g. `arm.effects` or `arm.effects.only(["friction"])`. None: no
                effects.
            seed: Seed of the effects' noise.

        Raises:
            StationError: The configuration of the plant is not valid for an arm, or `plant_arm` has other joints.
        """
        super().__init__()
        arm.refuse_locked_joints("a station")
        self._arm, simulated = arm, plant_arm or arm
        plant_config = plant_config or arm_plant_config()
        if fault := plant_config_fault(plant_config):
            raise StationError(fault)
        if simulated.joint_names != arm.joint_names:
            raise StationError(
                f"plant_arm must have the joints of {arm.name}: {', '.join(arm.joint_names)}; "
                f"{simulated.name} has {', '.join(simulated.joint_names)}"
            )
        builder = DiagramBuilder()
        self._plant, self._scene_graph = AddMultibodyPlant(plant_config, builder)
        # The plant contains only the arm, so the arm has contacts only with bodies that `modify_plant` adds.
        self._plant.mutable_gravity_field().set_gravity_vector(simulated.gravity)
        instance = add_arm(self._plant, simulated, closure=closure, collision_shapes=modify_plant is not None)
        if modify_plant is not None:
            modify_plant(self._plant)
        in_plant = None if effects is None else PlantEffects(self._plant, simulated, instance, effects)
        self._plant.Finalize()
        self._drive = add_arm_drive(builder, self._plant, simulated, instance, in_plant, seed=seed)
        export_arm(builder, arm.name.lower(), self._drive)
        # At its start, the visualizer deletes its own path, but not the parent path. An earlier SetTransform of the
        # parent path therefore remains valid.
        export_scene(builder, self._plant, self._scene_graph, meshcat, f"{arm.name.lower()}/links")
        builder.BuildInto(self)
        self.set_name(f"{arm.name.lower()}_station")

    @property
    def arm(self) -> Arm:
        """Arm that defines the names and order of the ports."""
        return self._arm

    @property
    def plant(self) -> MultibodyPlant:
        """The simulated plant."""
        return self._plant

    def SetPositions(self, context: Context, q: ArrayLike) -> None:
        """Sets the independent joints to the pose q (n,), the linkage to a consistent pose, and its velocities to zero.

        Args:
            context: Context of this station, not of a Diagram that contains it.
            q: Pose (n,) [rad, m], which may be outside the limits.

        Raises:
            StationError: q does not have n finite numbers.
        """
        self._drive.set_positions(self, context, q)

    def GetPositions(self, context: Context) -> NDArray[np.float64]:
        """Returns the pose (n,) [rad, m] of the independent joints in this station's context."""
        plant_context = self.GetSubsystemContext(self.plant, context)
        q: NDArray[np.float64] = self.plant.GetPositions(plant_context, self._drive.instance)[self._drive.joints.index]
        return q

    def SetLinkInertias(self, context: Context, inertias: Mapping[str, SpatialInertia]) -> None:
        """Changes the inertia of links in this station's context, to simulate an arm that differs from its model.

        Args:
            context: Context of this station.
            inertias: Spatial inertia M_LLo_L [kg, m, kg m^2] about the link's origin in the link's frame, by link name.

        Raises:
            StationError: The arm has no link with one of the given names.
        """
        plant_context = self.GetMutableSubsystemContext(self.plant, context)
        bodies = {self.plant.get_body(i).name(): i for i in self.plant.GetBodyIndices(self._drive.instance)}
        if unknown := sorted(set(inertias) - set(bodies)):
            raise StationError(f"unknown link {', '.join(unknown)}; known links: {', '.join(bodies)}")
        for name, M_LLo_L in inertias.items():
            self.plant.get_body(bodies[name]).SetSpatialInertiaInBodyFrame(plant_context, M_LLo_L)


def export_arm(builder: DiagramBuilder, name: str, drive: ArmDrive) -> None:
    """Exports the ports of an arm with the prefix `name`; see `ArmStation`."""
    for port in ("effort_commanded", "effort_disturbance"):
        builder.ExportInput(getattr(drive, port), f"{name}.{port}")
    for port in ("effort_measured", "state_true", "state_estimated"):
        builder.ExportOutput(getattr(drive, port), f"{name}.{port}")
    halves = np.split(np.eye(2 * drive.arm.num_joints), 2)
    for port, D in zip(("position_measured", "velocity_estimated"), halves, strict=True):
        select = builder.AddNamedSystem(f"{name}_{port}", MatrixGain(D=D))
        builder.Connect(drive.state_estimated, select.get_input_port())
        builder.ExportOutput(select.get_output_port(), f"{name}.{port}")


def export_scene(
    builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph, meshcat: Meshcat | None, path: str
) -> None:
    """Exports the ports of a plant, see `ArmStation`, and draws the plant in Meshcat below a path.

    All collision shapes are removed if no two of them can collide. They would slow down every step.
    """
    inspector = scene_graph.model_inspector()
    if not inspector.GetCollisionCandidates():
        for shape in inspector.GetAllGeometryIds(Role.kProximity):
            scene_graph.RemoveRole(plant.get_source_id(), shape, Role.kProximity)
    if meshcat is not None:
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, MeshcatVisualizerParams(prefix=path))
    builder.ExportOutput(plant.get_state_output_port(), "plant_state")
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
    builder.ExportOutput(scene_graph.get_query_output_port(), "query_object")
