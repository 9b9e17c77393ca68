"""Runs the demo with fewer poses: it must identify and hold the ground-truth arm."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import link_inertias
from dvrk_drake.experiments import demo
from dvrk_drake.experiments.ground_truth import (
    APPROACH,
    MIN_APPROACH,
    perturbed_arm,
    pose_visit_trajectory,
    simulate_poses,
)
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording
from dvrk_drake.reports.demo import demo_page, write_demo
from dvrk_drake.reports.plot import Curve
from dvrk_drake.systems.arm_station import ArmStation


def run_with(poses, fresh_poses, settle, max_angle):
    """Returns a function that runs the demo with other numbers of poses, settling time [s] and joint angles [rad]."""

    def run(*arguments, **options):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(demo, "POSES", poses)
            patch.setattr(demo, "FRESH_POSES", fresh_poses)
            patch.setattr(demo, "SETTLE", settle)
            patch.setattr(demo, "MAX_ANGLE", max_angle)
            return demo.run_demo(*arguments, **options)

    return run


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Returns the folder and the result of a demo with few poses near each other, and the reported progress."""
    folder = tmp_path_factory.mktemp("demo")
    stages = []
    run = run_with(poses=8, fresh_poses=2, settle=0.1, max_angle=0.6)
    outcome = run(folder, progress=lambda step, share: stages.append((step, share)))
    write_demo(outcome, folder)
    return folder, outcome, stages


@pytest.fixture
def held(result):
    """Returns the result of an arm that stays at its pose with the identified model."""
    _, outcome, _ = result
    drift = 0.5 * outcome.limits * np.clip(outcome.time / outcome.time[-1], 0, 1)[:, None]
    return dataclasses.replace(outcome, identified=outcome.identified[0] + drift)


def test_demo_writes_everything(result):
    folder, outcome, stages = result
    files = {path.name: path for path in folder.iterdir()}
    assert set(files) == {"arm.html", "report.html", "fresh_poses.csv", "model.yaml", "poses.csv"} | {"drift.png"}
    assert len(read_recording(files["poses.csv"])) == 8
    assert IdentifiedModel.load(files["model.yaml"]).arm.name == "MTML"
    assert all(0.0 <= share <= 1.0 for _, share in stages)
    assert len({step for step, _ in stages}) == 4
    np.testing.assert_allclose(outcome.time[[0, -1]], [-demo.RELEASE_TIME, demo.DURATION], atol=1e-12)


def test_few_poses_improve_the_model(result):
    """The outer yaw axis is vertical, so gravity causes no torque there."""
    _, outcome, _ = result
    for ours, nominal in zip(outcome.fresh.joints[1:], outcome.fresh_nominal.joints[1:], strict=True):
        assert ours.rms_error < nominal.rms_error, (ours, nominal)
    assert not outcome.holds("nominal") and outcome.drifts["nominal"].max() > 0.3


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "seed"), [("mtml", 0), ("psm", 2)])
def test_identified_model_holds_but_nominal_does_not(tmp_path, arm, seed):
    outcome = run_with(poses=20, fresh_poses=4, settle=demo.SETTLE, max_angle=demo.MAX_ANGLE)(tmp_path, arm, seed)
    assert outcome.holds("identified"), outcome.drifts["identified"]
    assert not outcome.holds("nominal")
    # The first axis of the MTM is vertical.
    for ours, nominal in zip(outcome.fresh.joints[1:], outcome.fresh_nominal.joints[1:], strict=True):
        assert ours.rms_error < 0.3 * ours.rms_torque or arm == "psm", ours
        assert ours.rms_error < nominal.rms_error, (ours, nominal)


def test_drift_plot_shows_models_and_limit(held):
    (plot,) = (block for block in demo_page(held, Path("folder")).blocks if getattr(block, "name", "") == "drift")
    assert len(plot.panels) == 7
    for j, panel in enumerate(plot.panels):
        curves = {mark.name: np.asarray(mark.y) for mark in panel.marks if isinstance(mark, Curve)}
        assert np.abs(curves["identified model"]).max() == pytest.approx(1e3 * held.drifts["identified"][j], abs=1e-9)
        low, high = panel.y_range
        assert low < -15 and high > 15, "the limit is visible"
        assert low <= min(map(np.min, curves.values())) and high >= max(map(np.max, curves.values()))


