"""Functions that connect the station of an arm to a controller and to a source of desired states."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, System

from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.friction_compensator import FrictionCompensator
from dvrk_drake.systems.hardware_arm_station import HardwareArmStation


def add_closed_loop(
    builder: DiagramBuilder,
    station: ArmStation | HardwareArmStation,
    controller: System,
    desired: System | None = None,
    friction: FrictionCompensator | None = None,
) -> None:
    """Adds a station and its controller to a Diagram and connects them.

    Args:
        builder: Builder of the Diagram.
        station: Station of the arm.
        controller: Controller of an arm with the same joints: a `GravityPidController`, or a System with an input port
            `state_estimated` (2n) and an output port `effort` (n).
        desired: System with one output port (2n): q_d, then v_d. None: the controller regulates the initial pose.
        friction: Compensator for a share of the arm's friction. None: friction is not compensated.

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
    builder.AddSystem(station)
    connect_controller(builder, station, controller, desired, friction)


def connect_controller(
    builder: DiagramBuilder,
    station: ArmStation | HardwareArmStation,
    controller: System,
    desired: System | None = None,
    friction: FrictionCompensator | None = None,
) -> None:
    """Adds a controller to a Diagram that contains the station, and connects the controller to the station.

    The arguments are those of `add_closed_loop`.
    """
    name = station.arm.name.lower()
    builder.AddSystem(controller)
    state, effort = station.GetOutputPort(f"{name}.state_estimated"), controller.GetOutputPort("effort")
    builder.Connect(state, controller.GetInputPort("state_estimated"))
    if friction is not None:
        builder.AddSystem(friction)
        builder.Connect(state, friction.GetInputPort("state_estimated"))
        builder.Connect(effort, friction.GetInputPort("effort_wanted"))
        effort = friction.GetOutputPort("effort")
    builder.Connect(effort, station.GetInputPort(f"{name}.effort_commanded"))
    if desired is not None:
        builder.AddSystem(desired)
        builder.Connect(desired.get_output_port(), controller.GetInputPort("desired_state"))
