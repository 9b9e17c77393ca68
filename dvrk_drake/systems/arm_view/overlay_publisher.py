"""Draws the overlay of a simulated arm at a low rate."""

from __future__ import annotations

from collections.abc import Callable

from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, OutputPort

from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.arm_view.overlay import ArmOverlay

#: Period of drawing [s].
PERIOD = 1 / 32


class OverlayPublisher(LeafSystem):
    """Draws an `ArmOverlay` at the period `PERIOD`.

    .. pydrake_system::

        name: OverlayPublisher
        input_ports:
        - state
        - effort (optional)
        - desired_state (optional)

    - `state` (2n): positions, then velocities of the arm [rad, m, rad/s, m/s].
    - `effort` (n): efforts for the arcs [N m, N]. Unconnected: no arcs.
    - `desired_state` (2n): desired positions, then velocities. The positions are drawn as a ghost. Unconnected: no
      ghost.
    """

    def __init__(self, overlay: ArmOverlay, phase: Callable[[float], str] = lambda time: "") -> None:
        """Creates the system.

        Args:
            overlay: Overlay to draw.
            phase: Function that returns the name of the phase at a time [s].
        """
        super().__init__()
        self._overlay, self._phase = overlay, phase
        n = overlay.arm.num_joints
        self.DeclareVectorInputPort("state", 2 * n)
        self.DeclareVectorInputPort("effort", n)
        self.DeclareVectorInputPort("desired_state", 2 * n)
        self.DeclarePeriodicPublishEvent(PERIOD, 0.0, self._draw)

    def _draw(self, context: Context) -> EventStatus:
        n, time = self._overlay.arm.num_joints, context.get_time()
        effort, desired = self.GetInputPort("effort"), self.GetInputPort("desired_state")
        self._overlay.set_state(self._phase(time))
        self._overlay.draw(
            self.GetInputPort("state").Eval(context)[:n],
            effort=effort.Eval(context) if effort.HasValue(context) else None,
            desired=desired.Eval(context)[:n] if desired.HasValue(context) else None,
            time=time,
        )
        return EventStatus.Succeeded()


def add_overlay(
    builder: DiagramBuilder,
    station: ArmStation,
    overlay: ArmOverlay,
    desired: OutputPort | None = None,
    phase: Callable[[float], str] = lambda time: "",
) -> OverlayPublisher:
    """Adds an `OverlayPublisher` for a station to a diagram. It shows the measured efforts.

    Args:
        builder: Builder with the station.
        station: Simulated arm.
        overlay: Overlay of the arm of the station.
        desired: Output port (2n) of the desired state. None: no ghost.
        phase: Function that returns the name of the phase at a time [s].
    """
    name = station.arm.name.lower()
    publisher = builder.AddNamedSystem(f"{name}_overlay", OverlayPublisher(overlay, phase))
    builder.Connect(station.GetOutputPort(f"{name}.state_true"), publisher.GetInputPort("state"))
    builder.Connect(station.GetOutputPort(f"{name}.effort_measured"), publisher.GetInputPort("effort"))
    if desired is not None:
        builder.Connect(desired, publisher.GetInputPort("desired_state"))
    return publisher