@pytest.mark.slow
def test_mean_of_both_approaches_cancels_friction():
    arm = load_arm("mtml")
    poses = arm.sample_poses(2, np.random.default_rng(4), margin=0.2)
    effects = arm.effects.only(["friction"])
    nominal = IdentifiedModel.from_arm(arm)
    error = []
    for approach in (None, arm.per_joint(*APPROACH)):
        recording = simulate_poses(ArmStation(arm, effects=effects), nominal, poses, approach=approach)
        error.append(recording.measured_effort() - nominal.holding_torque(recording.q))
    # The friction of the elbow has a travel of 0.25 rad, which is larger than the approach. The friction of the wrist
    # roll is direction-dependent.
    joints = [0, 1, 3, 4, 5]
    one_side, both_sides = (np.sqrt(np.mean(np.square(e), axis=0))[joints] for e in error)
    assert np.all(both_sides < 0.5 * one_side), (one_side, both_sides)


def test_poses_are_approached_from_both_sides():
    arm = load_arm("mtml")
    poses = arm.sample_poses(3, np.random.default_rng(0), margin=0.2)
    approach = arm.per_joint(*APPROACH)
    trajectory, settled = pose_visit_trajectory(arm, poses, approach, settle=0.5)
    for pose, times in zip(poses, settled.reshape(-1, 2), strict=True):
        for t, side in zip(times, (-1, 1), strict=True):
            np.testing.assert_allclose(trajectory.value(t).ravel(), pose, atol=1e-12)
            arrival = t - 0.5
            before = trajectory.value(arrival - MIN_APPROACH / 2).ravel() - pose
            assert np.all(side * before >= -1e-12) and np.any(side * before > 0)


def test_perturbed_links_are_consistent_and_differ(tmp_path):
    arm = load_arm("mtml")
    kept = link_inertias(arm)[0].link
    perturbed = perturbed_arm(
        arm, tmp_path / "mtml.sdf", 3, max_shift=0.002, unchanged_links=[kept], without=["springs"]
    )
    assert arm.effects.springs and not perturbed.effects.springs
    for link, nominal in zip(link_inertias(perturbed), link_inertias(arm), strict=True):
        assert link.link == nominal.link
        M, M_nominal = link.to_spatial_inertia(), nominal.to_spatial_inertia()
        assert M.IsPhysicallyValid() and (M.get_mass() == M_nominal.get_mass()) == (link.link == kept)
        shift = np.abs(M.get_com() - M_nominal.get_com()).max()
        assert shift <= 0.002 and (shift > 1e-9) == (link.link != kept)


def test_trajectory_rests_at_poses_inside_limits():
    arm = load_arm("mtml")
    poses = arm.sample_poses(6, np.random.default_rng(0), margin=0.02)
    trajectory, settled = pose_visit_trajectory(arm, poses)
    for t, pose in zip(settled, poses, strict=True):
        np.testing.assert_allclose(trajectory.value(t).ravel(), pose, atol=1e-12)
        np.testing.assert_allclose(trajectory.EvalDerivative(t).ravel(), 0, atol=1e-12)
    times = np.arange(0, trajectory.end_time(), 0.01)
    assert not any(arm.limit_violations(trajectory.value(t).ravel(), tolerance=1e-9) for t in times)
    speed = max(np.abs(trajectory.EvalDerivative(t)).max() for t in times)
    assert speed < 1.7 + 1e-6


def test_animation_repeats_and_changes_its_caption(result, open_page):
    folder, _, _ = result
    page = open_page(folder / "arm.html")
    page.wait_for("viewer.animator.duration > 0 && viewer.animator.actions?.length > 0")
    assert page.page.title().startswith("MTML")
    loop = "viewer.animator.actions.every((action) => action.loop === 2201 && action.repetitions >= 1000)"
    assert page.page.evaluate(loop), "2201 is THREE.LoopRepeat"
    ends = page.page.evaluate("viewer.animator.actions.map((action) => action.getClip().duration)")
    np.testing.assert_allclose(ends, ends[0], atol=1e-6, err_msg="tracks of other lengths would repeat alone")
    assert ends[0] == pytest.approx(demo.RELEASE_TIME + demo.DURATION, abs=0.05)
    shown = []
    for time in (0.5, 3.0):
        script = """(time) => {
          viewer.animator.pause();
          viewer.animator.seek(time);
          const find = (node, name) => node.children[name]
            || Object.values(node.children).map((child) => find(child, name)).find(Boolean);
          const ghost = find(viewer.scene_tree, "ghost").children["ghost"].object.visible;
          const phase = () => [document.getElementById("phase").textContent, ghost];
          return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(phase()))));
        }"""
        shown.append(tuple(page.page.evaluate(script, time)))
    assert [(text.partition(":")[0], ghost) for text, ghost in shown] == [("held", True), ("released", True)]
    assert not page.errors and not page.requests
