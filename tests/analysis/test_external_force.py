"""Estimation of the external force over a recording: known forces, intervals, poses at rest, and the command."""

import dataclasses

import numpy as np
import pytest
from command_output import assert_refused, refused
from pushed_arm import pushed_arm
from report_pages import printed

from dvrk_drake.analysis.estimation.point_mass import point_mass_parameters
from dvrk_drake.analysis.external_force import estimate_force
from dvrk_drake.analysis.identification import identify
from dvrk_drake.analysis.observations.observations import Observations
from dvrk_drake.cli import main
from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import PRIOR_FORCE, Contact
from dvrk_drake.errors import ArmError, ModelError
from dvrk_drake.models.arm_files import load_arm
from dvrk_drake.recordings.formats import read_recording, write_recording
from dvrk_drake.recordings.recording import Recording
from dvrk_drake.reports.external_force import force_page

FORCE = np.array([1.0, -2.0, 3.0])
PSM = load_arm("psm")


def thinned(recording, step=5):
    rows = slice(None, None, step)
    return dataclasses.replace(
        recording, **{name: getattr(recording, name)[rows] for name in ("t", "q", "qd", "tau")}, lines=None
    )


@pytest.fixture(scope="module")
def pushed():
    """Returns the exact model of an arm in motion, and a recording with a constant force at the tip."""
    model, recording = pushed_arm(force=FORCE)
    return model, thinned(recording)


@pytest.fixture(scope="module")
def estimate(pushed):
    return estimate_force(pushed[1], pushed[0], same_day=True)


@pytest.fixture(scope="module")
def poses():
    """Returns a nominal model with stated errors, and static poses with a force at the tip."""
    nominal = IdentifiedModel.from_arm(PSM)
    q = PSM.sample_poses(30, np.random.default_rng(0))
    stated = [dataclasses.replace(joint, rms_leave_one_out=1e-3) for joint in nominal.joints]
    model = dataclasses.replace(nominal, joints=stated)
    pushed = np.array([FORCE @ Contact(PSM).jacobian(pose) for pose in q])
    return model, Recording(q=q, tau=model.holding_torque(q) - pushed, source="poses.csv")


def test_known_force_is_recovered_in_motion(estimate):
    assert np.all(estimate.measurable)
    np.testing.assert_allclose(np.median(estimate.force, axis=0), FORCE, atol=0.05)
    assert np.mean(np.abs(estimate.force - FORCE) < estimate.half_width) > 0.95


def test_interval_contains_zero_without_a_force(pushed):
    model, _ = pushed
    free = estimate_force(thinned(pushed_arm()[1]), model, same_day=True)
    assert np.mean(np.abs(free.force) < free.half_width) > 0.95


def test_another_day_widens_the_interval(pushed, estimate):
    model, recording = pushed
    days = [dataclasses.replace(a, rms_between_days=10 * a.rms_cross_validation) for a in model.dynamics.actuators]
    model = dataclasses.replace(model, dynamics=dataclasses.replace(model.dynamics, actuators=days))
    other = estimate_force(recording, model)
    assert np.all(other.half_width > 2 * estimate.half_width)


def test_unmeasured_effort_does_not_affect_the_force(pushed):
    model, recording = pushed
    tau = recording.tau.copy()
    tau[:, 2] = 0.0
    estimate = estimate_force(dataclasses.replace(recording, tau=tau), model, same_day=True)
    assert np.mean(np.abs(estimate.force - FORCE) < estimate.half_width) > 0.95
    assert np.min(estimate.effort_half_width[:, 2]) > 1000 * PRIOR_FORCE


def test_force_at_rest_needs_only_static_poses(poses):
    model, recording = poses
    estimate = estimate_force(recording, model)
    assert np.all(estimate.measurable)
    np.testing.assert_allclose(estimate.force, np.tile(FORCE, (len(recording), 1)), atol=0.1)


@pytest.mark.slow
def test_known_direction_is_the_only_component(pushed):
    model, recording = pushed
    along = estimate_force(recording, model, direction=FORCE, same_day=True)
    assert along.force.shape[1] == 1
    np.testing.assert_allclose(np.median(along.force), np.linalg.norm(FORCE), atol=0.05)


def test_refusals_are_one_line(pushed, poses):
    _, recording = pushed
    for error, message, arguments in (
        (ModelError, r"pushed\.csv: the arm moves, but the model was identified from static poses", poses[:1]),
        (ModelError, "does not state its errors", (IdentifiedModel.from_arm(PSM, dynamics=True),)),
    ):
        assert_refused(error, message, estimate_force, recording, *arguments)
    with pytest.raises(ArmError, match=r'no frame "tip"; available frames: .*dh_6'):
        estimate_force(recording, poses[0], frame="tip")
    assert_refused(ModelError, "the model states no errors", estimate_force, poses[1], IdentifiedModel.from_arm(PSM))


def test_page_states_the_force(estimate, tmp_path):
    page = force_page(estimate)
    text = printed(page)
    assert "Largest force at" in text and "(95 % interval " in text and "measurable" in text
    assert page.next_step.startswith("dvrk-drake force FREE_MOTION.csv")
    estimate.save(tmp_path / "force.csv")
    header = (tmp_path / "force.csv").read_text().splitlines()[0]
    assert header.startswith("t [s],force1 [N],force2 [N],force3 [N],force_lower1 [N]")


@pytest.mark.slow
def test_command_writes_csv_and_report(pushed, tmp_path, capsys, monkeypatch):
    model, recording = pushed
    monkeypatch.chdir(tmp_path)
    model.save("model.yaml")
    write_recording(recording, "pushed.csv")
    arguments = ["force", "pushed.csv", "--model", "model.yaml"]
    assert main([*arguments, "--axes", "frame", "--output", "force.csv", "--report", "force.html"]) == 0
    assert "Largest force" in capsys.readouterr().out
    assert "External force on PSM" in (tmp_path / "force.html").read_text()
    assert 'no frame "tip"' in refused(capsys, *arguments, "--frame", "tip")


@pytest.mark.slow
def test_real_weight_is_found_with_its_inertia(shared_data, real_model):
    mass, link, point = 0.205, "end_link", (0.0, 0.023, 0.3913)
    read = read_recording(shared_data / "trajectories" / "psm_one_205g_insertion.csv", PSM, "wpi")
    effort = estimate_force(read, real_model, frame=link, point=point, same_day=True).effort[:, :2]
    grid, regressor = Observations.for_model(read, real_model).grid, real_model.dynamic_model.regressor
    k = [own.link for own in regressor.links].index(link)
    weight = regressor.regressor(grid.q, grid.v, grid.vd)[..., 10 * k : 10 * k + 10]
    weight = -grid.filter_efforts(grid.at_rows(weight @ point_mass_parameters(mass, np.array(point)), 0))[:, :2]
    assert np.all(np.sqrt(np.mean((effort - weight) ** 2, axis=0)) < 0.25 * np.sqrt(np.mean(weight**2, axis=0)))


@pytest.fixture(scope="module")
def real_model(shared_data):
    path = shared_data / "trajectories" / "psm_one_no_weight.csv"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    return identify(read_recording(path, PSM, "wpi"), PSM).model
