"""One arm behind the ports that its driver has: the same names in simulation and on hardware."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.lcm import DrakeLcmInterface
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain

from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.loop_closure import Closure
from dvrk_drake.models.plant import add_arm, set_arm_positions, tree_selector
from dvrk_drake.systems.arm_effects.drive_step import DriveStep
from dvrk_drake.systems.arm_effects.plant_effects import PlantEffects
from dvrk_drake.systems.arm_effects.real_drive import RealDrive, add_real_drive
from dvrk_drake.systems.ideal_drive import DrivePorts, add_ideal_drive
from dvrk_drake.systems.lcm.arm_connection import connect_arm
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.plant_joints import PlantJoints


@dataclass(frozen=True)
class StationPorts:
    """Name -> size of the ports that a station of one arm has, in simulation and on hardware alike."""

    inputs: dict[str, int]
    outputs: dict[str, int]


def station_ports(arm: Arm) -> StationPorts:
    """The ports of `arm`'s station, named like the fields of the iiwa's driver in Drake.

    Prefixed with the arm's lower-case name; n numbers in the arm's order of joints [rad, rad/s, N m; m, m/s,
    N].
    """
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


class ArmStation(Diagram):
    """An arm with the ports of its driver: simulated, or the arm itself over LCM.

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

    `mtml` stands for the arm's lower-case name. The arm's ports have n numbers (`state_estimated` 2n: q, then
    v) for the independent joints, in the arm's order [rad, rad/s, N m; m, m/s, N on a prismatic joint]; the
    linkage follows them.

    - `effort_commanded`: clamped to the plant's effort limits. Unconnected: zero, a limp arm.
    - `effort_disturbance`: added behind the motors and not clamped: friction, cables, a hand. Unconnected:
      zero.
    - `effort_measured`: what the motors apply, the command after the clamp.
    - `state_true` (2n): q, then v as they are, whatever `effects` make of what is measured.
    - `plant_state`, `body_poses`, `query_object`: the plant's own, of the whole tree. Simulation only, as are
      `state_true` and `effort_disturbance`; all others are those of `station_ports`.

    Without `effects` all of it is C++ and has no state but the plant's, and measured values are exact and undelayed.
    `effects` are those of a real arm, see `ArmEffects`: friction, cables, stops, encoders, motors and delays as
    `arm.effects` states them. A discrete controller beside the station sees the arm as it is when the period starts,
    and its command acts from the next one on: it is a period late, as on hardware.

    Drake's solver holds the linkage to about 1e-8 m at 1 ms with either `closure`, and each joint in its position
    limits; the coupled limits of the linkage are there with the effect `stops`. An arm's shapes never touch each other:
    they are collision shapes only where `modify_plant` adds one that they can touch.

    **On hardware** the ports of `station_ports` are all there are. Measured values are those of the last DVRK_STATUS
    message, NaN before the first. Efforts go out in DVRK_COMMAND messages every `driver.status_period` and on forced
    publishing, and the arm's command guard decides what becomes of them; unconnected, the arm is told to hold. After
    the guard's watchdog took over, e.g. because this process was stopped for 50 ms, efforts act again only when an
    operator resumes: end this process, look at the arm, run `dvrk-drake run --reset`, end that, start this one again.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        hardware: bool = False,
        time_step: float = 1e-3,
        meshcat: Meshcat | None = None,
        closure: Closure = "mimic",
        plant_arm: Arm | None = None,
        modify_plant: Callable[[MultibodyPlant], None] | None = None,
        effects: ArmEffects | None = None,
        seed: int = 0,
        driver: DvrkDriver | None = None,
        lcm: DrakeLcmInterface | None = None,
    ) -> None:
        """Builds the station; the arm starts at zero, or at the nearest pose inside its limits.

        Args:
            arm: names the ports, and is the arm that controllers of this station know.
            hardware: the arm itself instead of its simulation: of the other arguments only `driver` and `lcm` count.
            time_step: of the plant [s].
            meshcat: draws the arm there, below the path of its lower-case name: `SetTransform("mtml", X_WB)` places
            it.
            closure: how the linkage's loops are held, see `add_arm`.
            plant_arm: the arm that is simulated, `arm` by default: another mounting or SDF with the same
            joints.
            modify_plant: called with the plant before it is finalized, e.g. to add a payload, damping or
            other effort limits.
                Drake can change the inertia of links that are already there only in a Context:
                `SetLinkInertias`.
            effects: of the real arm that the simulation shall have, e.g. `arm.effects` or
            `arm.effects.only(["friction"])`; none by default.
            seed: of the effects' noise.
            driver: how the hardware is driven; `DvrkDriver()` by default.
            lcm: whose `HandleSubscriptions` somebody else calls, for loops that are driven by messages; by default one
                at `driver.lcm_url` that a Simulator of this station handles.

        Raises:
            StationError: something that only a simulation has is asked of the hardware or the other way round, the time
            step is not positive, or `plant_arm` has other joints.
        """
        super().__init__()
        self._arm = arm
        self._true_arm = plant_arm or arm
        self._plant: MultibodyPlant | None = None
        self._parts: PlantEffects | None = None
        self._drive_step: DriveStep | None = None
        builder = DiagramBuilder()
        if hardware:
            of_a_simulation = (time_step, meshcat, closure, plant_arm, modify_plant, effects)
            if of_a_simulation != (1e-3, None, "mimic", None, None, None):
                raise StationError(
                    "time_step, meshcat, closure, plant_arm, modify_plant and effects are of a simulation: "
                    "use hardware=False"
                )
            self._connect_hardware(builder, driver or DvrkDriver(), lcm)
        else:
            if driver is not None or lcm is not None:
                raise StationError("driver and lcm are of hardware; apply_driver_config puts a simulation behind LCM")
            self._simulate(builder, time_step, meshcat, closure, modify_plant, effects, seed)
        builder.BuildInto(self)
        self.set_name(f"{arm.name.lower()}_station")

    def _connect_hardware(self, builder: DiagramBuilder, driver: DvrkDriver, lcm: DrakeLcmInterface | None) -> None:
        receiver, sender = connect_arm(builder, self._arm, driver, lcm)
        name, ports = self._arm.name.lower(), station_ports(self._arm)
        builder.ExportInput(sender.GetInputPort("effort"), f"{name}.effort_commanded")
        for port in ports.outputs:
            builder.ExportOutput(receiver.GetOutputPort(port.removeprefix(f"{name}.")), port)

    def _simulate(
        self,
        builder: DiagramBuilder,
        time_step: float,
        meshcat: Meshcat | None,
        closure: Closure,
        modify_plant: Callable[[MultibodyPlant], None] | None,
        effects: ArmEffects | None,
        seed: int,
    ) -> None:
        arm, true_arm = self._arm, self._true_arm
        if not 0 < time_step <= 0.01:
            raise StationError(
                f"time_step must be above 0 and at most 0.01 s: the wrist is lost above; got {time_step}"
            )
        if true_arm.joint_names != arm.joint_names:
            raise StationError(
                f"plant_arm must have the joints of {arm.name}: {', '.join(arm.joint_names)}; "
                f"{true_arm.name} has {', '.join(true_arm.joint_names)}"
            )
        self._plant, self._scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=time_step)
        # Nothing else is in the plant, so nothing touches the arm unless somebody adds it.
        self._instance = add_arm(self.plant, true_arm, closure, collision_shapes=modify_plant is not None)
        if modify_plant is not None:
            modify_plant(self.plant)
        # Otherwise Drake steps the plant before all discrete updates, and what they measure is from after the step.
        self.plant.SetUseSampledOutputPorts(False)
        if effects is not None:
            self._parts = PlantEffects(self.plant, true_arm, self._instance, effects)
        self.plant.Finalize()
        self._drop_idle_shapes()
        self._joints = PlantJoints(self.plant, true_arm, self._instance)
        self._set_default_pose()
        if meshcat is not None:
            # The visualizer deletes its prefix when it starts: one level down, so that a SetTransform stays.
            parameters = MeshcatVisualizerParams(prefix=f"{arm.name.lower()}/links")
            MeshcatVisualizer.AddToBuilder(builder, self._scene_graph, meshcat, parameters)
        if effects is None or self._parts is None:
            ports = add_ideal_drive(builder, self.plant, self._joints, self._instance)
        else:
            drive = RealDrive(
                true_arm, self.plant, self._instance, self._joints, self._parts, effects, seed, self._home()
            )
            ports, self._drive_step = add_real_drive(builder, drive)
        self._export(builder, ports)

    @property
    def arm(self) -> Arm:
        """The arm that the ports are named and ordered after."""
        return self._arm

    @property
    def plant(self) -> MultibodyPlant:
        """The simulated plant.

        Raises:
            StationError: this station is the hardware, which has none.
        """
        if self._plant is None:
            raise StationError("this station is the hardware: it has no plant, and its state cannot be set")
        return self._plant

    def SetPositions(self, context: Context, q: ArrayLike) -> None:
        """Puts the arm at the pose q (n,) of its independent joints, linkage included, at rest.

        Args:
            context: of this station, not of a Diagram around it.
            q: pose; it need not be inside the limits.

        Raises:
            StationError: q is not n finite numbers, or this station is the hardware.
        """
        q = np.asarray(q, float)
        if q.shape != (self._arm.num_joints,) or not np.all(np.isfinite(q)):
            raise StationError(f"a pose of {self._arm.name} is {self._arm.num_joints} finite numbers; got {q.tolist()}")
        plant_context = self.GetMutableSubsystemContext(self.plant, context)
        set_arm_positions(self.plant, plant_context, self._true_arm, q)
        q_plant = self.plant.GetPositions(plant_context)
        if self._parts is not None:
            self._parts.drive.set_positions(q_plant, q)
        self.plant.SetPositions(plant_context, q_plant)
        if self._drive_step is not None:
            self._drive_step.SetAtRest(self.GetMutableSubsystemContext(self._drive_step, context), q)
        self.plant.SetVelocities(plant_context, np.zeros(self.plant.num_velocities()))

    def GetPositions(self, context: Context) -> NDArray[np.float64]:
        """Pose (n,) of the independent joints in this station's context."""
        plant_context = self.GetSubsystemContext(self.plant, context)
        q: NDArray[np.float64] = self.plant.GetPositions(plant_context)[self._joints.index]
        return q

    def SetLinkInertias(self, context: Context, inertias: Mapping[str, SpatialInertia]) -> None:
        """Gives links another inertia in this station's context: an arm that differs from its model.

        Args:
            context: of this station.
            inertias: link name -> spatial inertia M_LLo_L about the link's origin, in its frame [kg, m, kg
            m^2].

        Raises:
            StationError: a link that the arm does not have, or this station is the hardware.
        """
        plant_context = self.GetMutableSubsystemContext(self.plant, context)
        bodies = {self.plant.get_body(i).name(): i for i in self.plant.GetBodyIndices(self._instance)}
        if unknown := sorted(set(inertias) - set(bodies)):
            raise StationError(f"unknown link {', '.join(unknown)}; links: {', '.join(bodies)}")
        for name, M_LLo_L in inertias.items():
            self.plant.get_body(bodies[name]).SetSpatialInertiaInBodyFrame(plant_context, M_LLo_L)

    def _drop_idle_shapes(self) -> None:
        """Takes the collision shapes out if no two of them may touch: they would cost a sixth of a step for nothing."""
        if self._scene_graph.model_inspector().GetCollisionCandidates():
            return
        plant = self.plant
        for body in map(plant.get_body, plant.GetBodyIndices(self._instance)):
            for shape in plant.GetCollisionGeometriesForBody(body):
                self._scene_graph.RemoveRole(plant.get_source_id(), shape, Role.kProximity)

    def _home(self) -> NDArray[np.float64]:
        return np.clip(0.0, self._true_arm.position_lower, self._true_arm.position_upper)

    def _set_default_pose(self) -> None:
        home = self._home()
        q_plant = self.plant.GetDefaultPositions()
        tree = tree_selector(self.plant, self._true_arm, self._instance)
        q_plant[tree] = self._true_arm.linkage.position(home)
        if self._parts is not None:
            self._parts.drive.set_positions(q_plant, home)
        self.plant.SetDefaultPositions(q_plant)

    def _export(self, builder: DiagramBuilder, ports: DrivePorts) -> None:
        name, n = self._arm.name.lower(), self._arm.num_joints
        builder.ExportInput(ports.effort_commanded, f"{name}.effort_commanded")
        builder.ExportInput(ports.effort_disturbance, f"{name}.effort_disturbance")
        builder.ExportOutput(ports.effort_measured, f"{name}.effort_measured")
        builder.ExportOutput(ports.state_true, f"{name}.state_true")
        builder.ExportOutput(ports.state_estimated, f"{name}.state_estimated")
        halves = np.split(np.eye(2 * n), 2)
        for port, D in zip(("position_measured", "velocity_estimated"), halves, strict=True):
            select = builder.AddNamedSystem(port, MatrixGain(D=D))
            builder.Connect(ports.state_estimated, select.get_input_port())
            builder.ExportOutput(select.get_output_port(), f"{name}.{port}")
        builder.ExportOutput(self.plant.get_state_output_port(), "plant_state")
        builder.ExportOutput(self.plant.get_body_poses_output_port(), "body_poses")
        builder.ExportOutput(self._scene_graph.get_query_output_port(), "query_object")
