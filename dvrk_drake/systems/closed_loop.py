"""Function that connects an arm to a controller and to a source of desired states."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, System

from dvrk_drake.errors import StationError
from dvrk_drake.systems.arm_drive import ArmDrive
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.effort_ramp import EffortRamp
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation
from dvrk_drake.systems.station import Station


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
