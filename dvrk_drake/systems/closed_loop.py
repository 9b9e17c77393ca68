"""Connection of an arm to a controller and to a source of desired states, and the ramp from the measured efforts."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, DiscreteValues, LeafSystem, System

from dvrk_drake.errors import ControllerError, StationError
from dvrk_drake.systems.arm_drive import ArmDrive
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.station import Station


class EffortRamp(LeafSystem):
    """Outputs the measured effort until the ramp is enabled. The output then changes to the desired effort.

    A command guard accepts the first commanded efforts only if they are close to the measured efforts. The ramp also
    avoids a step of the effort on the arm.

    .. pydrake_system::

        name: EffortRamp
        input_ports:
        - effort_wanted
        - effort_measured
        - enabled
        output_ports:
        - effort

    - `effort_wanted` (n): desired effort [N m; N on a prismatic joint].
    - `effort_measured` (n): measured effort.
    - `enabled` (1): 0 disables the ramp, any other value enables it.
    - `effort` (n): start + share * (effort_wanted - start). `start` is the last measured effort before the ramp was
      enabled. `share` increases linearly from 0 to 1 within `duration`.

    `start` and `share` are discrete states. They are updated every `period` seconds and by a forced discrete update.
    """

    def __init__(self, num_joints: int, *, period: float = 1e-3, duration: float = 1.0) -> None:
        """Creates a ramp.

        Args:
            num_joints: Number n of joints.
            period: Period of the update [s].
            duration: Duration of the ramp [s].

        Raises:
            ControllerError: Period or duration is not positive.
        """
        super().__init__()
        if not (period > 0 and duration > 0):
            raise ControllerError(
                f"period and duration must be positive numbers of seconds; got {period} and {duration}"
            )
        self._increment = period / duration
        self._wanted = self.DeclareVectorInputPort("effort_wanted", num_joints)
        self._measured = self.DeclareVectorInputPort("effort_measured", num_joints)
        self._enabled = self.DeclareVectorInputPort("enabled", 1)
        self._start = int(self.DeclareDiscreteState(num_joints))
        self._share = int(self.DeclareDiscreteState(1))
        self.DeclareVectorOutputPort("effort", num_joints, self._calc_effort)
        self.DeclareInitializationDiscreteUpdateEvent(self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareForcedDiscreteUpdateEvent(self._update)

    def GetShare(self, context: Context) -> float:
        """Returns the completed share of the ramp, 0..1."""
        return float(context.get_discrete_state(self._share).value()[0])

    def _update(self, context: Context, state: DiscreteValues) -> None:
        if self._enabled.Eval(context)[0]:
            state.set_value(self._share, [min(1.0, self.GetShare(context) + self._increment)])
        else:
            state.set_value(self._share, [0.0])
            state.set_value(self._start, self._measured.Eval(context))

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        start = context.get_discrete_state(self._start).value()
        share = self.GetShare(context)
        wanted = self._wanted.Eval(context)
        output.SetFromVector(wanted if share >= 1.0 else start + share * (wanted - start))


def add_closed_loop(
    builder: DiagramBuilder,
    station: ArmStation | HardwareArmStation | Station | ArmDrive,
    controller: System,
    desired: System | None = None,
    friction: FrictionCompensator | None = None,
    *,
    ramp: EffortRamp | None = None,
    name: str = "",
) -> None:
    """Adds a station and its controller to a Diagram and connects them.

    Args:
        builder: Builder of the Diagram.
        station: Station of the arm, which may be in the Diagram already, or what `add_arm_drive` returned.
        controller: Controller of an arm with the same joints: a `GravityPidController`, or a System with an input port
            `state_estimated` (2n) and an output port `effort` (n).
        desired: System with one output port (2n): q_d, then v_d. None: the controller regulates the initial pose.
        friction: Compensator for a share of the arm's friction. None: friction is not compensated.
        ramp: Ramp from the measured efforts of a real arm to those of the controller. None: there is no ramp.
        name: Name of the arm in a `Station`.

    Raises:
        StationError: The `Station` has no arm of this name.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from pydrake.systems.analysis import Simulator
        >>> from pydrake.systems.framework import DiagramBuilder
        >>> arm, builder = dvrk.load_arm("mtml"), DiagramBuilder()
        >>> station = dvrk.ArmStation(arm)
        >>> controller = dvrk.GravityPidController(dvrk.IdentifiedModel.from_arm(arm))
        >>> dvrk.add_closed_loop(builder, station, controller)
        >>> simulator = Simulator(builder.Build())
        >>> status = simulator.AdvanceTo(0.1)
        >>> q = station.GetPositions(station.GetMyContextFromRoot(simulator.get_context()))
        >>> bool(abs(q).max() < 1e-3)  # holds its home pose
        True
    """
    if isinstance(station, ArmDrive):
        state, commanded = station.state_estimated, station.effort_commanded
    else:
        if not isinstance(station, Station):
            name = station.arm.name.lower()
        elif name not in station.arms:
            raise StationError(f'the station has no arm "{name}"; allowed: {", ".join(station.arms)}')
        if station not in builder.GetSystems():
            builder.AddSystem(station)
        state = station.GetOutputPort(f"{name}.state_estimated")
        commanded = station.GetInputPort(f"{name}.effort_commanded")
    builder.AddSystem(controller)
    effort = controller.GetOutputPort("effort")
    builder.Connect(state, controller.GetInputPort("state_estimated"))
    if friction is not None:
        builder.AddSystem(friction)
        builder.Connect(state, friction.GetInputPort("state_estimated"))
        builder.Connect(effort, friction.GetInputPort("effort_wanted"))
        effort = friction.GetOutputPort("effort")
    if ramp is not None and not isinstance(station, ArmDrive):
        builder.AddSystem(ramp)
        builder.Connect(effort, ramp.GetInputPort("effort_wanted"))
        for port, measured in (("effort_measured", "effort_measured"), ("enabled", "in_control")):
            builder.Connect(station.GetOutputPort(f"{name}.{measured}"), ramp.GetInputPort(port))
        effort = ramp.GetOutputPort("effort")
    builder.Connect(effort, commanded)
    if desired is not None:
        builder.AddSystem(desired)
        builder.Connect(desired.get_output_port(), controller.GetInputPort("desired_state"))
