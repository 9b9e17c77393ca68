"""Runs the demo with fewer poses: it must identify and hold the ground-truth arm."""

import io

import numpy as np
import pytest
from rich.console import Console

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.inertial_parameters import link_inertias
from dvrk_drake.experiments.demo import demo
from dvrk_drake.experiments.ground_truth import perturbed_links, pose_visit_trajectory
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.reading import read_recording
from dvrk_drake.reports.demo import print_demo
from dvrk_drake.reports.figures import demo as demo_figures


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    shorter = pytest.MonkeyPatch()
    shorter.setattr(demo, "POSES", 20)
    shorter.setattr(demo, "FRESH_POSES", 6)
    stages, plot = [], demo_figures.plot_positions
    shorter.setattr(
        demo_figures,
        "plot_positions",
        lambda path, *rest: (PLOT_TITLES.update({path.name: rest[-1]}), plot(path, *rest)),
    )
    outcome = demo.run_demo(folder, progress=lambda step, share: stages.append((step, share)))
    demo_figures.plot_demo(folder, outcome)
    yield folder, outcome, stages
    shorter.undo()


#: Titles of the position plots by file name.
PLOT_TITLES: dict[str, str] = {}


def test_demo_writes_everything(result):
    folder, _, stages = result
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "arm.html",
        "fresh_poses.csv",
        "fresh_torque_error.png",
        "model.yaml",
        "poses.csv",
        "predicted.png",
        "release.png",
        "step.png",
        "torque_error.png",
    }
    assert "<html" in (folder / "arm.html").read_text()[:200].lower()
    assert len(read_recording(folder / "poses.csv")) == 20
    assert IdentifiedModel.load(folder / "model.yaml").arm.name == "MTML"
    assert all(0.0 <= share <= 1.0 for _, share in stages)
    assert len({step for step, _ in stages}) == 4


def test_demo_error_is_below_zero_torque_and_paper(result):
    _, outcome, _ = result
    for ours, paper in zip(outcome.fresh.joints[1:], outcome.fresh_paper.joints[1:], strict=True):
        assert ours.rms_error < 0.2 * ours.rms_torque, ours
        assert ours.rms_error < paper.rms_error, (ours, paper)


def test_demo_identifies_simulated_springs(result):
    _, outcome, _ = result
    found = {(e.coordinate, e.kind): e.coefficient for e in outcome.identification.model.effects}
    assert found["joint.wrist_platform", "cable sine"] == pytest.approx(0.05, abs=0.01)
    assert found["joint.wrist_pitch", "cable sine"] == pytest.approx(-0.03, abs=0.003)


def test_demo_drifts_less_than_nominal_and_stops(result):
    _, outcome, _ = result
    assert outcome.drift["identified"].max() < 0.3 * outcome.drift["nominal"].max()
    assert outcome.step_error.max() < 1e-3


def test_drift_output_states_absence_of_friction(result):
    folder, outcome, _ = result
    assert "without dry friction" in PLOT_TITLES["release.png"] and demo.NO_DRY_FRICTION in PLOT_TITLES["release.png"]
    console = Console(record=True, width=120, file=io.StringIO())
    print_demo(console, outcome, folder)
    text = console.export_text()
    assert f"Next: open {folder}/arm.html in a browser" in text
    printed = " ".join(text.split())
    assert demo.NO_DRY_FRICTION in printed


def test_perturbed_links_are_consistent_and_differ():
    arm = load_arm("mtml")
    links = perturbed_links(arm, np.random.default_rng(3), shift=0.002)
    for link, nominal in zip(links, link_inertias(arm), strict=True):
        assert link.link == nominal.link
        M, M_nominal = link.to_spatial_inertia(), nominal.to_spatial_inertia()
        assert M.IsPhysicallyValid() and M.get_mass() != M_nominal.get_mass()
        assert 0 < np.abs(M.get_com() - M_nominal.get_com()).max() <= 0.002


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
