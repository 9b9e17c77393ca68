"""One arm behind the ports that its driver has: the same names in simulation and on hardware."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Role
from pydrake.lcm import DrakeLcmInterface
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Adder, MatrixGain, PassThrough, Saturation

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.errors import StationError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects
from dvrk_drake.models.plant import Closure, add_arm, set_arm_positions, tree_selector
from dvrk_drake.systems.joint_effect_torque import JointEffectTorque
from dvrk_drake.systems.lcm.arm_connection import connect_arm
from dvrk_drake.systems.lcm.dvrk_driver import DvrkDriver
from dvrk_drake.systems.real_arm.encoder import Encoder
from dvrk_drake.systems.real_arm.motor_channel import add_motor_channel
from dvrk_drake.systems.real_arm.plant_effects import PlantEffects
from dvrk_drake.systems.station_ports import station_ports


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
    `arm.effects` states them. With them (be they empty) a discrete controller beside the station sees the arm before
    the step that its command is for: the command is a period late, as on hardware.

    Drake's solver holds the linkage to about 1e-8 m at 1 ms with either `closure`, and each joint in its position
    limits; the coupled limits of the linkage are there with the effect `stops`. An arm's shapes never touch each other:
    they are collision shapes only where `modify_plant` adds one that they can touch.

    **On hardware** the ports of `station_ports` are all there are. Measured values are those of the last DVRK_STATUS
    message, NaN before the first. Efforts go out in DVRK_COMMAND messages every `driver.status_period` and on forced
    publishing, and the arm's command guard decides what becomes of them; unconnected, the arm is told to hold.
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
                `set_link_inertias`.
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
        self._encoder: Encoder | None = None
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
        self._instance = add_arm(self.plant, true_arm, closure)
        if modify_plant is not None:
            modify_plant(self.plant)
        if effects is not None:
            # Otherwise Drake steps the plant before all discrete updates, and what they measure is from after the step.
            self.plant.SetUseSampledOutputPorts(False)
        effects = effects or ArmEffects()
        self._plant_effects = PlantEffects(self.plant, true_arm, self._instance, effects)
        self.plant.Finalize()
        self._plant_effects.connect(builder)
        self._drop_idle_shapes()
        self._set_default_pose()
        if meshcat is not None:
            # The visualizer deletes its prefix when it starts: one level down, so that a SetTransform stays.
            parameters = MeshcatVisualizerParams(prefix=f"{arm.name.lower()}/links")
            MeshcatVisualizer.AddToBuilder(builder, self._scene_graph, meshcat, parameters)
        state_true = self._export_outputs(builder, effects)
        self._export_inputs(builder, effects, seed, state_true)

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

    def set_positions(self, context: Context, q: ArrayLike) -> None:
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
        self._plant_effects.drive.set_positions(q_plant, q)
        self.plant.SetPositions(plant_context, q_plant)
        if self._encoder is not None:
            self._encoder.set_at_rest(self.GetMutableSubsystemContext(self._encoder, context), q)
        self.plant.SetVelocities(plant_context, np.zeros(self.plant.num_velocities()))

    def get_positions(self, context: Context) -> NDArray[np.float64]:
        """Pose (n,) of the independent joints in this station's context."""
        plant_context = self.GetSubsystemContext(self.plant, context)
        q: NDArray[np.float64] = self.plant.GetPositions(plant_context)[self._independent()]
        return q

    def set_link_inertias(self, context: Context, inertias: Mapping[str, SpatialInertia]) -> None:
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

    def _independent(self) -> NDArray[np.int_]:
        """Index into the plant's q and v of each independent joint."""
        names = list(self._true_arm.tree_joint_names)
        tree = tree_selector(self.plant, self._true_arm, self._instance)
        return tree[[names.index(joint) for joint in self._arm.joint_names]]

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
        self._plant_effects.drive.set_positions(q_plant, home)
        self.plant.SetDefaultPositions(q_plant)

    def _export_inputs(self, builder: DiagramBuilder, effects: ArmEffects, seed: int, state_true: OutputPort) -> None:
        plant, name, n = self.plant, self._arm.name.lower(), self._arm.num_joints
        # The plant clamps as well, but silently: clamp here, at the plant's limits, to know what is applied.
        actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(self._instance)]
        driven = [actuator.joint().name() for actuator in actuators]
        if undriven := [joint for joint in self._arm.joint_names if joint not in driven]:
            raise StationError(
                f"{' '.join(self._true_arm.sdf)}: joint {', '.join(undriven)} has no <effort>, so no motor"
            )
        columns = [driven.index(joint) for joint in self._arm.joint_names]
        limits = np.array([actuators[i].effort_limit() for i in columns])
        # Motors of other joints (massless rotors that ride on a linkage) get zero: their inertia is all they
        # are for.
        B = np.zeros((len(actuators), n))
        B[columns, range(n)] = 1.0
        commanded = builder.AddNamedSystem("effort_commanded", PassThrough(n))
        clamp = builder.AddNamedSystem("effort_clamp", Saturation(min_value=-limits, max_value=limits))
        to_actuators = builder.AddNamedSystem("to_actuators", MatrixGain(D=B))
        builder.Connect(commanded.get_output_port(), clamp.get_input_port())
        applied, measured = add_motor_channel(
            builder, self._arm, effects, clamp.get_output_port(), plant.time_step(), seed
        )
        builder.Connect(applied, to_actuators.get_input_port())
        builder.Connect(to_actuators.get_output_port(), plant.get_actuation_input_port(self._instance))
        builder.ExportInput(commanded.get_input_port(), f"{name}.effort_commanded")
        builder.ExportOutput(measured, f"{name}.effort_measured")

        disturbance = builder.AddNamedSystem("effort_disturbance", PassThrough(n))
        to_tree = builder.AddNamedSystem("to_tree", MatrixGain(D=self._tree_selection()))
        behind_motors = disturbance.get_output_port()
        if effects.cables or effects.springs:
            laws = [*effects.cables, *effects.springs]
            kinds = [ActuatorEffect(law.coordinate, law.kind, law.scale) for law in laws]
            torque = JointEffectTorque(self._true_arm, kinds, [law.coefficient for law in laws])
            builder.AddNamedSystem("position_torque", torque)
            builder.Connect(state_true, torque.get_input_port())
            total = builder.AddNamedSystem("behind_motors", Adder(2, n))
            builder.Connect(behind_motors, total.get_input_port(0))
            builder.Connect(torque.get_output_port(), total.get_input_port(1))
            behind_motors = total.get_output_port()
        builder.Connect(behind_motors, to_tree.get_input_port())
        builder.Connect(to_tree.get_output_port(), plant.get_applied_generalized_force_input_port())
        builder.ExportInput(disturbance.get_input_port(), f"{name}.effort_disturbance")

    def _export_outputs(self, builder: DiagramBuilder, effects: ArmEffects) -> OutputPort:
        """Returns the port of the independent joints' true state."""
        plant, name, n = self.plant, self._arm.name.lower(), self._arm.num_joints
        S = self._tree_selection().T
        zero = np.zeros_like(S)
        true = builder.AddNamedSystem("state_true", MatrixGain(D=np.block([[S, zero], [zero, S]])))
        builder.Connect(plant.get_state_output_port(), true.get_input_port())
        state_true = state = true.get_output_port()
        builder.ExportOutput(state_true, f"{name}.state_true")
        if effects.encoder is not None or effects.delay is not None:
            delay = effects.delay.measurement if effects.delay else 0
            self._encoder = Encoder(self._arm, effects.encoder, delay, plant.time_step(), self._home())
            builder.AddNamedSystem("encoder", self._encoder)
            builder.Connect(state, self._encoder.get_input_port())
            state = self._encoder.get_output_port()
        builder.ExportOutput(state, f"{name}.state_estimated")
        halves = np.split(np.eye(2 * n), 2)
        for port, D in zip(("position_measured", "velocity_estimated"), halves, strict=True):
            select = builder.AddNamedSystem(port, MatrixGain(D=D))
            builder.Connect(state, select.get_input_port())
            builder.ExportOutput(select.get_output_port(), f"{name}.{port}")
        builder.ExportOutput(plant.get_state_output_port(), "plant_state")
        builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
        builder.ExportOutput(self._scene_graph.get_query_output_port(), "query_object")
        return state_true

    def _tree_selection(self) -> NDArray[np.float64]:
        """(nv, n): efforts on the independent joints to efforts on the plant; its transpose picks their
        positions."""
        if self.plant.num_positions() != self.plant.num_velocities():
            raise StationError("modify_plant must not add floating bodies: weld them to the arm")
        selection = np.zeros((self.plant.num_velocities(), self._arm.num_joints))
        selection[self._independent(), range(self._arm.num_joints)] = 1.0
        return selection
