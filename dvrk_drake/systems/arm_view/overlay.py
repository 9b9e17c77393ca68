"""Overlay of an arm in Meshcat: ghosts, efforts, external force, remote centre (RCM), trace of the tip, and state."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, OutputPort

from dvrk_drake.errors import DvrkDrakeError
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant
from dvrk_drake.systems.arm_station import ArmStation
from dvrk_drake.systems.arm_view.drawn_arm import COMMANDED, GhostArm, Visibility
from dvrk_drake.systems.arm_view.efforts import FORCE_SCALE, DrawnForce, EffortArcs, ForceArrow, axis_frames
from dvrk_drake.systems.arm_view.page import geometry_corners, home_position

DESIRED = "desired"
#: Meaning of the colours of the efforts, for the control panel, which is 40 characters wide.
EFFORT_COLORS = "effort: blue 0, yellow 50, red 100 %"
#: Colours of the RCM and of the trace of the tip. The latter is that of measured values in plots.
RCM_COLOR, TRACE_COLOR = Rgba(1.0, 1.0, 1.0), Rgba(0.12, 0.12, 0.12)
#: Largest radius of the effort arcs, radius of the RCM, and distance below which arcs have different radii, all as
#: multiples of the size of the arm.
_ARC, _RCM, _NEAR = 0.085, 0.009, 0.05
#: Distance between two positions of which the second one begins a new trace [m], e.g. of two poses without a motion. At
#: 1 m/s, the positions of 30 pictures per second differ by 0.033 m.
TRACE_JUMP = 0.1
#: Shortest distance between two points of the trace [m]. Maximum number of points.
TRACE_STEP, TRACE_POINTS = 5e-4, 2000
#: Period in which the overlay of a simulated arm is drawn [s].
PERIOD = 1 / 32


class PanelText:
    """Row of the control panel with a text that changes.

    It is a button without effect, because the panel has no texts. Meshcat adds it below the existing rows.
    """

    def __init__(self, meshcat: Meshcat) -> None:
        """Starts without a text."""
        self._meshcat, self._text = meshcat, ""

    def show(self, text: str) -> None:
        """Replaces the text. "" removes the row."""
        if text == self._text:
            return
        if self._text:
            self._meshcat.DeleteButton(self._text, strict=False)
        if text:
            self._meshcat.AddButton(text)
        self._text = text


class ArmOverlay:
    """Information about an arm, drawn in Meshcat in addition to its links.

    The overlay does not draw the links. `ArmStation(arm, meshcat=meshcat)` or `ArmView` draws them. All objects are
    below the path of the arm, e.g. "mtml/overlay", so `SetTransform("mtml", X_WB)` moves them together with the links.
    Texts are in the control panel of Meshcat, where they cover nothing.

    With `time`, the methods also store the drawn objects in the recording of Meshcat, if one was started. The trace of
    the tip and texts are not part of the recording; `page_html` adds texts to a page.

    Example:
        >>> import dvrk_drake as dvrk
        >>> from dvrk_drake.systems.arm_view.overlay import ArmOverlay
        >>> from dvrk_drake.systems.arm_view.page import page_html
        >>> arm = dvrk.load_arm("mtml")
        >>> meshcat = dvrk.start_meshcat(arm)
        >>> overlay = ArmOverlay(arm, meshcat)
        >>> meshcat.StartRecording()
        >>> overlay.draw([0.0] * 7, effort=[0.0, 1.6, 0.0, 0.0, 0.0, 0.0, 0.0], desired=[0.1] * 7, time=0.0)
        >>> meshcat.StopRecording()
        >>> meshcat.PublishRecording()
        >>> "<title>MTML</title>" in page_html(meshcat, "MTML", phases=[(0.0, "held")])
        True
    """

    def __init__(self, arm: Arm, meshcat: Meshcat, *, trace: bool = True) -> None:
        """Adds the overlay. Nothing is visible except the RCM of the arm, if it has one.

        Args:
            arm: Arm that the overlay describes.
            meshcat: Meshcat with the arm.
            trace: Whether to draw the trace of the tip.
        """
        self.arm, self.meshcat = arm, meshcat
        self._path = f"{arm.name.lower()}/overlay"
        meshcat.Delete(self._path)
        self._visibility = Visibility(meshcat)
        self._plant = shared_plant(arm)
        self._context = self._plant.CreateDefaultContext()
        set_arm_positions(self._plant, self._context, arm, home_position(arm))
        X_BJ = axis_frames(arm, self._plant, self._context)
        size = float(np.ptp(geometry_corners(arm), axis=0).max())
        radii = _radii(np.array([X.translation() for X in X_BJ]), size)
        self._efforts = EffortArcs(arm, meshcat, f"{self._path}/efforts", radii, self._visibility)
        self._ghosts: dict[str, GhostArm] = {}
        self._trace: deque[NDArray[np.float64]] = deque(maxlen=TRACE_POINTS)
        self._force: ForceArrow | None = None
        self._state, self._effort_colors, self._force_scale = (PanelText(meshcat) for _ in range(3))
        self._scale, self._has_trace = 1.0, trace
        self.show_efforts(False)
        if arm.frames.remote_center:
            rcm = self._plant.GetFrameByName(arm.frames.remote_center).CalcPoseInWorld(self._context)
            meshcat.SetObject(f"{self._path}/rcm", Sphere(_RCM * size), RCM_COLOR)
            meshcat.SetTransform(f"{self._path}/rcm", rcm)

    def add_ghost(self, name: str, color: Rgba = COMMANDED) -> None:
        """Adds a translucent arm, which `draw` shows if its argument `ghosts` has a pose with this name."""
        path = f"{self._path}/ghost/{name}"
        self._ghosts[name] = GhostArm(self.arm, self.meshcat, path, color, self._visibility)

    def draw(
        self,
        q: ArrayLike,
        *,
        effort: ArrayLike | None = None,
        desired: ArrayLike | None = None,
        ghosts: Mapping[str, ArrayLike] | None = None,
        force: DrawnForce | None = None,
        time: float | None = None,
    ) -> None:
        """Moves the overlay to the pose of the arm.

        Args:
            q: Pose (n,) [rad, m] of the arm.
            effort: Efforts (n,) [N m, N] to show. None: the efforts remain as they are.
            desired: Desired or commanded pose (n,) [rad, m], drawn as a ghost. None: this ghost is hidden.
            ghosts: Poses of the other ghosts, see `add_ghost`. Ghosts without a pose are hidden.
            force: External force. None: the arrow is hidden.
            time: Time in the recording of Meshcat [s]. None: the objects are not recorded.

        Raises:
            DvrkDrakeError: There is no ghost with a given name.
        """
        set_arm_positions(self._plant, self._context, self.arm, q)
        if effort is not None:
            self.show_efforts(True)
            self._efforts.draw(effort, time)
        poses = dict(ghosts or {})
        if desired is not None:
            poses[DESIRED] = desired
            if DESIRED not in self._ghosts:
                self.add_ghost(DESIRED)
        if unknown := set(poses) - set(self._ghosts):
            raise DvrkDrakeError(f"unknown ghost {sorted(unknown)[0]}; known: {', '.join(self._ghosts) or 'none'}")
        for name, ghost in self._ghosts.items():
            ghost.draw_beside(poses.get(name), q, time)
        self._move_efforts(time)
        self._draw_force(force, time)
        if self._has_trace:
            self._draw_trace()

    def set_state(self, text: str) -> None:
        """Shows a text of at most 40 characters in the control panel, e.g. the state of the arm. "" shows nothing."""
        self._state.show(text)

    def show_efforts(self, visible: bool) -> None:
        """Shows or hides the efforts of the joints. `draw` with an effort shows them."""
        self._visibility.set(f"{self._path}/efforts", visible)
        self._effort_colors.show(EFFORT_COLORS if visible else "")

    def resize(self, scale: float) -> None:
        """Scales the arcs of the efforts, e.g. for a close-up."""
        self._scale = scale
        self._move_efforts()

    def clear_trace(self) -> None:
        """Deletes the trace of the tip."""
        self._trace.clear()
        self.meshcat.Delete(f"{self._path}/trace")

    def end_recording(self, time: float) -> None:
        """Stores the last state of all objects at the end of a recording [s], so that all tracks have one length."""
        self._visibility.end_recording(time)

    def _move_efforts(self, time: float | None = None) -> None:
        self._efforts.move(axis_frames(self.arm, self._plant, self._context), time, self._scale)

    def _draw_force(self, force: DrawnForce | None, time: float | None) -> None:
        if self._force is None:
            if force is None:
                return
            self._force = ForceArrow(self.meshcat, f"{self._path}/force", self._visibility)
        self._force_scale.show(FORCE_SCALE if force is not None else "")
        self._force.draw(force, time)

    def _draw_trace(self) -> None:
        """Adds the position of the tip to its trace.

        Meshcat cannot record a growing line, so a recording shows the whole line.
        """
        p = self._plant.GetFrameByName(self.arm.frames.hand).CalcPoseInWorld(self._context).translation()
        step = np.linalg.norm(p - self._trace[-1]) if self._trace else np.inf
        if step < TRACE_STEP:
            return
        if TRACE_JUMP < step < np.inf:
            self.clear_trace()
        self._trace.append(p)
        if len(self._trace) > 1:
            points = np.asfortranarray(np.array(self._trace).T)
            self.meshcat.SetLine(f"{self._path}/trace", points, 3.0, TRACE_COLOR)


def _radii(origins: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Returns radii (n,) of the effort arcs [m]. Arcs of joints at nearly the same place have different radii."""
    near = np.linalg.norm(origins[:, None] - origins, axis=2) < _NEAR * size
    return _ARC * size * 0.82 ** np.tril(near, -1).sum(axis=1)


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
