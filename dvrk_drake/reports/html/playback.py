"""3D animation of a recording for a report."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import add_arm, set_arm_positions
from dvrk_drake.systems.arm_view import start_meshcat

#: Largest rate [Hz] and largest number of key frames. Meshcat interpolates between key frames.
MAX_RATE, MAX_FRAMES = 30.0, 600


def frame_times(start: float, end: float) -> NDArray[np.float64]:
    """Returns the times (k,) of the key frames of a motion from `start` to `end` [s]."""
    count = int(min((end - start) * MAX_RATE, MAX_FRAMES - 1)) + 1
    return np.linspace(start, end, max(count, 2))


def playback(arm: Arm, t: NDArray[np.float64], q: NDArray[np.float64]) -> str:
    """Returns a page of Meshcat with an animation that starts at t[0].

    Args:
        arm: Arm to draw.
        t: Times (m,) of the poses, increasing [s].
        q: Poses (m, n) of the joints [rad, m].

    Raises:
        ArmError: The arm has no visual geometry.
        DvrkDrakeError: No port of this computer is free.
    """
    times = frame_times(float(t[0]), float(t[-1]))
    poses = np.column_stack([np.interp(times, t, x) for x in q.T])
    period = float(times[1] - times[0])
    meshcat = start_meshcat(arm)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    add_arm(plant, arm)
    plant.Finalize()
    visualizer = MeshcatVisualizer.AddToBuilder(
        builder, scene_graph, meshcat, MeshcatVisualizerParams(publish_period=period)
    )
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    visualizer.StartRecording()
    for k, pose in enumerate(poses):
        # The time of a frame is in the middle of its period, so that rounding does not change the number of the frame.
        context.SetTime((k + 0.5) * period)
        set_arm_positions(plant, plant.GetMyMutableContextFromRoot(context), arm, pose)
        diagram.ForcedPublish(context)
    visualizer.StopRecording()
    visualizer.PublishRecording()
    return str(meshcat.StaticHtml())
