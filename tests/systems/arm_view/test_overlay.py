"""Overlay: ghost, efforts, texts, recording, and drawing in a simulation."""

import gc
import threading

import numpy as np
import pytest
from arm_copies import copy_arm
from forked import run_forked

import dvrk_drake as dvrk
from dvrk_drake.errors import ArmError, DvrkDrakeError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.models.plant import set_arm_positions, shared_plant
from dvrk_drake.systems.arm_view import page
from dvrk_drake.systems.arm_view.drawn_arm import Visibility
from dvrk_drake.systems.arm_view.efforts import LEVELS, axis_frames
from dvrk_drake.systems.arm_view.overlay import ArmOverlay
from dvrk_drake.systems.arm_view.page import start_meshcat

pytestmark = pytest.mark.drake_api

HOME = {"mtml": np.zeros(7), "psm": np.array([0, 0, 0.1, 0, 0, 0, 0])}


@pytest.mark.parametrize("views", [1, 3])
def test_view_is_not_destroyed_in_another_thread(views, monkeypatch):
    """Drake ends the process there, e.g. when a thread of Dask collects garbage. This thread destroys old views."""
    monkeypatch.setattr(page, "MAX_VIEWS", 2)

    def check():
        gc.disable()
        for _ in range(views):
            cycle = {"view": start_meshcat()}
            cycle["itself"] = cycle
        del cycle
        thread = threading.Thread(target=gc.collect)
        thread.start()
        thread.join()
        assert len(page._VIEWS) == min(views, 2)

    monkeypatch.setattr(page, "_VIEWS", [])
    run_forked(check)


@pytest.mark.parametrize("name", ["mtml", "psm"])
def test_effort_share_selects_the_nearest_arc(name):
    arm = load_arm(name)
    overlay = ArmOverlay(arm, start_meshcat())
    share = np.array([0.0, 0.009, 0.04, -0.33, 1.7, -2.0, np.nan])
    overlay.draw(HOME[name], effort=share * arm.effort_limits)
    np.testing.assert_allclose(overlay._efforts.shares, [0, 0, 0.05, -0.3, 1, -1, 0], rtol=0, atol=1e-12)
    assert np.all(np.diff(LEVELS) > 0)


def test_arc_points_in_the_direction_of_the_effort():
    """The axis of an arc is that of the joint in the plant, so a positive effort turns counterclockwise about it."""
    for name in ("mtmr", "psm"):
        arm, plant = load_arm(name), shared_plant(load_arm(name))
        (q,) = arm.sample_poses(1, np.random.default_rng(0))
        context = plant.CreateDefaultContext()
        set_arm_positions(plant, context, arm, q)
        poses = axis_frames(arm, plant, context)
        for joint_name, X_BJ, slides in zip(arm.joint_names, poses, arm.prismatic, strict=True):
            joint = plant.GetJointByName(joint_name)
            v = np.zeros(plant.num_velocities())
            v[joint.velocity_start()] = 1.0
            plant.SetVelocities(context, v)
            V = joint.child_body().EvalSpatialVelocityInWorld(context)
            V_parent = joint.parent_body().EvalSpatialVelocityInWorld(context)
            axis = (V.translational() - V_parent.translational()) if slides else V.rotational() - V_parent.rotational()
            np.testing.assert_allclose(X_BJ.rotation().col(2), axis, rtol=0, atol=1e-9)


def test_ghost_links_at_the_place_of_the_arm_are_hidden():
    overlay = ArmOverlay(load_arm("mtml"), start_meshcat())
    q = np.zeros(7)
    q[2] = 0.2
    overlay.draw(np.zeros(7), desired=q)
    ghost = overlay._ghosts["desired"]

    def shown(link):
        return overlay._visibility._visible[ghost.link_path(link)]

    assert not shown("upper_arm_link")  # not moved by the elbow
    assert shown("forearm_link")
    assert overlay.meshcat.HasPath(f"/drake/{ghost.link_path('forearm_link')}")
    overlay.draw(np.zeros(7), desired=np.zeros(7))
    assert not shown("forearm_link")
    with pytest.raises(DvrkDrakeError, match="unknown ghost other; known: desired"):
        overlay.draw(q, ghosts={"other": q})


class Recorder:
    """Meshcat that stores the properties of a recording, as (time, value) by path."""

    def __init__(self):
        self.changes = {}

    def SetProperty(self, path, _, value, time):
        self.changes.setdefault(path, []).append((time, value))


def test_recording_stores_visibility_at_its_ends():
    """An animation uses its first value also for earlier times, and ends each track at its last value."""
    visibility = Visibility(meshcat := Recorder())
    visibility.set("arc", False)
    for time in (0.5, 0.75):
        visibility.set("arc", True, time)
    visibility.set("arc", False, 1.0)
    visibility.end_recording(4.0)
    assert meshcat.changes["arc"] == [(None, False), (0.0, False), (0.5, True), (1.0, False), (4.0, False)]


def test_drawing_does_not_change_a_simulation():
    arm = load_arm("mtml")
    meshcat = start_meshcat(arm)
    options = {"effects": False, "duration": 0.2, "targets": [(0.1, [0, 0.1, 0, 0, 0, 0, 0])]}
    drawn = dvrk.simulate(arm, meshcat=meshcat, **options)
    np.testing.assert_allclose(drawn.recording.q, dvrk.simulate(arm, **options).recording.q, rtol=0, atol=1e-12)
    for part in ("ghost/desired/mtml/forearm_link", "efforts/elbow_pitch"):
        assert meshcat.HasPath(f"/drake/mtml/overlay/{part}")


def test_unknown_frames_in_the_arm_file_are_refused(tmp_path):
    path = copy_arm(tmp_path, "psm", mechanism=lambda text: text.replace("remote_center: dh_0", "remote_center: dh_x"))
    with pytest.raises(ArmError, match=r"frames\.remote_center: the SDF has no frame dh_x"):
        load_arm(path)
