"""Teleoperation of a PSM (follower) by an MTML (master) in Meshcat, with a simulated hand or with live controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from time import monotonic

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Meshcat, Rgba
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial, PiecewisePose

from dvrk_drake.dynamics.kinematics import Contact
from dvrk_drake.experiments.simulation import recorded_in
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.systems.arm_view.efforts import DrawnForce
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import add_ground, geometry_corners, start_meshcat
from dvrk_drake.systems.hand import PoseTrajectorySource
from dvrk_drake.systems.teleoperated_arms import TeleoperatedArms, Wall

#: Ratio of the displacement of the instrument tip to the displacement of the handle.
SCALE = 0.4
#: Start poses of the arms [rad, m]: handle in front of the operator, instrument in the middle of its range.
START_MASTER = np.array([0.0, 0.25, -0.1, 0.0, 1.2, 0.0, 0.0])
START_FOLLOWER = np.array([0.0, 0.0, 0.13, 0.0, 0.0, 0.0, 0.5])
#: Time intervals of the simulated motion in which the clutch is closed [s].
ENGAGED = ((0.5, 9.7), (11.2, 16.0))
#: Phases of this motion, for the page with its animation: start times [s] and texts.
PHASES = (
    (0.0, "clutch open: PSM holds its pose"),
    (0.5, "clutch closed: PSM follows"),
    (9.7, "clutch open: PSM holds its pose"),
    (11.2, "clutch closed: PSM follows"),
)
DURATION = 16.0
PERIOD = 0.02
#: Object below the tip: distance from the start of the tip [m], stiffness of soft tissue [N/m], drawn size [m], colour.
OBJECT_DEPTH, OBJECT_STIFFNESS, OBJECT_SIZE, OBJECT_COLOR = 0.008, 500.0, (0.1, 0.1, 0.02), Rgba(0.85, 0.55, 0.45, 0.6)
BLUE, GREY = Rgba(0.1, 0.35, 0.75), Rgba(0.35, 0.35, 0.35)


@dataclass(frozen=True)
class TeleoperationResult:
    """Tracking errors of the instrument tip relative to the handle. Only samples with a closed clutch are evaluated.

    The position error is the difference between the tip's displacement and the handle's scaled displacement since the
    clutch closed. The rotation error is the angle between the rotations of tip and handle since then. There is one
    sample per `PERIOD`.

    Attributes:
        handle_path: Length of the handle's path with a closed clutch [m].
        rms_position_error, max_position_error: RMS and maximum position error [m].
        rms_rotation_error, max_rotation_error: RMS and maximum rotation error [rad].
        max_motion_held: Maximum displacement of the tip while the clutch is open [m].
    """

    handle_path: float
    rms_position_error: float
    max_position_error: float
    rms_rotation_error: float
    max_rotation_error: float
    max_motion_held: float


@dataclass(frozen=True)
class _Samples:
    """Samples at every `PERIOD`.

    Attributes:
        following: Whether the follower follows the master, for each sample.
        X_MG: Poses of the handle in the base frame of the master.
        X_FT: Poses of the instrument tip in the base frame of the follower.
    """

    following: list[bool]
    X_MG: list[RigidTransform]
    X_FT: list[RigidTransform]


def play_teleoperation(
    meshcat: Meshcat | None = None,
    duration: float = DURATION,
    progress: Callable[[float], object] = lambda share: None,
    *,
    force_feedback: bool = False,
) -> TeleoperationResult:
    """Simulates teleoperation with a prescribed motion of the hand, and records the animation.

    The hand translates and rotates the handle, opens the clutch, moves back, closes the clutch and continues.

    Args:
        meshcat: Meshcat that shows the arms and their paths, see `start_scene`. None for no animation.
        duration: Duration of the simulation [s]. The whole motion lasts `DURATION`.
        progress: Function called with the finished share, 0..1.
        force_feedback: Whether the tip can touch an object, and the master reflects the force.
    """
    builder = DiagramBuilder()
    arms = builder.AddSystem(_make_arms(meshcat, force_feedback))
    scene = TeleoperationScene(arms, meshcat) if meshcat is not None else None
    start = arms.CreateDefaultContext()
    arms.SetPositions(start, START_MASTER, START_FOLLOWER)
    hand = builder.AddSystem(PoseTrajectorySource(_hand_motion(arms.CalcX_MG(start))))
    switches = [0.0, *np.ravel(ENGAGED)]
    clutch = builder.AddSystem(
        TrajectorySource(PiecewisePolynomial.ZeroOrderHold(switches, np.arange(len(switches))[None] % 2))
    )
    jaw = builder.AddSystem(TrajectorySource(_jaw_motion()))
    for source, port in ((hand, "X_MG_desired"), (clutch, "engaged"), (jaw, "jaw_angle")):
        builder.Connect(source.get_output_port(), arms.GetInputPort(port))
    simulator = Simulator(builder.Build())
    context = arms.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    arms.SetPositions(context, START_MASTER, START_FOLLOWER)

    samples = _Samples([], [], [])
    with recorded_in(meshcat, frames_per_second=32):
        for t in np.arange(round(duration / PERIOD) + 1) * PERIOD:
            simulator.AdvanceTo(t)
            samples.following.append(bool(arms.GetOutputPort("following").Eval(context)[0]))
            samples.X_MG.append(arms.CalcX_MG(context))
            samples.X_FT.append(arms.CalcX_FT(context))
            if scene is not None:
                scene.draw(arms, context, time=t)
            progress(t / duration)
    if meshcat is not None:
        _draw_paths(meshcat, samples)
    return _evaluate(samples)


def run_live_teleoperation(meshcat: Meshcat, duration: float = np.inf, *, force_feedback: bool = False) -> None:
    """Simulates teleoperation in real time with controls for hand, clutch, jaw and scale in Meshcat.

    The simulation ends after `duration` [s], or earlier if the user clicks the button Stop. The control panel
    shows the state of the clutch and the tracking error. See `play_teleoperation` for `force_feedback`.
    """
    from pydrake.visualization import MeshcatPoseSliders  # imports matplotlib

    arms = _make_arms(meshcat, force_feedback)
    scene = TeleoperationScene(arms, meshcat)
    simulator = Simulator(arms)
    context = simulator.get_mutable_context()
    arms.SetPositions(context, START_MASTER, START_FOLLOWER)
    X_MG0 = arms.CalcX_MG(context)
    reach = np.array([0.8, 0.8, 0.8, 0.12, 0.12, 0.12])
    sliders = MeshcatPoseSliders(
        meshcat, lower_limit=-reach, upper_limit=reach, step=np.repeat([0.01, 0.002], 3), prefix="hand"
    )
    sliders_context = sliders.CreateDefaultContext()
    meshcat.AddSlider("jaw", 0.0, 1.3, 0.01, START_FOLLOWER[6])
    meshcat.AddSlider("scale", 0.1, 1.0, 0.05, SCALE)
    meshcat.AddButton("Clutch", "Space")
    meshcat.AddButton("Stop", "Escape")
    scale, error = SCALE, _LiveError()
    simulator.set_target_realtime_rate(1.0)
    while meshcat.GetButtonClicks("Stop") == 0 and context.get_time() < duration:
        if (chosen := meshcat.GetSliderValue("scale")) != scale:
            scale = chosen
            arms.teleoperation.SetScale(arms.teleoperation.GetMyMutableContextFromRoot(context), scale)
            error = _LiveError()
        X_MG = _moved(X_MG0, sliders.get_output_port().Eval(sliders_context))
        arms.GetInputPort("X_MG_desired").FixValue(context, AbstractValue.Make(X_MG))
        arms.GetInputPort("engaged").FixValue(context, [float(meshcat.GetButtonClicks("Clutch") % 2)])
        arms.GetInputPort("jaw_angle").FixValue(context, [meshcat.GetSliderValue("jaw")])
        simulator.AdvanceTo(context.get_time() + PERIOD)
        follows = bool(arms.GetOutputPort("following").Eval(context)[0])
        tracking = error.update(follows, arms.CalcX_MG(context), arms.CalcX_FT(context), scale)
        scene.draw(arms, context)
        scene.show_status(follows, tracking)


class _LiveError:
    """Position error of the tip relative to the scaled displacement of the handle since the clutch closed."""

    def __init__(self) -> None:
        self._start: tuple[RigidTransform, RigidTransform] | None = None

    def update(self, follows: bool, X_MG: RigidTransform, X_FT: RigidTransform, scale: float) -> float | None:
        """Returns the error [m], or None while the clutch is open."""
        if not follows:
            self._start = None
            return None
        if self._start is None:
            self._start = X_MG, X_FT
        G0, T0 = (X.translation() for X in self._start)
        return float(np.linalg.norm(X_FT.translation() - T0 - scale * (X_MG.translation() - G0)))


def _make_arms(meshcat: Meshcat | None, force_feedback: bool) -> TeleoperatedArms:
    master, follower = load_arm("mtml"), load_arm("psm")
    if not force_feedback:
        return TeleoperatedArms(master, follower, scale=SCALE, meshcat=meshcat)
    top = Contact(follower).point(START_FOLLOWER) - [0.0, 0.0, OBJECT_DEPTH]
    if meshcat is not None:
        meshcat.SetObject("psm/object", Box(*OBJECT_SIZE), OBJECT_COLOR)
        meshcat.SetTransform("psm/object", RigidTransform(top - [0.0, 0.0, OBJECT_SIZE[2] / 2]))
    wall = Wall(follower, top, [0.0, 0.0, 1.0], stiffness=OBJECT_STIFFNESS)
    return TeleoperatedArms(master, follower, scale=SCALE, meshcat=meshcat, force_model="exact", wall=wall)


def _moved(X: RigidTransform, move: RigidTransform) -> RigidTransform:
    """Returns X rotated about its origin and translated, both in the axes of the base frame."""
    return RigidTransform(move.rotation() @ X.rotation(), X.translation() + move.translation())


def _ramp(t: float, start: float, end: float) -> float:
    """Returns 0 before `start`, 1 after `end`, and a smooth transition between them."""
    return float(np.sin(np.pi / 2 * np.clip((t - start) / (end - start), 0, 1)) ** 2)


def _hand_motion(X_MG0: RigidTransform) -> PiecewisePose:
    """Returns the motion of the handle from its start pose X_MG0. The clutch is closed in the intervals `ENGAGED`."""

    def move(t: float) -> RigidTransform:
        eight, circle = 2 * np.pi * _ramp(t, 0.7, 4.5), 2 * np.pi * _ramp(t, 11.5, 15.2)
        back = _ramp(t, 9.9, 11.0)
        p = [
            0.03 * np.sin(eight) + 0.04 * back,
            0.06 * np.sin(eight) + 0.05 * back + 0.04 * (np.cos(circle) - 1),
            0.04 * np.sin(2 * eight) - 0.03 * back + 0.04 * np.sin(circle),
        ]
        tilt, swing = np.sin(2 * np.pi * _ramp(t, 4.7, 7.2)), np.sin(2 * np.pi * _ramp(t, 6.9, 9.4))
        return RigidTransform(RollPitchYaw(0.4 * tilt, 0.3 * back, 0.4 * swing), p)

    times = np.arange(0.0, DURATION + PERIOD / 2, PERIOD)
    return PiecewisePose.MakeLinear(times, [_moved(X_MG0, move(t)) for t in times])


def _jaw_motion() -> PiecewisePolynomial:
    times = np.arange(0.0, DURATION + PERIOD / 2, PERIOD)
    opening = [[START_FOLLOWER[6] + 0.5 * (_ramp(t, 5.5, 6.3) - _ramp(t, 7.0, 7.8)) for t in times]]
    return PiecewisePolynomial.FirstOrderHold(times, opening)


def _segments(following: list[bool]) -> list[range]:
    """Returns the ranges of consecutive samples with the same value of `following`."""
    changes = np.flatnonzero(np.diff(np.array(following, float))) + 1
    bounds = [0, *changes.tolist(), len(following)]
    return [range(a, b) for a, b in pairwise(bounds)]


def _evaluate(samples: _Samples) -> TeleoperationResult:
    position, rotation, held, path = [0.0], [0.0], [0.0], 0.0
    for segment in _segments(samples.following):
        G0, T0 = samples.X_MG[segment[0]], samples.X_FT[segment[0]]
        for i in segment:
            G, T = samples.X_MG[i], samples.X_FT[i]
            displacement = T.translation() - T0.translation()
            if not samples.following[i]:
                held.append(float(np.linalg.norm(displacement)))
                continue
            position.append(float(np.linalg.norm(displacement - SCALE * (G.translation() - G0.translation()))))
            rotation_tip, rotation_handle = (
                T.rotation() @ T0.rotation().inverse(),
                G.rotation() @ G0.rotation().inverse(),
            )
            rotation.append(_angle(rotation_tip @ rotation_handle.inverse()))
        if samples.following[segment[0]]:
            path += float(np.linalg.norm(np.diff(_points(samples.X_MG, segment)), axis=0).sum())
    return TeleoperationResult(
        handle_path=path,
        rms_position_error=_rms(position),
        max_position_error=max(position),
        rms_rotation_error=_rms(rotation),
        max_rotation_error=max(rotation),
        max_motion_held=max(held),
    )


def _angle(R: RotationMatrix) -> float:
    return abs(float(R.ToAngleAxis().angle()))


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _points(poses: list[RigidTransform], segment: range) -> NDArray[np.float64]:
    """Returns the origins (3, m) of the poses."""
    return np.array([poses[i].translation() for i in segment]).T


def _draw_paths(meshcat: Meshcat, samples: _Samples) -> None:
    """Draws the paths of handle and tip, blue while the follower follows the master and grey otherwise."""
    for k, segment in enumerate(_segments(samples.following)):
        color = BLUE if samples.following[segment[0]] else GREY
        for name, poses in (("mtml", samples.X_MG), ("psm", samples.X_FT)):
            if len(segment) > 1:
                meshcat.SetLine(f"{name}/path/{k}", np.asfortranarray(_points(poses, segment)), 3.0, color)


#: Positions of the bases in the world frame [m]. Both bases have the same orientation.
BASE_POSITIONS = {"mtml": (0.0, 0.45, 0.05), "psm": (0.0, -0.22, 0.0)}
#: The target is right of the arms, so that the control panel in the upper right corner does not cover them.
CAMERA, TARGET = (2.4, 0.86, 0.68), (0.0, 0.1, 0.08)


class TeleoperationScene:
    """Overlays of both arms, and the state of the teleoperation in the control panel."""

    def __init__(self, arms: TeleoperatedArms, meshcat: Meshcat) -> None:
        """Adds the overlays. The ghost of the PSM shows its desired pose."""
        self._overlays = {station: ArmOverlay(station.arm, meshcat) for station in (arms.master, arms.follower)}
        self._follower = arms.follower
        self._next_text = 0.0

    def draw(self, arms: TeleoperatedArms, context: Context, time: float | None = None) -> None:
        """Draws the efforts of both arms, the ghost and the trace of the tip, and the force if it is reflected."""
        for station, overlay in self._overlays.items():
            name, n = station.arm.name.lower(), station.arm.num_joints
            station_context = arms.GetSubsystemContext(station, context)
            desired = arms.GetOutputPort("desired_state").Eval(context)[:n] if station is arms.follower else None
            overlay.draw(
                station.GetPositions(station_context),
                effort=station.GetOutputPort(f"{name}.effort_measured").Eval(station_context),
                desired=desired,
                force=self._force(arms, context) if station is arms.follower else None,
                time=time,
            )

    @staticmethod
    def _force(arms: TeleoperatedArms, context: Context) -> DrawnForce | None:
        if not arms.HasOutputPort("force"):
            return None
        force, covariance = (arms.GetOutputPort(name).Eval(context) for name in ("force", "force_covariance"))
        return DrawnForce(arms.CalcX_FT(context).translation(), force, covariance.reshape(3, 3))

    def show_status(self, follows: bool, tracking: float | None) -> None:
        """Shows the clutch and the tracking error [m] at most twice per second."""
        if (now := monotonic()) < self._next_text:
            return
        self._next_text = now + 0.5
        error = "" if tracking is None else f", error {1e3 * tracking:.1f} mm"
        self._overlays[self._follower].set_state(("clutch closed" if follows else "clutch open") + error)


def start_scene(port: int | None = None) -> Meshcat:
    """Starts Meshcat with the ground and the base poses of both arms.

    If `port` is None, Meshcat uses a free port.
    """
    meshcat = start_meshcat(port=port, camera=CAMERA, target=TARGET)
    corners = []
    for name, p_WB in BASE_POSITIONS.items():
        meshcat.SetTransform(name, RigidTransform(np.array(p_WB)))
        corners.append(geometry_corners(load_arm(name)) + p_WB)
    add_ground(meshcat, np.concatenate(corners))
    return meshcat
